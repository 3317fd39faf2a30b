"""Views and scans at given poses, against a scene whose distances are known."""

from collections.abc import Iterator

import numpy as np
import pytest

from touchdown.scenes.api import Scene
from touchdown.sim.api import CameraParams, LidarParams, WorldParams
from touchdown.sim.frames import Pose, rotation_from_yaw
from touchdown.sim.moving import BodyTrack
from touchdown.sim.posed_sensors import PosedSensors, track_along

from support.places import scene_of

SCENE_XML = """
<mujoco>
  <worldbody>
    <geom name="lawn" type="plane" size="60 60 1"/>
    <body name="board" mocap="true" pos="0 0 -5">
      <geom name="board" type="box" size="2 2 0.1"/>
    </body>
    <site name="takeoff" pos="0 0 0"/>
  </worldbody>
</mujoco>
"""
PARAMS = WorldParams(
    camera=CameraParams(width=64, height=36, noise_sigma=0.0),
    lidar=LidarParams(range_sigma_m=0.0, angle_sigma_deg=0.0, divergence=False),
)
ABOVE = Pose(rotation_from_yaw(0.7), np.array([3.0, -2.0, 20.0]))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scene_of(SCENE_XML)


@pytest.fixture
def sensors(scene: Scene) -> Iterator[PosedSensors]:
    made = PosedSensors(scene, PARAMS, 0)
    yield made
    made.close()


def test_returns_lie_on_the_ground(sensors: PosedSensors) -> None:
    scan = sensors.scan(BodyTrack.at_rest(ABOVE, sensors.scan_times(120)), 120)
    assert (scan.start_tick, scan.end_tick) == (120, 180)
    points = scan.points[scan.ranges > 0.0].astype(np.float64)
    world = (ABOVE @ sensors.mounts.lidar).apply(points)
    assert len(world) > 10_000
    np.testing.assert_allclose(world[:, 2], 0.0, atol=1e-3)


def test_a_held_body_is_seen_by_both_sensors(scene: Scene, sensors: PosedSensors) -> None:
    sensors.hold("board", Pose(np.eye(3), np.array([3.0, -2.0, 9.9])))
    view = sensors.view(ABOVE, 0.0, 0)
    middle = (18, 32)
    assert view.geom_id[middle] == scene.model.geom("board").id
    assert view.depth_m[middle] == pytest.approx(10.0, abs=0.3)
    scan = sensors.scan(BodyTrack.at_rest(ABOVE, sensors.scan_times(0)), 0)
    heights = (ABOVE @ sensors.mounts.lidar).apply(scan.points.astype(np.float64))[:, 2]
    assert (np.abs(heights[scan.ranges > 0.0] - 10.0) < 1e-3).sum() > 100


def test_only_a_mocap_body_can_be_held(sensors: PosedSensors) -> None:
    with pytest.raises(ValueError, match="no mocap body 'tram'"):
        sensors.hold("tram", Pose.identity())


def test_an_image_is_taken_from_the_pose_of_its_tick(sensors: PosedSensors) -> None:
    class Climb:
        def sample(self, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            return np.array([0.0, 0.0, 10.0 + t]), np.array([0.0, 0.0, 1.0]), np.zeros(3)

    track = track_along(Climb(), sensors.scan_times(600), 0.5, 0.0)
    np.testing.assert_allclose(track.positions[[0, -1], 2], [10.5, 10.6])
    np.testing.assert_allclose(track.last_pose.rotation, np.eye(3), atol=1e-12)
    image = sensors.image(track, 630)
    assert (image.tick, image.time_s) == (630, 1.05)
    middle = Pose(np.eye(3), track.positions[30])
    np.testing.assert_array_equal(image.rgb, sensors.view(middle, 1.05, 630).rgb)
