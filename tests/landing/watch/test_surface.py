"""Returns of one scan in the cells of the watch."""

import numpy as np
import pytest

from touchdown.experiments.external.synthetic_descent import Descent
from touchdown.experiments.external.synthetic_stream import synthetic_rig
from touchdown.landing.watch.surface import CELL_M, Layers, Surface, binned
from touchdown.sim.frames import Pose, PoseHistory, rotation_from_yaw


def test_each_return_is_placed_by_the_pose_at_its_time() -> None:
    """Still for the first half of a scan; then 1 m to the left and a quarter turn."""
    rotations = np.stack([np.eye(3), np.eye(3), rotation_from_yaw(0.5 * np.pi)])
    positions = np.array([[4.1, 4.1, 6.0], [4.1, 4.1, 6.0], [4.1, 5.1, 6.0]])
    directions = np.tile(np.array([0.6, 0.0, -0.8], np.float32), (4, 1))
    ranges = np.array([5.0, 5.0, 5.0, 0.0], np.float32)
    times = np.array([0.01, 0.04, 0.1, 0.1], np.float32)
    count = np.zeros((50, 50), np.float32)
    low, high = np.full_like(count, np.inf), np.full_like(count, -np.inf)
    cells, heights = binned(directions, ranges, times, rotations, positions, 0.05, count, low, high)
    first, last = (20, 35), (40, 20)  # rows and columns of 0.2 m
    assert [divmod(int(cell), 50) for cell in cells] == [first, first, last]
    assert (count[first], count[last], count.sum()) == (2.0, 1.0, 3.0)
    assert heights == pytest.approx(2.0, abs=1e-5)
    assert (low[first], high[last]) == (pytest.approx(2.0), pytest.approx(2.0))


def layers_from(height_m: float) -> tuple[Layers, np.ndarray]:
    """What is seen of level ground, and (N, N) the distances from below the vehicle."""
    rig, pose = synthetic_rig(), Pose(np.eye(3), np.array([0.0, 0.0, height_m]))
    surface, poses, layers = Surface(rig.body_from_lidar), PoseHistory(100), None
    for seen in Descent(pose_at=lambda _: pose, seconds=1.0, around=True).seen(rig):
        poses.add(seen.obs.time_s, pose)
        for scan in seen.obs.scans:
            layers = surface.add(scan, poses) or layers
    assert layers is not None
    at = (np.arange(len(layers.low)) + 0.5) * CELL_M
    x, y = surface.corner[0] + at, surface.corner[1] + at
    return layers, np.hypot(x[None, :], y[:, None])


def test_from_above_is_within_three_heights_and_from_three_metres_on() -> None:
    layers, away = layers_from(3.6)
    known = np.isfinite(layers.ground)
    assert layers.steep[known & (away < 9.8)].all()
    assert not layers.steep[known & (away > 11.2)].any() and (known & (away > 11.2)).any()
    assert not layers_from(2.6)[0].steep.any()
