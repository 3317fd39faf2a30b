import dataclasses
from pathlib import Path
from typing import Any

import cv2
import mujoco
import numpy as np
import pytest
from rerun.chunk import RrdReader

from touchdown.controller.api import Setpoint
from touchdown.estimator.api import GridMap, MapView, PoseTrack
from touchdown.experiments.drawing.map_images import map_points
from touchdown.experiments.io.run_directory import SENSORS_FILE
from touchdown.experiments.io.sensor_log import SensorLog
from touchdown.experiments.io.tum import TumWriter, read_tum
from touchdown.experiments.recording import rerun_scene
from touchdown.experiments.recording.recorder import StepRecord
from touchdown.experiments.recording.rerun_recorder import MapTiles, scan_points_odom
from touchdown.experiments.recording.run_recorder import RunRecorder
from touchdown.landing.api import Candidate, CostmapView, Phase, SemanticView
from touchdown.scenes.api import MovingBody, Scene, Surface
from touchdown.sim.api import CameraImage, Command, LidarScan, SensorNeeds, SensorRig
from touchdown.sim.frames import Pose, rotation_from_yaw

from support.flight_fakes import make_estimate, make_truth, make_view
from support.landing_support import make_obs, make_rig
from support.messages import make_scan
from support.places import bare_scene
from support.worlds import load_ideal_config as load_config

MJCF = """
<mujoco>
  <asset>
    <hfield name="relief" nrow="21" ncol="41" size="20 10 2 1"/>
    <texture name="turf" type="2d" builtin="checker" rgb1="1 0 0" rgb2="0 1 0"
             width="64" height="32"/>
    <material name="turf" texture="turf"/>
  </asset>
  <worldbody>
    <geom name="terrain" type="hfield" hfield="relief" material="turf"/>
    <geom name="house" type="box" size="2 1 3" pos="5 0 3" rgba="0.5 0.5 0.5 1"/>
    <geom name="ghost" type="box" size="1 1 1" rgba="1 0 0 0"/>
    <geom name="proxy" type="box" size="1 1 1" group="3"/>
    <body name="car" mocap="true" pos="-5 0 1">
      <geom name="car" type="box" size="2 0.8 0.5" rgba="0.8 0.1 0.1 1"/>
    </body>
    <body name="vehicle/quadrotor" pos="0 0 5">
      <freejoint/>
      <geom name="vehicle/hull" type="cylinder" size="0.2 0.05" rgba="0.1 0.1 0.1 1" mass="4"/>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def scene() -> Scene:
    model = mujoco.MjModel.from_xml_string(MJCF)
    model.hfield_data[:] = np.linspace(0.0, 1.0, 21 * 41)
    square = np.array([[0.0, 0, 1], [10, 0, 1], [10, 10, 1], [0, 10, 1]])
    return bare_scene(
        model, bounds_xy_m=np.array([[-20.0, -10.0], [20.0, 10.0]]),
        surfaces={"terrain": Surface(land_class="lawn", reflectivity=0.4)},
        moving=(MovingBody(body_name="car", path_world=square, speed_mps=2.0, start_m=5.0),),
    )  # fmt: skip


@pytest.fixture(scope="module")
def rig() -> SensorRig:
    return make_rig()


def _grid(cells: int = 160, cell_m: float = 0.2) -> GridMap:
    """A map whose lower left quarter is seen, coloured in its lower half."""
    shape = (cells, cells)
    count = np.zeros(shape, np.float32)
    count[: cells // 2, : cells // 2] = 4.0
    rgb = np.full((*shape, 3), np.nan, np.float32)
    rgb[: cells // 4] = (10.0, 20.0, 30.0)
    plane = np.full(shape, 1.5, np.float32)
    return GridMap(
        origin_xy_m=np.full(2, -0.5 * cells * cell_m), cell_m=cell_m, count=count, height_m=plane,
        height_std_m=np.zeros(shape, np.float32), min_height_m=plane, max_height_m=plane, rgb=rgb,
        intensity=np.full(shape, 20.0, np.float32), missing=np.zeros(shape, np.float32),
        last_seen_s=np.zeros(shape, np.float32),
    )  # fmt: skip


def _scan(start_s: float, directions: Any, ranges: Any) -> LidarScan:
    offsets = np.linspace(0.0, 0.1, len(ranges))
    return make_scan(round(600 * start_s) + 60, directions, ranges, offsets, 30)


def test_tum_keeps_poses_to_nine_decimals(tmp_path: Path) -> None:
    writer = TumWriter(tmp_path / "a.tum")
    for i in range(600):
        writer.add(0.02 * i, Pose(rotation_from_yaw(0.5 * np.pi), np.array([i, -2.0, 1 / 3])))
    writer.close()
    times, positions, quats_wxyz = read_tum(tmp_path / "a.tum")
    assert times.shape == (600,)
    np.testing.assert_allclose(positions[7], [7.0, -2.0, 1 / 3], atol=1e-9)
    np.testing.assert_allclose(quats_wxyz[7], [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=1e-9)


def test_map_points_lie_at_cell_centres_and_grey_stands_for_no_image() -> None:
    points, colours = map_points(_grid(), slice(0, 2), slice(0, 3))
    assert points.shape == (6, 3)
    np.testing.assert_allclose(points[0], [-15.9, -15.9, 1.5], atol=1e-5)
    assert colours[0].tolist() == [10, 20, 30]
    _, grey = map_points(_grid(), slice(60, 61), slice(0, 1))
    assert grey.tolist() == [[60, 60, 60]]


def test_tiles_come_again_only_after_growth() -> None:
    grid, tiles = _grid(), MapTiles()
    assert len(list(tiles.changed(grid))) == 1 and list(tiles.changed(grid)) == []
    grid.count[:80, :80] *= 1.1
    assert list(tiles.changed(grid)) == [] and len(list(tiles.changed(grid, everything=True))) == 1
    grid.count[100:140, 100:140] = 1.0
    assert list(tiles.changed(grid)) == [(slice(80, 160), slice(80, 160))]


def test_scan_points_use_the_pose_of_their_own_instant() -> None:
    """At 10 m/s along x, the last of the pulses is cast 1 m further than the first."""
    track = PoseTrack(
        times_s=np.array([1.0, 1.1]),
        positions_odom=np.array([[0.0, 0, 30], [1.0, 0, 30]]),
        quats_wxyz=np.array([[1.0, 0, 0, 0], [-1.0, 0, 0, 0]]),
    )
    down = Pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    scan = _scan(1.0, [[0, 0, 1]] * 5, [30.0, 30.0, 0.0, 30.0, 30.0])
    points = scan_points_odom(scan, track, down, 100)
    np.testing.assert_allclose(points[:, 0], [0.0, 0.25, 0.75, 1.0], atol=1e-6)
    np.testing.assert_allclose(points[:, 2], 0.0, atol=1e-6)


def test_box_mesh_is_closed_and_faces_outwards(scene: Scene) -> None:
    house = scene.model.geom("house").id
    mesh = rerun_scene.merged_mesh(scene.model, [house], rerun_scene.geom_poses(scene.model))
    corners = mesh.vertices[mesh.faces]
    volume = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert volume == pytest.approx(4 * 2 * 6)
    np.testing.assert_allclose(mesh.vertices.min(axis=0), [3.0, -1.0, 0.0])


def test_terrain_mesh_spans_the_height_field(scene: Scene) -> None:
    model = scene.model
    ground = rerun_scene.terrain(model, 0, Pose.identity(), max_side=11, texture_pixels=16)
    assert len(ground.vertices) == 11 * 11
    np.testing.assert_allclose(ground.vertices.min(axis=0), [-20.0, -10.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(ground.vertices.max(axis=0), [20.0, 10.0, 2.0], atol=1e-6)
    assert ground.texture.shape == (8, 16, 3)
    first = ground.vertices[ground.faces[0]]
    assert np.cross(first[1] - first[0], first[2] - first[0])[2] > 0.0


def _candidate(accepted: bool) -> Candidate:
    return Candidate(
        position_odom=np.array([-10.0, -10.0, 1.5]),
        c_sum=0.8, slope_deg=1.0, roughness_m=0.02, clearance_m=3.0, accepted=accepted,
        reason="level and clear" if accepted else "water",
        rule="highest_value" if accepted else "water", value=0.9,
    )  # fmt: skip


def _fly(recorder: Any, steps: int = 400) -> None:
    """Two seconds by hand: 200 Hz along x, a scan and an image every 0.1 s, one selection."""
    grid = _grid()
    total = np.where(grid.count > 0, np.float32(0.5), np.float32(np.nan))
    costmap = CostmapView(
        origin_xy_m=grid.origin_xy_m, cell_m=grid.cell_m, total=total, flatness=total,
        smoothness=total, distance=total, rgb=np.full((160, 160, 3), 90, np.uint8), value=total,
        allowed=grid.count > 0, semantics=SemanticView(
            origin_xy_m=np.zeros(2), spacing_m=3.2, weight=np.ones((4, 4), np.float32),
            probabilities=np.full((4, 4, 7), 1 / 7, np.float32),
        ),
    )  # fmt: skip
    half = dataclasses.replace(
        costmap, total=np.where(np.arange(160) < 40, total, np.float32("nan"))
    )
    image = np.full((48, 64, 3), 127, np.uint8)
    command = Command(rotor_speed_radps=np.full(4, 500.0))
    for step in range(steps):
        time_s = 0.005 * step
        here = np.array([2.0 * time_s, 0.0, 5.0])
        pulse = step % 20 == 0 and step > 0
        scans = (_scan(time_s - 0.1, [[0, 0, 1]] * 50, [5.0] * 50),) if pulse else ()
        images = (CameraImage(tick=3 * step, time_s=time_s, rgb=image),) if pulse else ()
        obs = make_obs(
            3 * step, time_s=time_s, scans=scans, images=images, rotor_speed_radps=np.full(4, 500.0)
        )
        chosen = {
            "costmap": half if step < 300 else costmap,
            "candidates": (_candidate(True), _candidate(False)),
        }
        chosen["site_world"] = np.array([-10.0, -10.0, 1.5])
        record = StepRecord(
            make_truth(time_s, here),
            obs,
            make_estimate(time_s, here + np.array([0.1, 0.0, 0.0])),
            MapView(version=step, coarse=grid, fine=None),
            make_view(Phase.SURVEY, **(chosen if step > 200 else {}), reference_world=here),
            Setpoint(
                position_odom=here, velocity_odom=np.zeros(3), acceleration_odom=np.zeros(3),
                yaw_odom=0.0,
            ),
            command,
        )  # fmt: skip
        recorder.tick(record)
    recorder.close()


def test_run_directory_holds_all_files(tmp_path: Path, scene: Scene, rig: SensorRig) -> None:
    _fly(RunRecorder(tmp_path, scene, rig, load_config()))
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {
        "truth.tum", "estimate.tum", "reference.tum", "flight.rrd", "map.ply", "costmap.png",
        "classes.png",
    }  # fmt: skip
    times, truth, _ = read_tum(tmp_path / "truth.tum")
    _, estimate, _ = read_tum(tmp_path / "estimate.tum")
    assert len(times) == 100  # 50 Hz
    np.testing.assert_allclose(np.diff(times), 0.02, atol=1e-9)
    np.testing.assert_allclose(estimate - truth, [[0.1, 0.0, 0.0]] * 100, atol=1e-9)
    assert (tmp_path / "flight.rrd").read_bytes()[:3] == b"RRF"
    header, _, body = (tmp_path / "map.ply").read_bytes().partition(b"end_header\n")
    assert b"element vertex 6400" in header and len(body) == 6400 * 15
    image = cv2.imread(str(tmp_path / "costmap.png"))
    assert image.shape[1] > image.shape[0]
    chunks = RrdReader(tmp_path / "flight.rrd").stream().to_chunks()
    logged = [chunk.to_record_batch() for chunk in chunks if chunk.entity_path == "/costmap/total"]
    blobs = [b for batch in logged for b in batch.column("EncodedImage:blob").to_pylist()]
    shapes = [cv2.imdecode(np.array(blob[0], np.uint8), cv2.IMREAD_COLOR).shape for blob in blobs]
    assert len(shapes) == 2 and shapes[0] == shapes[1]  # a viewer takes them for a video


def test_with_sensors_the_odometry_is_kept_apart(
    tmp_path: Path, scene: Scene, rig: SensorRig
) -> None:
    log = SensorLog(tmp_path / SENSORS_FILE, rig, SensorNeeds(lidar=True))
    _fly(RunRecorder(tmp_path, scene, rig, load_config(record=False), log), steps=100)
    odometry, estimate = ((tmp_path / f"{name}.tum") for name in ("odometry", "estimate"))
    assert odometry.read_bytes() == estimate.read_bytes()  # its frame is the world's
