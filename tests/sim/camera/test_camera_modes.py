"""Depth, segmentation, lens, exposure, shutter and backends of the camera."""

import subprocess
from contextlib import closing

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from touchdown.scenes.api import Scene
from touchdown.sim.api import CameraParams, SimParams
from touchdown.sim.camera.optics import intrinsics_of
from touchdown.sim.camera.sensor import CameraSensor
from touchdown.sim.delivery import readout_ticks
from touchdown.sim.geometry.lens import distorted, project, undistorted

from support.camera_support import CLEAN, HEIGHT_M, box, centroid, make_scene, posed, take_image
from support.command import python, without_display

BARREL = (-0.11, 0.02, 0.0012, -0.0008, -0.003)
"""Stronger distortion than that of a D435, with tangential terms."""


def seen(scene: Scene, params: CameraParams = CLEAN) -> tuple[NDArray, NDArray]:
    """(H, W) depths and ids of geoms."""
    with closing(CameraSensor(scene, params, 0)) as sensor:
        snapshot = sensor.snapshot(posed(scene))
        return sensor.render_depth(snapshot), sensor.render_segmentation(snapshot)


def test_depth_is_along_the_axis_not_along_the_ray() -> None:
    """A floor 20 m below is 20 m deep in every pixel; a box of 3 m height is 17 m deep."""
    scene = make_scene(
        '<geom name="crate" type="box" size="2 1 1.5" pos="0 0 1.5" rgba="1 0 0 1"/>'
    )
    depth, _ = seen(scene)
    assert depth.dtype == np.float32
    assert depth.shape == (480, 848)
    on_crate = depth < 18.0
    np.testing.assert_allclose(depth[on_crate], HEIGHT_M - 3.0, atol=2e-3)
    np.testing.assert_allclose(depth[~on_crate & (depth > 19.9)], HEIGHT_M, atol=2e-3)
    k = intrinsics_of(CLEAN)
    rows, cols = np.nonzero(np.abs(depth - 17.0) < 2e-3)
    assert np.ptp(cols) + 1 == pytest.approx(k.fx * 2.0 / 17.0, abs=1.5)
    assert np.ptp(rows) + 1 == pytest.approx(k.fy * 4.0 / 17.0, abs=1.5)
    assert not depth.flags.writeable


def test_the_sky_has_no_depth_and_no_geom() -> None:
    half = np.pi / 2  # on its back
    scene = make_scene(quat_wxyz=f"{np.cos(half)} {np.sin(half)} 0 0")
    depth, ids = seen(scene)
    assert np.isinf(depth).all() and (ids == -1).all()


@pytest.mark.parametrize("samples", [0, 4])
def test_segmentation_counts_pixels_of_every_geom(samples: int) -> None:
    """4 x 2 m at 17 m depth are (f 4/17) x (f 2/17) pixels. Multisampling must not blend ids."""
    scene = make_scene(
        '<geom name="crate" type="box" size="1 2 1.5" pos="0 0 1.5" rgba="1 0 0 1"/>'
        '<geom name="ball" type="sphere" size="1" pos="4 5 1" rgba="0 1 0 1"/>'
    )
    _, ids = seen(scene, CameraParams(noise_sigma=0.0, samples=samples))
    assert ids.dtype == np.int32
    crate, ball, floor = (scene.model.geom(n).id for n in ("crate", "ball", "floor"))
    assert set(np.unique(ids)) == {crate, ball, floor}
    k = intrinsics_of(CLEAN)
    expected = (k.fx * 4.0 / 17.0) * (k.fy * 2.0 / 17.0)
    assert (ids == crate).sum() == pytest.approx(expected, rel=0.02)
    solid = np.pi * k.fx * k.fy / (19.0**2 - 1.0)  # the cone around a sphere, near the axis
    assert (ids == ball).sum() == pytest.approx(solid, rel=0.1)
    sees_left = centroid(ids == ball)
    assert sees_left[0] < 423.5 and sees_left[1] < 239.5


def test_depth_and_segmentation_belong_to_the_colour_image() -> None:
    scene = make_scene(
        '<geom name="crate" type="box" size="1 1 1" pos="3 -4 1" rgba="1 0 0 1"/>', floor="0 0 1 1"
    )
    for params in (CLEAN, CameraParams(noise_sigma=0.0, distortion=BARREL)):
        red = take_image(scene, params)[..., 0] > 128
        depth, ids = seen(scene, params)
        crate, deep = ids == scene.model.geom("crate").id, depth < 19.98
        assert (red ^ crate).sum() < 0.03 * crate.sum()
        assert (deep ^ crate).sum() < 0.03 * crate.sum()


def test_distortion_is_that_of_opencv() -> None:
    """Spots near centre, edges and corners lie where cv2.projectPoints puts them."""
    params = CameraParams(noise_sigma=0.0, distortion=BARREL)
    k = intrinsics_of(params)
    scene_spots = [(0.0, 0.0), (6.5, 11.5), (-6.5, 11.5), (6.5, -11.5), (0.0, 12.5), (-7.0, 0.0)]
    for x, y in scene_spots:
        scene = make_scene(box("spot", x, y, "1 0 0 1"))
        seen = centroid(take_image(scene, params)[..., 0] > 128)
        optical = np.array([[-y, -x, HEIGHT_M - 0.002]])
        expected, _ = cv2.projectPoints(
            optical, np.zeros(3), np.zeros(3), k.matrix(), np.array(BARREL)
        )
        assert np.abs(seen - expected.ravel()).max() < 0.7, (x, y)
        straight = k.matrix() @ optical[0] / optical[0, 2]
        if abs(y) > 10.0:
            assert np.abs(seen - straight[:2]).max() > 5.0


def test_undistort_inverts_distort() -> None:
    k = intrinsics_of(CameraParams(distortion=BARREL))
    ideal = np.stack(np.meshgrid(np.linspace(-0.7, 0.7, 31), np.linspace(-0.4, 0.4, 21)), axis=-1)
    np.testing.assert_allclose(undistorted(distorted(ideal, k), k), ideal, atol=1e-10)
    by_opencv, _ = cv2.projectPoints(
        np.concatenate([ideal.reshape(-1, 2), np.ones((ideal[..., 0].size, 1))], axis=1),
        np.zeros(3),
        np.zeros(3),
        np.eye(3),
        k.distortion,
    )
    np.testing.assert_allclose(distorted(ideal, k).reshape(-1, 2), by_opencv[:, 0], atol=1e-12)


FISHEYE = CameraParams(
    noise_sigma=0.0, lens="fisheye", width=640, height=480, fov_x_deg=110.0, fov_y_deg=82.5,
    distortion=(-0.02, 0.004, -0.001, 0.0002, 0.0),
)  # fmt: skip


def test_a_fisheye_draws_where_opencv_puts_it() -> None:
    """Spots up to 60 degrees from the axis, and all coefficients both ways."""
    k = intrinsics_of(FISHEYE)
    for x, y in [(0.0, 0.0), (10.0, 20.0), (-8.0, -25.0), (12.0, -3.0)]:
        place = f'size="0.5 0.5 0.001" pos="{x} {y} 0.001"'
        scene = make_scene(f'<geom name="spot" type="box" {place} rgba="1 0 0 1"/>')
        seen = centroid(take_image(scene, FISHEYE)[..., 0] > 128)
        optical = np.array([[[-y, -x, HEIGHT_M - 0.002]]])
        expected, _ = cv2.fisheye.projectPoints(
            optical, np.zeros(3), np.zeros(3), k.matrix(), k.distortion[:4]
        )
        assert np.abs(seen - expected.ravel()).max() < 0.7, (x, y)
        np.testing.assert_allclose(project(k, optical[0])[0], expected[0], atol=1e-9)
    plane = np.stack(np.meshgrid(np.linspace(-2.0, 2.0, 21), np.linspace(-1.0, 1.0, 11)), axis=-1)
    np.testing.assert_allclose(undistorted(distorted(plane, k), k), plane, atol=1e-6)


@pytest.mark.parametrize(("params", "message"), [
    (CameraParams(distortion=(-2.0, 0.0, 0.0, 0.0, 0.0)), r"folds the image"),
    (CameraParams(distortion=(-0.35, 0.0, 0.0, 0.0, 0.0), fov_x_deg=110.0), r"folds|raster"),
    (CameraParams(lens="fisheye", distortion=(0.0, 0.0, 0.0, 0.0, 0.1)), "fifth number 0"),
    (CameraParams(lens="fisheye", fov_x_deg=145.0, fov_y_deg=80.0), "raster"),
    (CameraParams(distortion=(np.nan, 0.0, 0.0, 0.0, 0.0)), r"camera\.distortion"),
])  # fmt: skip
def test_impossible_cameras_are_refused(params: CameraParams, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        CameraSensor(make_scene(), params, 0)


def test_gain_multiplies_light() -> None:
    """Two stops (gain 4) raise a display level by 4^(1/2.2) = 1.878, and clip at white."""
    scene = make_scene(box("white", 4.0, 0.0, "0.8 0.8 0.8 1"), floor="0.25 0.25 0.25 1")
    plain, bright = (take_image(scene, CameraParams(noise_sigma=0.0, gain=g)) for g in (1.0, 4.0))
    dark = plain[..., 0] < 100
    np.testing.assert_allclose(bright[dark], np.rint(plain[dark] * 4.0 ** (1 / 2.2)), atol=1)
    assert (bright[~dark] == 255).all()


def test_auto_exposure_brings_the_mean_to_middle_grey_within_its_range() -> None:
    auto = CameraParams(noise_sigma=0.0, auto_exposure=True)
    for shade in ("0.3 0.3 0.3 1", "0.7 0.7 0.7 1"):
        assert take_image(make_scene(floor=shade), auto).mean() == pytest.approx(110.0, abs=1.0)
    night = take_image(make_scene(floor="0.04 0.04 0.04 1"), auto)
    plain = take_image(make_scene(floor="0.04 0.04 0.04 1"))
    assert night.mean() == pytest.approx(plain.mean() * 4.0 ** (1 / 2.2), abs=1.0)


def test_readout_must_fit_the_clock() -> None:
    assert readout_ticks(0.0, SimParams()) == 0
    assert readout_ticks(0.02, SimParams()) == 12
    with pytest.raises(ValueError, match=r"camera\.readout_s is 0\.04.*every 0\.03333 s"):
        readout_ticks(0.04, SimParams())


def image_elsewhere(**environment: str) -> subprocess.CompletedProcess[str]:
    """An image taken in a process of its own, without a display: GL libraries are loaded once."""
    script = (
        "from support.camera_support import *; import os; "
        "p = take_image(make_scene(floor='0 0 1 1')); "
        "print(os.environ['MUJOCO_GL'], int(p[..., 2].min() > 200))"
    )
    return python("-c", script, env=without_display(PYTHONPATH=".:tests", **environment))


def test_osmesa_takes_over_where_egl_fails() -> None:
    """EGL is set to use a device that does not exist."""
    done = image_elsewhere(MUJOCO_EGL_DEVICE_ID="999")
    if "no offscreen rendering on this machine" in done.stderr:
        assert all(f"{name}: " in done.stderr for name in ("egl", "osmesa", "glfw"))
        pytest.skip("OSMesa is not installed")
    assert done.returncode == 0, done.stderr
    assert done.stdout.split()[-2:] == ["osmesa", "1"]
