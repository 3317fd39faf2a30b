"""Returns of one scan in the cells of the watch."""

import numpy as np
import pytest

from touchdown.landing.watch.surface import binned
from touchdown.sim.frames import rotation_from_yaw


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
