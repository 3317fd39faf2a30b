"""The camera's conventions, intrinsics, noise and threading on rendered pictures."""

from __future__ import annotations

import threading

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from scenes.api import Scene
from sim.api import CameraParams
from sim.camera import CameraSensor
from sim.frames import BODY_FROM_DOWNWARD_OPTICAL, Pose, so3_exp

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]

CLEAN = CameraParams(noise_sigma=0.0)
HEIGHT_M = 20.0
HEADLIGHT = (
    '<visual><headlight ambient="1 1 1" diffuse="0 0 0" specular="0 0 0"/></visual>'
    '<option><flag gravity="disable"/></option>'
)


def make_scene(objects: str = "", quat_wxyz: str = "1 0 0 0", floor: str = "0 0 0 1") -> Scene:
    """A vehicle with a downward camera 20 m over a plain floor; ``objects`` stand on it."""
    xml = f"""
    <mujoco>{HEADLIGHT}<worldbody>
      <body name="vehicle/quadrotor" pos="0 0 {HEIGHT_M}" quat="{quat_wxyz}">
        <freejoint/>
        <geom name="vehicle/plate" type="box" size="1 1 0.05" pos="0 0 -1" group="4"/>
        <camera name="vehicle/camera" xyaxes="0 -1 0 1 0 0"/>
        <camera name="vehicle/camera_right" xyaxes="0 -1 0 1 0 0" pos="0 -0.05 0"/>
      </body>
      <geom name="floor" type="plane" size="100 100 1" rgba="{floor}"/>{objects}
    </worldbody></mujoco>"""
    return Scene(
        name="test",
        seed=0,
        model=mujoco.MjModel.from_xml_string(xml),
        takeoff_xy_m=np.zeros(2),
        takeoff_yaw=0.0,
        bounds_xy_m=np.array([[-60.0, -60.0], [60.0, 60.0]]),
        surfaces={},
        ground=None,
        moving=(),
    )


def box(name: str, x: float, y: float, rgba: str) -> str:
    return (
        f'<geom name="{name}" type="box" size="0.25 0.25 0.001" pos="{x} {y} 0.001" rgba="{rgba}"/>'
    )


def posed(scene: Scene) -> mujoco.MjData:
    data = mujoco.MjData(scene.model)
    mujoco.mj_forward(scene.model, data)
    return data


def take_picture(
    scene: Scene, params: CameraParams = CLEAN, name: str = "vehicle/camera", tick: int = 0
) -> Bytes:
    sensor = CameraSensor(scene, params, 3, name)
    try:
        return sensor.render(sensor.snapshot(posed(scene)), tick)
    finally:
        sensor.close()


def centroid(mask: NDArray[np.bool_]) -> Array:
    """(u, v) pixel centre of a blob, pixel centres at integers."""
    rows, cols = np.nonzero(mask)
    assert rows.size > 20
    return np.array([cols.mean(), rows.mean()])


def project(scene: Scene, world: Array, lever: Array | None = None) -> Array:
    k = CameraSensor(scene, CLEAN, 0).intrinsics()
    data = posed(scene)
    body = scene.model.body("vehicle/quadrotor").id
    world_from_body = Pose(data.xmat[body].reshape(3, 3), data.xpos[body])
    body_from_camera = Pose(BODY_FROM_DOWNWARD_OPTICAL, np.zeros(3) if lever is None else lever)
    point = (world_from_body @ body_from_camera).inverse().apply(world)
    return np.array([k.fx * point[0] / point[2] + k.cx, k.fy * point[1] / point[2] + k.cy])


def test_intrinsics_of_the_d435() -> None:
    k = CameraSensor(make_scene(), CLEAN, 0).intrinsics()
    assert (k.width, k.height) == (848, 480)
    assert (k.fx, k.fy) == (pytest.approx(616.93, abs=0.1), pytest.approx(625.22, abs=0.1))
    assert (k.cx, k.cy) == (423.5, 239.5)


def test_forward_is_up_and_left_is_left() -> None:
    scene = make_scene(box("ahead", 5.0, 0.0, "1 0 0 1") + box("left", 0.0, 8.0, "0 1 0 1"))
    picture = take_picture(scene)
    ahead, left = centroid(picture[..., 0] > 128), centroid(picture[..., 1] > 128)
    assert ahead[1] < 100
    assert left[0] < 200
    assert ahead[0] == pytest.approx(423.5, abs=1.0)
    assert left[1] == pytest.approx(239.5, abs=1.0)


@pytest.mark.parametrize(
    "turn", [np.zeros(3), np.array([0.1, -0.15, 0.0]), np.array([-0.05, 0.1, 2.0])]
)
def test_pixels_are_where_the_pinhole_puts_them(turn: Array) -> None:
    """Boxes near the corners: wrong by several pixels if fx and fy were equal."""
    half = 0.5 * float(np.linalg.norm(turn))
    axis = turn / max(float(np.linalg.norm(turn)), 1e-12)
    quat = " ".join(map(str, [np.cos(half), *(np.sin(half) * axis)]))
    looking = HEIGHT_M * (so3_exp(turn) @ [0.0, 0.0, -1.0])
    yawed = so3_exp(np.array([0.0, 0.0, turn[2]]))
    spots = [(looking * [1, 1, 0] + yawed @ [x, y, 0.0]) for x, y in ((6.0, 11.0), (-6.0, -11.0))]
    colours = ("1 0 0 1", "0 1 0 1")
    scene = make_scene(
        "".join(
            box(f"b{i}", s[0], s[1], c) for i, (s, c) in enumerate(zip(spots, colours, strict=True))
        ),
        quat,
    )
    picture = take_picture(scene)
    for channel, spot in enumerate(spots):
        seen = centroid(picture[..., channel] > 128)
        expected = project(scene, np.array([spot[0], spot[1], 0.002]))
        assert np.abs(seen - expected).max() < 0.6


def test_right_camera_sees_a_disparity() -> None:
    """Baseline 50 mm to the right: f b / z = 616.9 * 0.05 / 2 = 15.4 pixels at 2 m."""
    scene = make_scene(
        '<geom name="red" type="box" size="0.1 0.1 0.001" pos="0 0 18" rgba="1 0 0 1"/>'
    )
    left = centroid(take_picture(scene)[..., 0] > 128)
    right = centroid(take_picture(scene, name="vehicle/camera_right")[..., 0] > 128)
    assert left[0] - right[0] == pytest.approx(616.93 * 0.05 / 1.999, abs=0.6)
    assert left[1] == pytest.approx(right[1], abs=0.2)


def test_the_vehicle_is_not_in_its_own_picture() -> None:
    assert take_picture(make_scene(floor="0 0 1 1"))[..., 2].min() > 200


def test_snapshot_keeps_its_instant() -> None:
    scene = make_scene(box("ahead", 4.0, 0.0, "1 0 0 1"))
    data = posed(scene)
    sensor = CameraSensor(scene, CLEAN, 0)
    earlier = sensor.snapshot(data)
    data.qpos[:2] = [4.0, 0.0]
    mujoco.mj_forward(scene.model, data)
    later = sensor.snapshot(data)
    above = centroid(sensor.render(later, 1)[..., 0] > 128)
    ahead = centroid(sensor.render(earlier, 0)[..., 0] > 128)
    sensor.close()
    assert above[1] == pytest.approx(239.5, abs=0.6)
    assert ahead[1] == pytest.approx(239.5 - 625.2 * 4.0 / 19.998, abs=0.6)


def test_noise_has_its_sigma_and_its_seed() -> None:
    scene = make_scene(floor="0.5 0.5 0.5 1")
    data = posed(scene)
    clean = take_picture(scene).astype(np.float64)
    params = CameraParams(noise_sigma=1.5)
    sensor = CameraSensor(scene, params, 3)
    first, again, later = (sensor.render(sensor.snapshot(data), tick) for tick in (20, 20, 40))
    sensor.close()
    other_seed = CameraSensor(scene, params, 4)
    other = other_seed.render(other_seed.snapshot(data), 20)
    other_seed.close()
    noise = first - clean
    assert noise.mean() == pytest.approx(0.0, abs=0.02)
    assert noise.std() == pytest.approx(1.5, abs=0.02)
    np.testing.assert_array_equal(noise[..., 0], noise[..., 2])
    np.testing.assert_array_equal(first, again)
    for different in (later, other):
        grain = (different - clean)[..., 0].ravel()
        assert abs(np.corrcoef(grain, noise[..., 0].ravel())[0, 1]) < 0.02
    assert not first.flags.writeable


def test_a_worker_thread_draws_the_same_picture() -> None:
    scene = make_scene(box("ahead", 3.0, 1.0, "1 0 0 1"))
    params = CameraParams(noise_sigma=1.5)
    here = take_picture(scene, params, tick=60)
    there: list[Bytes] = []
    worker = threading.Thread(target=lambda: there.append(take_picture(scene, params, tick=60)))
    worker.start()
    worker.join()
    np.testing.assert_array_equal(here, there[0])


def test_a_second_thread_is_refused() -> None:
    scene = make_scene()
    sensor = CameraSensor(scene, CLEAN, 0)
    snapshot = sensor.snapshot(posed(scene))
    sensor.render(snapshot, 0)
    errors: list[Exception] = []

    def draw() -> None:
        try:
            sensor.render(snapshot, 1)
        except RuntimeError as error:
            errors.append(error)

    worker = threading.Thread(target=draw)
    worker.start()
    worker.join()
    sensor.close()
    assert "one thread only" in str(errors[0])


def test_unknown_camera_is_named() -> None:
    with pytest.raises(ValueError, match=r"no camera 'nose'.*vehicle/camera_right"):
        CameraSensor(make_scene(), CLEAN, 0, "nose")


def test_unusable_backend_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "nothing")
    scene = make_scene()
    sensor = CameraSensor(scene, CLEAN, 0)
    with pytest.raises(RuntimeError, match=r"nothing.*set MUJOCO_GL to egl or osmesa"):
        sensor.render(sensor.snapshot(posed(scene)), 0)


def test_model_keeps_its_own_rendering_settings() -> None:
    scene = make_scene()
    before = (scene.model.vis.global_.offwidth, scene.model.vis.quality.shadowsize)
    take_picture(scene)
    after = (scene.model.vis.global_.offwidth, scene.model.vis.quality.shadowsize)
    assert before == after
