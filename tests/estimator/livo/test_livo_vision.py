"""Patch tracking, landmark planes, keyframes and the reprojection update on rendered planes."""

from dataclasses import replace
from unittest import mock

import cv2
import numpy as np
import pytest

from touchdown.estimator.filtering.error_state import (
    CALIBRATION_DIM,
    CENTER,
    MOUNT_TRANSLATION,
    STATE_DIM,
    Frame,
    Pinhole,
)
from touchdown.estimator.filtering.eskf import Eskf
from touchdown.estimator.filtering.imu_propagation import NavState
from touchdown.estimator.filtering.keyframes import Overlap, choose, detect_features, most_redundant
from touchdown.estimator.filtering.landmark_depth import RecentReturns, feature_planes
from touchdown.estimator.filtering.reprojection import (
    LandmarkViews,
    MountedCamera,
    PixelNoise,
    calibrated_information,
    depth_corrections,
    reprojection_information,
)
from touchdown.estimator.livo.patch_tracker import grey_levels, track
from touchdown.estimator.livo.visual import VisualReport
from touchdown.sim.frames import BODY_FROM_DOWNWARD_OPTICAL, Pose, so3_exp, so3_log

from support.livo_support import CAMERA, IMU_FROM_CAMERA, add_keyframe, front_end, ground_returns

LENS = Pinhole.of(CAMERA)


def texture() -> np.ndarray:
    """Ground of 40 x 40 m, 2 cm a texel, detail at several scales."""
    rng = np.random.default_rng(3)
    image = np.zeros((2000, 2000), dtype=np.float32)
    for size in (50, 200, 500, 1000):
        coarse = rng.standard_normal((size, size)).astype(np.float32)
        image += cv2.resize(coarse, (2000, 2000), interpolation=cv2.INTER_CUBIC)
    return np.clip(128.0 + 30.0 * image, 0, 255).astype(np.uint8)


TEXTURE = texture()


def view(world_from_camera: Pose) -> np.ndarray:
    """What the camera sees of the plane z = 0; texel (row i, column j) lies at
    (0.02 j - 20, 0.02 i - 20)."""
    world_from_texel = np.array([[0.02, 0.0, -20.0], [0.0, 0.02, -20.0], [0.0, 0.0, 1.0]])
    inverse = world_from_camera.inverse()
    flat = np.column_stack([inverse.rotation[:, :2], inverse.translation])
    grey = cv2.warpPerspective(
        TEXTURE, CAMERA.matrix() @ flat @ world_from_texel, (CAMERA.width, CAMERA.height),
        flags=cv2.INTER_AREA,
    )  # fmt: skip
    return np.repeat(grey[:, :, None], 3, axis=2)


def plane_in(world_from_camera: Pose) -> np.ndarray:
    """(3,) ``n . P = 1`` of the plane z = 0 in the camera's frame."""
    return -world_from_camera.rotation[2] / world_from_camera.translation[2]


def imu_pose(xyz: tuple[float, float, float], turn: tuple[float, float, float]) -> Pose:
    return Pose(so3_exp(np.array(turn)), np.array(xyz, float))


def test_patches_are_found_to_a_tenth_of_a_pixel_under_scale_and_turn() -> None:
    key = imu_pose((0.0, 0.0, 12.0), (0.0, 0.0, 0.0)) @ IMU_FROM_CAMERA
    now = imu_pose((1.5, -0.8, 10.0), (0.03, -0.02, 0.15)) @ IMU_FROM_CAMERA
    source, target = grey_levels(view(key)), grey_levels(view(now))
    pixels = detect_features(source[0], 100)
    planes = np.tile(plane_in(key), (len(pixels), 1))
    guess = Pose(now.rotation, now.translation + np.array([0.04, -0.03, 0.0]))
    moves = [Frame.of(pose.inverse() @ key) for pose in (guess, now)]
    found, tracked, predicted = track(source, target, pixels, planes, moves[0], LENS)
    _, _, truth = track(source, target, pixels, planes, moves[1], LENS)
    assert found.sum() > 40 and np.linalg.norm(predicted[found] - truth[found], axis=1).mean() > 1.0
    error = tracked[found] - truth[found]
    assert np.abs(np.median(error, axis=0)).max() < 0.05
    assert np.median(np.linalg.norm(error, axis=1)) < 0.15


def test_other_ground_is_not_taken_for_that_of_the_keyframe() -> None:
    key = imu_pose((0.0, 0.0, 12.0), (0.0, 0.0, 0.0)) @ IMU_FROM_CAMERA
    source, other = grey_levels(view(key)), grey_levels(view(key)[::-1, ::-1].copy())
    pixels = detect_features(source[0], 100)
    planes = np.tile(plane_in(key), (len(pixels), 1))
    fractions = [
        track(source, target, pixels, planes, Frame.of(Pose.identity()), LENS)[0].mean()
        for target in (source, other)
    ]
    assert fractions[0] > 0.9 and fractions[1] < 0.1


def test_feature_planes_fit_a_slope_and_refuse_a_step() -> None:
    rng = np.random.default_rng(4)
    normal = np.array([0.1, -0.05, 1.0])
    x, y = rng.uniform(-8, 8, (2, 12_000))
    z = (20.0 - normal[0] * x - normal[1] * y) / normal[2]
    z = np.where(x > 4.0, z - 2.5, z)  # a step in depth
    recent = RecentReturns(scans=2, per_scan=12_000)
    recent.add(np.column_stack([x, y, z]) + rng.normal(0.0, 0.02, (12_000, 3)))
    rays = np.array([[0.0, 0.0], [-0.2, 0.15], [0.213, 0.05], [0.34, 0.0]])
    valid, planes, sigmas = feature_planes(
        rays, recent, Pose.identity(), (0.68, 0.38), radius=16.0 / 617.0
    )
    np.testing.assert_array_equal(valid & (sigmas == 0.0), [True, True, False, True])
    rays3 = np.column_stack([rays[:2], np.ones(2)])
    depth = 1.0 / np.einsum("ij,ij->i", rays3, planes[:2])
    np.testing.assert_allclose(depth, 20.0 / (rays3 @ normal), atol=0.02)


def test_a_step_in_depth_right_behind_a_feature_makes_no_plane() -> None:
    """2.5 m between the returns on its left and those on its right."""
    rays = np.random.default_rng(5).uniform(-0.3, 0.3, (8_000, 2))
    depth = np.where(rays[:, 0] > 0.1, 17.5, 20.0)
    recent = RecentReturns(scans=1, per_scan=8_000)
    recent.add(np.column_stack([rays, np.ones(8_000)]) * depth[:, None])
    valid, _, sigmas = feature_planes(
        np.array([[0.0, 0.0], [0.1, 0.0], [0.2, 0.0]]), recent, Pose.identity(), (0.68, 0.38),
        radius=16.0 / 617.0,
    )  # fmt: skip
    np.testing.assert_array_equal(valid & (sigmas == 0.0), [True, False, True])


def test_a_feature_in_foliage_gets_the_foremost_depth_and_a_sigma() -> None:
    rng = np.random.default_rng(6)
    # two thirds of the returns from a crown at 18 m, 0.3 m deep, the others from 0.9 m below
    x, y = rng.uniform(-6, 6, (2, 12_000))
    z = np.where(rng.random(12_000) < 2 / 3, rng.normal(18.0, 0.3, 12_000), 18.9)
    recent = RecentReturns(scans=2, per_scan=12_000)
    recent.add(np.column_stack([x, y, z]))
    rays = np.array([[0.0, 0.0], [0.1, -0.1], [0.6, 0.0]])  # no returns around the last
    valid, planes, sigmas = feature_planes(
        rays, recent, Pose.identity(), (0.68, 0.38), radius=48.0 / 617.0
    )
    np.testing.assert_array_equal(valid, [True, True, False])
    rays3 = np.column_stack([rays[:2], np.ones(2)])
    depth = 1.0 / np.einsum("ij,ij->i", rays3, planes[:2])
    np.testing.assert_allclose(depth, 18.0, atol=0.15)
    # twice the scatter of the nearer two thirds
    np.testing.assert_allclose(sigmas[:2], 0.6, atol=0.2)
    for ray, plane in zip(rays3, planes[:2], strict=True):
        np.testing.assert_allclose(np.cross(ray, plane), 0.0, atol=1e-12)  # faces the camera


def test_a_pixel_beyond_the_gate_does_not_count() -> None:
    pose, camera = imu_pose((0, 0, 20), (0, 0, 0)), MountedCamera(CAMERA, IMU_FROM_CAMERA)
    landmarks = np.array([[1.5, -1.0, -19.0], [-2.0, 0.5, -19.0]])
    x, y, z = IMU_FROM_CAMERA.inverse().apply(landmarks).T
    pixels = np.column_stack([CAMERA.fx * x / z + CAMERA.cx, CAMERA.fy * y / z + CAMERA.cy])
    pixels[1] += [4.0, 4.0]

    def measured(count: int) -> tuple[np.ndarray, int]:
        found = reprojection_information(
            pixels[:count], landmarks[:count], pose, pose, camera, sigma_px=1.0, gate_px=5.0
        )
        return found.information, found.used

    np.testing.assert_array_equal(measured(2)[0], measured(1)[0])
    assert measured(2)[1] == 1


def filter_at(pose: Pose) -> Eskf:
    zero = np.zeros(3)
    variances = np.full(STATE_DIM, 1e-8)
    return Eskf(NavState(0, pose.rotation, pose.translation, zero, zero, zero), variances)


def test_image_update_recovers_a_known_offset() -> None:
    key, now = imu_pose((0, 0, 15), (0, 0, 0)), imu_pose((2.0, 1.0, 14.5), (0.02, -0.01, 0.05))
    vision, eskf = front_end(), filter_at(key)
    assert add_keyframe(vision, eskf, grey_levels(view(key @ IMU_FROM_CAMERA)), ground_returns(), 0)
    offset = np.array([0.001, -0.001, 0.004, 0.06, -0.05, 0.02])
    state = eskf.state
    eskf.state = NavState(
        60, now.rotation @ so3_exp(offset[:3]), now.translation + offset[3:], state.velocity,
        state.gyro_bias, state.accel_bias,
    )  # fmt: skip
    eskf.covariance[:6, :6] += np.diag([1e-5] * 3 + [1e-2] * 3)
    with mock.patch.object(vision, "_accumulate", wraps=vision._accumulate) as steps:
        report = vision.update(eskf, grey_levels(view(now @ IMU_FROM_CAMERA)))
    assert report.used > 50 and report.rms_px < 0.5
    assert steps.call_count == 3  # a fourth would hardly move the pose
    # 150 features at 15 m: millimetres, apart from the tilt that a plane hides in x and y
    np.testing.assert_allclose(eskf.state.position, now.translation, atol=0.025)
    assert np.degrees(np.abs(so3_log(now.rotation.T @ eskf.state.rotation)[2])) < 0.02
    assert eskf.covariance[3, 3] < 1e-3


def test_uncertain_depths_weaken_what_a_baseline_measures() -> None:
    """2 m aside at 15 m, a metre of depth is 2.8 pixels of 0.5; of the turn it hides nothing."""
    key, now = imu_pose((0, 0, 15), (0, 0, 0)), imu_pose((2.0, 0.0, 15.0), (0, 0, 0))
    sigmas = []
    for depth_sigma_m in (0.0, 1.0):
        vision, eskf = front_end(depth_sigma_m=depth_sigma_m), filter_at(key)
        add_keyframe(vision, eskf, grey_levels(view(key @ IMU_FROM_CAMERA)), ground_returns(), 0)
        eskf.state = filter_at(now).state
        eskf.covariance[3, 3] += 1.0
        assert vision.update(eskf, grey_levels(view(now @ IMU_FROM_CAMERA))).used > 50
        sigmas.append(np.sqrt(eskf.covariance[3, 3]))
    assert 3.0 < sigmas[1] / sigmas[0] < 7.0


def test_landmarks_follow_the_mount_that_is_found_after_them() -> None:
    """Returns half a metre too low, by a LIDAR that turns out to sit half a metre higher: at 15 m
    they would bring the vehicle 6 cm too far aside."""
    key, now = imu_pose((0, 0, 15), (0, 0, 0)), imu_pose((2.0, 0.0, 15.0), (0, 0, 0))
    low = RecentReturns(scans=1, per_scan=60_000)
    low.add(ground_returns().points() - [0.0, 0.0, 0.5])
    variances = np.full(STATE_DIM + CALIBRATION_DIM, 1e-12)
    state = replace(filter_at(key).state, calibration=np.zeros(CALIBRATION_DIM))
    eskf, vision = Eskf(state, variances), front_end()
    assert add_keyframe(vision, eskf, grey_levels(view(key @ IMU_FROM_CAMERA)), low, 0)
    found = np.zeros(CALIBRATION_DIM)
    found[MOUNT_TRANSLATION] = [0.0, 0.0, 0.5]
    start = now.translation + np.array([0.05, -0.04, 0.0])
    eskf.state = replace(filter_at(now).state, position=start, calibration=found)
    eskf.covariance[3:6, 3:6] += 1e-2 * np.eye(3)
    assert vision.update(eskf, grey_levels(view(now @ IMU_FROM_CAMERA))).used > 50
    np.testing.assert_allclose(eskf.state.position[:2], now.translation[:2], atol=0.015)


@pytest.mark.parametrize(("shared_m", "moved_m"), [(0.0, -0.077), (0.3, 0.0)])
def test_a_climb_is_not_measured_by_depths_that_share_an_error(
    shared_m: float, moved_m: float
) -> None:
    """Returns from plants 0.1 m above the ground that the images show: from 4 to 7 m, whose depths
    have the ratio 1.75, they would make a climb of 2.92 m."""
    key, now = imu_pose((0, 0, 4), (0, 0, 0)), imu_pose((0.2, 0.0, 7.0), (0, 0, 0.2))
    high = RecentReturns(scans=1, per_scan=60_000)
    high.add(ground_returns().points() + [0.0, 0.0, 0.1])
    variances = np.full(STATE_DIM + CALIBRATION_DIM, 1e-10)
    state = replace(filter_at(key).state, calibration=np.zeros(CALIBRATION_DIM))
    eskf, vision = Eskf(state, variances), front_end(depth_shared_sigma_m=shared_m)
    assert add_keyframe(vision, eskf, grey_levels(view(key @ IMU_FROM_CAMERA)), high, 0)
    turned = now.rotation @ so3_exp(np.array([0.0, 0.0, 0.004]))
    eskf.state = replace(state, rotation=turned, position=now.translation)
    eskf.covariance[2, 2] += 1e-4
    eskf.covariance[5, 5] += 0.05**2
    assert vision.update(eskf, grey_levels(view(now @ IMU_FROM_CAMERA))).used > 50
    assert eskf.state.position[2] - 7.0 == pytest.approx(moved_m, abs=0.015)
    # the heading is measured all the same
    assert np.degrees(abs(so3_log(now.rotation.T @ eskf.state.rotation)[2])) < 0.02


def test_a_keyframe_has_a_height_error_of_its_own() -> None:
    vision, eskf = front_end(anchor_height_m=0.05), filter_at(imu_pose((0, 0, 15), (0, 0, 0)))
    vision.append(eskf, vision.new_anchor(eskf, 15.0, 0), None)
    own = np.diag(eskf.covariance)[eskf.clone_indices(0)]
    np.testing.assert_allclose(own, [1e-8] * 5 + [1e-8 + 0.05**2])


def test_an_image_is_tracked_from_old_keyframes_as_well_as_the_newest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    vision, returns = front_end(), ground_returns()
    eskf = filter_at(imu_pose((0, 0, 15), (0, 0, 0)))
    for k in range(2):
        pose = imu_pose((1.0 * k, 0.0, 15.0), (0, 0, 0))
        eskf.state = filter_at(pose).state
        assert add_keyframe(vision, eskf, grey_levels(view(pose @ IMU_FROM_CAMERA)), returns, k)
    report = vision.update(eskf, grey_levels(view(pose @ IMU_FROM_CAMERA)))
    assert report.keyframes_tracked == 2
    monkeypatch.setattr("touchdown.estimator.livo.visual._LAST_FEW", 1)
    newest = front_end(use_closures=False)
    newest.keyframes = vision.keyframes
    report = newest.update(eskf, grey_levels(view(pose @ IMU_FROM_CAMERA)))
    assert report.keyframes_tracked == 1


@pytest.mark.parametrize(("minimum", "tracked"), [(0.35, 2), (0.6, 1), (0.9, 0)])
def test_in_a_climb_images_are_tracked_from_keyframes_far_below(
    minimum: float, tracked: int
) -> None:
    """From 4 and 8 m, seen from 10 m; the pose is 6 cm and 0.2 degrees of heading off."""
    vision, returns = front_end(track_scale=minimum), ground_returns()
    eskf = filter_at(imu_pose((0, 0, 4), (0, 0, 0)))
    for k, height_m in enumerate((4.0, 8.0)):
        pose = imu_pose((0.0, 0.0, height_m), (0, 0, 0.6 * k))
        eskf.state = filter_at(pose).state
        assert add_keyframe(vision, eskf, grey_levels(view(pose @ IMU_FROM_CAMERA)), returns, k)
    now = imu_pose((0.3, 0.0, 10.0), (0, 0, 0.9))
    start = imu_pose((0.36, 0.0, 10.0), (0, 0, 0.9035))
    eskf.state = filter_at(start).state
    eskf.covariance[:6, :6] += np.diag([1e-4] * 3 + [1e-2] * 3)
    report = vision.update(eskf, grey_levels(view(now @ IMU_FROM_CAMERA)))
    assert report.keyframes_tracked == tracked
    if tracked:
        turn = so3_log(now.rotation.T @ eskf.state.rotation)
        np.testing.assert_allclose(eskf.state.position, now.translation, atol=0.03)
        assert np.degrees(abs(turn[2])) < 0.03


def test_a_black_image_changes_nothing_and_is_counted() -> None:
    key = imu_pose((0, 0, 15), (0, 0, 0))
    vision, eskf = front_end(), filter_at(key)
    add_keyframe(vision, eskf, grey_levels(view(key @ IMU_FROM_CAMERA)), ground_returns(), 0)
    before = eskf.covariance.copy()
    black = np.zeros((CAMERA.height, CAMERA.width, 3), dtype=np.uint8)
    report = vision.update(eskf, grey_levels(black))
    assert report.used == 0
    np.testing.assert_array_equal(eskf.covariance, before)
    assert not vision.wants_keyframe(report, 60) and vision.wants_keyframe(VisualReport(), 1200)


def test_keyframes_are_bounded_and_their_clones_go_with_them() -> None:
    vision, returns = front_end(), ground_returns()
    eskf = filter_at(imu_pose((0, 0, 15), (0, 0, 0)))
    for k in range(7):
        pose = imu_pose((0.5 * k, 0.0, 15.0), (0, 0, 0))
        eskf.state = NavState(60 * k, pose.rotation, pose.translation, *(3 * [np.zeros(3)]))
        image = grey_levels(view(pose @ IMU_FROM_CAMERA))
        assert add_keyframe(vision, eskf, image, returns, 60 * k)
    assert len(vision.keyframes) == len(eskf.clones) == 4
    assert eskf.covariance.shape == (STATE_DIM + 24, STATE_DIM + 24)
    for keyframe, clone in zip(vision.keyframes, eskf.clones, strict=True):
        assert clone.translation[0] == 0.5 * keyframe.tick / 60


def test_a_plane_is_extended_only_on_demand() -> None:
    """22 m up, returns from a patch of 7 m right below: few features have a plane of their own."""
    rng = np.random.default_rng(8)
    recent = RecentReturns(scans=1, per_scan=20_000)
    recent.add(
        np.column_stack([rng.uniform(-3.5, 3.5, (20_000, 2)), rng.normal(0.0, 0.01, 20_000)])
    )
    pose = imu_pose((0, 0, 22), (0, 0, 0))
    image = grey_levels(view(pose @ IMU_FROM_CAMERA))
    vision, eskf = front_end(), filter_at(pose)
    assert not add_keyframe(vision, eskf, image, recent, 0, ground_m=21.8)
    assert not vision.keyframes and not eskf.clones and add_keyframe(vision, eskf, image, recent, 0)
    assert vision.keyframes[0].valid.sum() > 60 and not vision.keyframes[0].assumed.any()


def test_beyond_the_edge_of_the_ground_are_no_features() -> None:
    """25 m up over an edge: stars fill the rest of the image, brighter than anything on the ground,
    and give no returns. Where these are few, as over water, the plane is extended."""
    pose = imu_pose((0, 0, 25), (0, 0, 0))
    grey = view(pose @ IMU_FROM_CAMERA) // 4 + 60
    rng = np.random.default_rng(6)
    stars = np.zeros((240, 254, 3), np.uint8)
    stars[rng.integers(0, 240, 900), rng.integers(0, 254, 900)] = 255
    grey[:, 170:] = stars
    points = rng.uniform(-30.0, 30.0, (40_000, 3)) * [1.0, 1.0, 0.0]
    camera_from_odom = (pose @ IMU_FROM_CAMERA).inverse()
    seen = camera_from_odom.apply(points)
    col = CAMERA.fx * seen[:, 0] / seen[:, 2] + CAMERA.cx
    for edge_px, alone in ((170.0, True), (25.0, False)):
        recent = RecentReturns(scans=1, per_scan=40_000)
        recent.add(points[col < edge_px])
        vision, eskf = front_end(features=40), filter_at(pose)
        assert add_keyframe(vision, eskf, grey_levels(grey), recent, 0)
        (keyframe,) = vision.keyframes
        on_ground = keyframe.pixels[keyframe.valid, 0] < 178.0
        assert len(on_ground) > 30 and on_ground.all() == alone


def test_without_returns_features_lie_on_level_ground() -> None:
    """Seen from 20 m with a tilt of 6 degrees; the rangefinder says that the ground is at z = 2."""
    pose = imu_pose((3.0, -2.0, 20.0), (0.08, -0.06, 0.5))
    vision, eskf = front_end(), filter_at(pose)
    image = grey_levels(view(pose @ IMU_FROM_CAMERA))
    assert add_keyframe(vision, eskf, image, RecentReturns(scans=1, per_scan=10), 0, ground_m=2.0)
    (keyframe,) = vision.keyframes
    camera = pose @ IMU_FROM_CAMERA
    landmarks = keyframe.landmarks_camera(CAMERA)
    assert keyframe.valid.all() and keyframe.assumed.all()
    np.testing.assert_allclose(camera.apply(landmarks)[:, 2], 2.0, atol=1e-9)
    np.testing.assert_allclose(keyframe.sigmas, 0.4 * np.linalg.norm(landmarks, axis=1))
    assert keyframe.depth_m == pytest.approx(float(np.median(landmarks[:, 2])))


@pytest.mark.parametrize("centre_px", [0, 4])
def test_parallax_finds_the_depth_of_the_ground_and_no_more_than_the_floor(centre_px: int) -> None:
    """The ground is assumed 3 m too low, a sixth of 18 m; 6 m sideways and back show it, also by a
    lens whose centre was found to lie aside. What the returns have shown stays."""
    start, calibration = imu_pose((0.0, 0.0, 18.0), (0.0, 0.0, 0.0)), np.zeros(CALIBRATION_DIM)
    calibration[CENTER] = [0.0, centre_px]
    variances = np.full(STATE_DIM + CALIBRATION_DIM, 1e-8)
    variances[STATE_DIM:] = 1e-14
    eskf = Eskf(replace(filter_at(start).state, calibration=calibration), variances)

    def seen(pose: Pose) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return grey_levels(np.roll(view(pose @ IMU_FROM_CAMERA), centre_px, axis=0))

    vision, none = front_end(), RecentReturns(scans=1, per_scan=10)
    assert add_keyframe(vision, eskf, seen(start), none, 0, ground_m=-3.0)
    (keyframe,) = vision.keyframes
    keyframe.assumed[:5] = False
    planes = keyframe.planes.copy()
    for x in (1.0, 2.0, 4.0, 6.0, 3.0):
        pose = imu_pose((x, 0.0, 18.0), (0.0, 0.0, 0.0))
        eskf.state = replace(eskf.state, rotation=pose.rotation, position=pose.translation)
        assert vision.update(eskf, seen(pose)).used > 60
    moved = (start @ IMU_FROM_CAMERA).apply(keyframe.landmarks_camera(CAMERA))[5:]
    known = keyframe.sigmas[5:] < 0.39 * keyframe.depth_m
    assert known.sum() > 60 and float(np.median(np.abs(moved[known, 2]))) < 0.15
    np.testing.assert_array_equal(keyframe.planes[:5], planes[:5])
    assert keyframe.sigmas.min() == pytest.approx(0.16 * keyframe.depth_m)


@pytest.mark.parametrize(
    ("spot", "assumed", "expected_m"),
    [(None, 999, 3.88), ([0.0, 0.0, -18.0], 999, 4.0), ([0.0, 0.0, -18.0], 3, 3.88)],
)
def test_the_range_shows_a_way_that_parallax_alone_takes_for_3_percent_too_short(
    spot: list[float] | None, assumed: int, expected_m: float
) -> None:
    """With every way 3 % too short, 18 m down looks like 17.46 m, and the images agree. Where but
    three depths are assumed there is nothing to scale."""
    start = imu_pose((0.0, 0.0, 18.0), (0.0, 0.0, 0.0))
    vision, eskf, none = front_end(), filter_at(start), RecentReturns(scans=1, per_scan=10)
    image = grey_levels(view(start @ IMU_FROM_CAMERA))
    assert add_keyframe(vision, eskf, image, none, 0, ground_m=0.54)
    for x in (1.0, 2.0, 4.0, 4.0):
        eskf.state = filter_at(imu_pose((0.97 * x, 0.0, 18.0), (0.0, 0.0, 0.0))).state
        if x == 4.0:
            eskf.covariance[3, 3] = 0.3**2
            vision.keyframes[0].assumed[assumed:] = False
        image = grey_levels(view(imu_pose((x, 0.0, 18.0), (0.0, 0.0, 0.0)) @ IMU_FROM_CAMERA))
        at = np.array(spot) if x == 4.0 and spot else None
        assert vision.update(eskf, image, spot=at).used > 60
    assert eskf.state.position[0] == pytest.approx(expected_m, abs=0.05)


def test_a_wrong_depth_is_no_outlier_but_what_lies_beside_the_epipolar_line_is() -> None:
    """One landmark 10 m off of 20, after a move of 5 m along x; then the same error along y."""
    now, still = (
        Frame(np.eye(3), np.array([5.0, 0.0, 20.0])),
        Frame(np.eye(3), np.array([0, 0, 20.0])),
    )
    mount = Pose(BODY_FROM_DOWNWARD_OPTICAL, np.zeros(3)).inverse()
    camera = Frame.of(mount)
    landmark, spread = np.array([[2.0, 1.0, -20.0]]), np.array([[1.0, 0.5, -10.0]])
    true = mount.apply(landmark + 0.8 * spread - [5.0, 0.0, 0.0])
    pixel = true[:, :2] / true[:, 2:] * [LENS.fx, LENS.fy] + [LENS.cx, LENS.cy]
    assumed = mount.apply(landmark - [5.0, 0.0, 0.0])
    expected = assumed[:, :2] / assumed[:, 2:] * [LENS.fx, LENS.fy] + [LENS.cx, LENS.cy]
    error = pixel - expected
    assert np.linalg.norm(error) > 15.0
    for shift, used in ((error, 1), (error[:, ::-1] * [1.0, -1.0], 0)):
        views = LandmarkViews(expected + shift, np.zeros(1), landmark, np.zeros((1, 3, 0)), spread)
        found = calibrated_information(
            views, now, still, np.zeros((2, 6)), camera, LENS, PixelNoise(0.3, 6.0)
        )
        assert found.used == used
    views = views._replace(pixels=expected + error)
    ((moved, left),) = depth_corrections(
        views, now, still, np.zeros(6), camera, LENS, PixelNoise(0.3, 6.0)
    )
    # linear in the depth: from 20 to 28 m the disparity falls by less than 0.8 of that to 30 m
    assert 0.8 < moved < 1.0
    power = ((pixel - expected) ** 2).sum() / moved**2
    assert left == pytest.approx(0.3**2 / (0.3**2 + power), rel=0.3)


def test_the_keyframes_of_least_variance_and_largest_overlap_are_chosen() -> None:
    candidates = [
        Overlap(0, 0.40, 1.0), Overlap(1, 0.70, 1.0), Overlap(2, 0.90, 1.0),
        Overlap(3, 0.20, 1.0),
    ]  # fmt: skip
    variances = np.array([1.0, 2.0, 3.0, 0.5])
    assert choose(candidates, variances, 2, 0.35) == [0, 2]
    assert choose(candidates, variances, 3, 0.35) == [0, 2, 1]
    assert choose([], variances, 3, 0.35) == []


def test_of_a_close_pair_the_younger_goes() -> None:
    poses = [imu_pose((x, 0.0, 30.0), (0, 0, 0)) for x in (0.0, 10.0, 10.5, 20.0, 30.0, 40.0)]
    assert most_redundant(poses, [30.0] * 6) == 2
