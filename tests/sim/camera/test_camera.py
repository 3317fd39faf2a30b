"""The camera's conventions, intrinsics, noise and threading on rendered images."""

import threading
from typing import Any

import mujoco
import numpy as np
import pytest

from touchdown.sim.api import CameraParams
from touchdown.sim.camera.sensor import CameraSensor
from touchdown.sim.frames import so3_exp
from touchdown.sim.typing import Array

from support import camera_support


@pytest.mark.parametrize(
    "turn", [np.zeros(3), np.array([0.1, -0.15, 0.0]), np.array([-0.05, 0.1, 2.0])]
)
def test_pixels_are_where_the_pinhole_puts_them(turn: Array) -> None:
    """Boxes near the corners: wrong by several pixels if fx and fy were equal."""
    half = 0.5 * float(np.linalg.norm(turn))
    axis = turn / max(float(np.linalg.norm(turn)), 1e-12)
    quat = " ".join(map(str, [np.cos(half), *(np.sin(half) * axis)]))
    looking = camera_support.HEIGHT_M * (so3_exp(turn) @ [0.0, 0.0, -1.0])
    yawed = so3_exp(np.array([0.0, 0.0, turn[2]]))
    spots = [(looking * [1, 1, 0] + yawed @ [x, y, 0.0]) for x, y in ((6.0, 11.0), (-6.0, -11.0))]
    colours = ("1 0 0 1", "0 1 0 1")
    scene = camera_support.make_scene(
        "".join(
            camera_support.box(f"b{i}", s[0], s[1], c)
            for i, (s, c) in enumerate(zip(spots, colours, strict=True))
        ),
        quat,
    )
    image = camera_support.take_image(scene)
    for channel, spot in enumerate(spots):
        seen = camera_support.centroid(image[..., channel] > 128)
        expected = camera_support.project(scene, np.array([spot[0], spot[1], 0.002]))
        assert np.abs(seen - expected).max() < 0.6


def test_right_camera_sees_a_disparity() -> None:
    """Baseline 50 mm to the right: f b / z = 616.9 * 0.05 / 2 = 15.4 pixels at 2 m."""
    scene = camera_support.make_scene(
        '<geom name="red" type="box" size="0.1 0.1 0.001" pos="0 0 18" rgba="1 0 0 1"/>'
    )
    left = camera_support.centroid(camera_support.take_image(scene)[..., 0] > 128)
    right = camera_support.centroid(
        camera_support.take_image(scene, name="vehicle/camera_right")[..., 0] > 128
    )
    assert left[0] - right[0] == pytest.approx(616.93 * 0.05 / 1.999, abs=0.6)
    assert left[1] == pytest.approx(right[1], abs=0.2)


def test_snapshot_keeps_its_instant(closed: Any) -> None:
    scene = camera_support.make_scene(camera_support.box("ahead", 4.0, 0.0, "1 0 0 1"))
    data = camera_support.posed(scene)
    sensor = closed(CameraSensor(scene, camera_support.CLEAN, 0))
    earlier = sensor.snapshot(data)
    data.qpos[:2] = [4.0, 0.0]
    mujoco.mj_forward(scene.model, data)
    later = sensor.snapshot(data)
    above = camera_support.centroid(sensor.render(later, 1)[..., 0] > 128)
    ahead = camera_support.centroid(sensor.render(earlier, 0)[..., 0] > 128)
    assert above[1] == pytest.approx(239.5, abs=0.6)
    assert ahead[1] == pytest.approx(239.5 - 625.2 * 4.0 / 19.998, abs=0.6)


def test_noise_has_its_sigma_and_its_seed(closed: Any) -> None:
    scene = camera_support.make_scene(floor="0.5 0.5 0.5 1")
    data = camera_support.posed(scene)
    clean = camera_support.take_image(scene).astype(np.float64)
    params = CameraParams(noise_sigma=1.5)
    sensor = closed(CameraSensor(scene, params, 3))
    first, again, later = (sensor.render(sensor.snapshot(data), tick) for tick in (20, 20, 40))
    other_seed = closed(CameraSensor(scene, params, 4))
    other = other_seed.render(other_seed.snapshot(data), 20)
    noise = first - clean
    assert noise.mean() == pytest.approx(0.0, abs=0.02)
    assert noise.std() == pytest.approx(1.5, abs=0.02)
    np.testing.assert_array_equal(noise[..., 0], noise[..., 2])
    np.testing.assert_array_equal(first, again)
    for different in (later, other):
        grain = (different - clean)[..., 0].ravel()
        assert abs(np.corrcoef(grain, noise[..., 0].ravel())[0, 1]) < 0.02
    assert not first.flags.writeable


def test_a_second_thread_is_refused(closed: Any) -> None:
    scene = camera_support.make_scene()
    sensor = closed(CameraSensor(scene, camera_support.CLEAN, 0))
    snapshot = sensor.snapshot(camera_support.posed(scene))
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
    assert "one thread only" in str(errors[0])


def test_model_keeps_its_own_rendering_settings() -> None:
    scene = camera_support.make_scene()
    before = (scene.model.vis.global_.offwidth, scene.model.vis.quality.shadowsize)
    camera_support.take_image(scene)
    after = (scene.model.vis.global_.offwidth, scene.model.vis.quality.shadowsize)
    assert before == after
