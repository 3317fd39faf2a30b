"""Rolling shutter: instants of rows, landmarks of a moving camera, and the pose of its image."""

import cv2
import numpy as np
import pytest

from touchdown.estimator.filtering.camera_model import Shutter, rows_of_keyframe
from touchdown.estimator.filtering.error_state import STATE_DIM
from touchdown.estimator.filtering.eskf import Eskf
from touchdown.estimator.filtering.imu_propagation import NavState
from touchdown.estimator.filtering.keyframes import bearing_rays
from touchdown.estimator.filtering.online_calibration import exposed
from touchdown.estimator.livo.patch_tracker import grey_levels
from touchdown.sim.frames import Pose, so3_exp, so3_log

from support.livo_support import CAMERA, IMU_FROM_CAMERA, add_keyframe, front_end, ground_returns

SHUTTER = Shutter(0.015)
ROWS = np.arange(CAMERA.height, dtype=float)


def poses_at(pose: Pose, motion: np.ndarray, times: np.ndarray) -> list[Pose]:
    """odom_from_camera at each of ``times`` after the stamp."""
    count = len(times)
    taken = exposed([pose] * count, np.tile(motion, (count, 1)), times, np.zeros(0))
    return [moved @ IMU_FROM_CAMERA for moved in taken]


def seen(point: np.ndarray, pose: Pose, motion: np.ndarray) -> tuple[np.ndarray, float]:
    """Pixel (2,) where the row that looks at ``point`` sees it, and its depth."""
    row = 0.5 * CAMERA.height
    for _ in range(50):
        time = SHUTTER.row_times(np.array([row]), CAMERA.height)
        (camera,) = poses_at(pose, motion, time)
        x, y, z = camera.inverse().apply(point)
        row = CAMERA.fy * y / z + CAMERA.cy
    return np.array([CAMERA.fx * x / z + CAMERA.cx, row]), float(z)


def moving(rng: np.random.Generator) -> tuple[Pose, np.ndarray]:
    pose = Pose(so3_exp(rng.normal(0.0, 0.1, 3)), np.array([1.0, -2.0, 20.0]))
    return pose, np.concatenate([rng.uniform(-1.0, 1.0, 3), [9.0, -4.0, 2.0]])


def test_the_last_row_is_exposed_at_the_stamp() -> None:
    times = SHUTTER.row_times(np.array([0.0, 119.5, 239.0]), CAMERA.height)
    np.testing.assert_allclose(times, [-0.015, -0.0075, 0.0], atol=1e-12)
    assert SHUTTER.middle_s == -0.0075 and not Shutter().row_times(ROWS, CAMERA.height).any()


def test_a_landmark_seen_by_a_moving_camera_is_found() -> None:
    rng = np.random.default_rng(1)
    pose, motion = moving(rng)
    points = np.column_stack([rng.uniform(-6, 8, 40), rng.uniform(-7, 3, 40), np.zeros(40)])
    views = [seen(point, pose, motion) for point in points]
    pixels, depths = np.array([v[0] for v in views]), np.array([v[1] for v in views])
    own = np.concatenate([motion[:3], pose.rotation.T @ motion[3:]])
    rays = bearing_rays(pixels, CAMERA)
    times = SHUTTER.row_times(pixels[:, 1], CAMERA.height)
    turned, starts = rows_of_keyframe(rays, own, IMU_FROM_CAMERA, times)
    truth = (pose @ IMU_FROM_CAMERA).inverse().apply(points)
    np.testing.assert_allclose(starts + turned * depths[:, None], truth, atol=1e-3)
    assert np.abs(rays * depths[:, None] - truth).max() > 0.1
    still, nowhere = rows_of_keyframe(rays, own, IMU_FROM_CAMERA, np.zeros(40))
    np.testing.assert_array_equal(still, rays)
    assert not nowhere.any()


def texture() -> np.ndarray:
    """Ground of 40 x 40 m, 2 cm a texel, without detail finer than a pixel from 15 m."""
    rng = np.random.default_rng(3)
    image = np.zeros((2000, 2000), dtype=np.float32)
    for size in (50, 200, 400):
        coarse = rng.standard_normal((size, size)).astype(np.float32)
        image += cv2.resize(coarse, (2000, 2000), interpolation=cv2.INTER_CUBIC)
    return np.asarray(np.clip(128.0 + 35.0 * image, 0, 255), dtype=np.float32)


def rolling_view(ground: np.ndarray, pose: Pose, motion: np.ndarray) -> np.ndarray:
    """The plane z = 0, each row from where the camera is at its instant."""
    cameras = poses_at(pose, motion, SHUTTER.row_times(ROWS, CAMERA.height))
    columns = np.arange(CAMERA.width, dtype=float)
    x, y = np.empty((2, CAMERA.height, CAMERA.width), np.float32)
    for row, camera in enumerate(cameras):
        pixels = np.column_stack([columns, np.full(CAMERA.width, float(row))])
        rays = bearing_rays(pixels, CAMERA) @ camera.rotation.T
        hit = camera.translation - rays * (camera.translation[2] / rays[:, 2])[:, None]
        x[row], y[row] = (hit[:, 0] + 20.0) / 0.02, (hit[:, 1] + 20.0) / 0.02
    grey = cv2.remap(ground, x, y, cv2.INTER_LINEAR)
    return np.repeat(grey.astype(np.uint8)[:, :, None], 3, axis=2)


@pytest.mark.parametrize("known", [True, False])
def test_the_pose_of_a_rolling_image_is_recovered(known: bool) -> None:
    """Keyframe and image are taken in flight the opposite way, turning the opposite way; taken for
    images of one instant, they would shift the vehicle by the way of half a readout, twice."""
    ground = texture()
    key, now = Pose(np.eye(3), np.array([0.0, 0.0, 15.0])), Pose(
        so3_exp(np.array([0.02, -0.01, 0.05])), np.array([2.0, 1.0, 14.5])
    )  # fmt: skip
    there = np.array([0.2, -0.3, 0.3, 8.0, 3.0, 0.0])
    zero = np.zeros(3)
    vision, recent = front_end(SHUTTER if known else None), ground_returns(0.0)
    eskf = Eskf(
        NavState(0, key.rotation, key.translation, there[3:], zero, zero), np.full(STATE_DIM, 1e-8)
    )
    eskf.rate = there[:3]
    assert add_keyframe(vision, eskf, grey_levels(rolling_view(ground, key, there)), recent, 0)
    offset = np.array([0.06, -0.05, 0.02])
    eskf.state = NavState(60, now.rotation, now.translation + offset, -there[3:], zero, zero)
    eskf.rate = -there[:3]
    eskf.covariance[:6, :6] += np.diag([1e-6] * 3 + [1e-2] * 3)
    report = vision.update(eskf, grey_levels(rolling_view(ground, now, -there)))
    assert report.used > 50
    error = np.linalg.norm(eskf.state.position - now.translation)
    if known:
        assert error < 0.025 and report.rms_px < 0.3
        assert np.degrees(np.abs(so3_log(now.rotation.T @ eskf.state.rotation)).max()) < 0.06
    else:
        assert error > 0.06
