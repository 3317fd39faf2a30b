"""Anchored maps and online calibration: derivatives, identities, and filter consistency."""

from dataclasses import replace

import numpy as np
import pytest

from touchdown.estimator.api import LivoParams
from touchdown.estimator.filtering.anchors import AnchorFrames, Anchors
from touchdown.estimator.filtering.error_state import (
    CALIBRATION_DIM,
    CAMERA_ROTATION,
    CAMERA_TRANSLATION,
    CLOCK,
    MOUNT_DIM,
    MOUNT_ROTATION,
    MOUNT_TRANSLATION,
    SHARED_DIM,
    STATE_DIM,
    Frame,
    Frames,
    Pinhole,
)
from touchdown.estimator.filtering.eskf import Eskf
from touchdown.estimator.filtering.imu_propagation import NavState
from touchdown.estimator.filtering.keyframes import bearing_rays
from touchdown.estimator.filtering.online_calibration import (
    corrected_camera,
    corrected_lens,
    corrected_mount,
    exposed,
    landmark_jacobians,
    prior_sigmas,
)
from touchdown.estimator.filtering.plane_map import PlaneMap, PlaneMatches
from touchdown.estimator.filtering.reprojection import (
    LandmarkViews,
    PixelNoise,
    calibrated_information,
)
from touchdown.estimator.livo.estimator import AnchoredMap
from touchdown.estimator.livo.scan_update import (
    Returns,
    ScanErrors,
    ScanNoise,
    plane_equations,
    scan_errors,
    update_with_scan,
)
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import BODY_FROM_DOWNWARD_OPTICAL, Pose, so3_exp, so3_log

from support.livo_flight import make_rig
from support.livo_support import filled_buffer, placed, random_state, room_points, state_at

CAMERA = CameraIntrinsics(width=848, height=480, fx=617.0, fy=625.0, cx=423.5, cy=239.5)
IMU_FROM_CAMERA = Pose(BODY_FROM_DOWNWARD_OPTICAL, np.array([0.05, 0.02, -0.1]))


def random_pose(rng: np.random.Generator, turn: float = 0.3) -> Pose:
    return Pose(so3_exp(rng.normal(0.0, turn, 3)), rng.normal(0.0, 2.0, 3))


def test_anchored_jacobian_matches_finite_differences() -> None:
    """One return now, one that made the plane from a clone with the same attitude as at that
    time; pose, calibration and clone are moved in turn."""
    rng = np.random.default_rng(1)
    now, clone = random_pose(rng), random_pose(rng)
    beam_now, beam_then, lever = rng.normal(0, 5, 3), rng.normal(0, 5, 3), rng.normal(0, 0.1, 3)
    normal = np.linalg.qr(rng.normal(size=(3, 3)))[0][0]
    in_clone = clone.rotation.T @ normal

    def height(delta: np.ndarray) -> float:
        turn, shift = so3_exp(delta[6:9]), delta[9:12]
        pose = Pose(now.rotation @ so3_exp(delta[:3]), now.translation + delta[3:6])
        owner = Pose(clone.rotation @ so3_exp(delta[-6:-3]), clone.translation + delta[-3:])
        point = owner.inverse().apply(pose.apply(turn @ beam_now + lever + shift))
        return float((turn @ in_clone) @ (point - (turn @ beam_then + lever + shift)))

    sensor, anchor = clone.apply(lever), clone.apply(beam_then + lever)
    planes = PlaneMatches(
        np.array([True]), normal[None], anchor[None], np.array([[1.0, 0.0, 0.0]]), sensor[None],
        np.zeros(1, np.int16),
    )  # fmt: skip
    here, only = Frames.of([Pose.identity()]), np.zeros(1, np.int64)

    def measured(change: np.ndarray) -> tuple[np.ndarray, np.ndarray, int, float]:
        """``change`` (6,): of the mount since the plane was made."""
        beam = so3_exp(change[:3]) @ beam_now
        anchors = AnchorFrames(here, Frames.of([clone]), change[None], only)
        return plane_equations(
            Returns((beam + lever + change[3:])[None], beam[None]), Frame.of(now), planes, anchors,
            1, SHARED_DIM, ScanNoise(0.02, 1e-3, 0.0, 1e9),
        )[:4]  # fmt: skip

    information, vector, used, _ = measured(np.zeros(6))
    size = 12 + SHARED_DIM
    gradient = np.array([(height(1e-6 * e) - height(-1e-6 * e)) / 2e-6 for e in np.eye(size)])
    assert used == 1
    np.testing.assert_allclose(information, np.outer(gradient, gradient), atol=1e-5)
    np.testing.assert_allclose(vector, -gradient * height(np.zeros(size)), atol=1e-4)
    change = 1e-3 * np.array([1.0, -2.0, 1.5, 3.0, -1.0, 2.0])
    delta = np.zeros(size)
    delta[6:12] = change
    assert measured(change)[3] == pytest.approx(abs(height(delta)), abs=2e-4)


def test_landmarks_move_with_the_rig_as_predicted() -> None:
    rng = np.random.default_rng(2)
    pixels = rng.uniform([0, 0], [848, 480], (5, 2))
    normals = np.column_stack([rng.normal(0, 0.2, (5, 2)), np.ones(5)])
    planes = normals / (20.0 * np.linalg.norm(normals, axis=1, keepdims=True))
    sensor = np.array([0.3, -0.5, 0.1])
    rotation = IMU_FROM_CAMERA.rotation
    twist = np.array([0.3, -0.6, 0.4, 7.0, 2.0, -1.0])

    def landmarks(calibration: np.ndarray) -> np.ndarray:
        """The plane through three returns around each landmark, met by a ray of a lens that is
        mounted a little differently."""
        fx, fy, cx, cy = corrected_lens(CAMERA, calibration)
        given = CameraIntrinsics(width=848, height=480, fx=fx, fy=fy, cx=cx, cy=cy)
        mount = corrected_camera(IMU_FROM_CAMERA, calibration)
        start = rotation.T @ (mount.translation - IMU_FROM_CAMERA.translation)
        rays = bearing_rays(pixels, given) @ (rotation.T @ mount.rotation).T
        turn = rotation.T @ so3_exp(calibration[:3]) @ rotation
        shift = rotation.T @ calibration[3:6]
        base = bearing_rays(pixels, CAMERA)
        centre = base / np.einsum("ij,ij->i", base, planes)[:, None]
        out = np.empty((5, 3))
        for i, n in enumerate(planes):
            moved_n = turn @ n
            through = turn @ (centre[i] - sensor) + sensor + shift
            # the same plane, from the camera's position at the exposure
            (taken,) = exposed([Pose.identity()], twist[None], np.zeros(1), calibration)
            early = IMU_FROM_CAMERA.inverse() @ taken.inverse() @ IMU_FROM_CAMERA
            moved_n, through = early.rotation @ moved_n, early.apply(through)
            out[i] = start + rays[i] * (moved_n @ (through - start)) / (moved_n @ rays[i])
        return out @ rotation.T

    jacobians = landmark_jacobians(
        bearing_rays(pixels, CAMERA), planes, sensor, Frame.of(IMU_FROM_CAMERA), twist,
        Pinhole.of(CAMERA),
    )  # fmt: skip
    assert jacobians.shape == (5, 3, SHARED_DIM)
    assert np.abs(jacobians[:, :, CAMERA_ROTATION]).max(axis=(0, 1)).min() > 1.0
    assert np.abs(jacobians[:, :, CAMERA_TRANSLATION]).max(axis=(0, 1)).min() > 0.01
    for k, step in enumerate(1e-5 * np.eye(SHARED_DIM)):
        moved = (landmarks(step) - landmarks(-step)) / 2e-5
        near = 2e-3 if k < 3 else 1e-4  # a turn about the sensor also turns the plane
        np.testing.assert_allclose(jacobians[:, :, k], moved, rtol=1e-4, atol=near)


@pytest.mark.parametrize("late_s", [0.0, -0.012, 0.15])
def test_calibrated_reprojection_matches_finite_differences(late_s: float) -> None:
    """``late_s``: instant of the row; at 0.15 s its turn is no longer small."""
    rng = np.random.default_rng(3)
    key, now = (
        Pose(so3_exp(rng.normal(0, 0.1, 3)), np.array([0.0, 0.0, 20.0])),
        Pose(so3_exp(rng.normal(0, 0.1, 3)), np.array([1.0, 2.0, 19.0])),
    )
    camera_from_imu = IMU_FROM_CAMERA.inverse()
    landmark, jacobian = np.array([1.5, -1.0, -19.0]), rng.normal(size=(3, SHARED_DIM))
    twists = rng.normal(0, 1, (2, 6))
    size = 12 + SHARED_DIM

    def pixel(delta: np.ndarray) -> np.ndarray:
        pose = Pose(now.rotation @ so3_exp(delta[:3]), now.translation + delta[3:6])
        owner = Pose(key.rotation @ so3_exp(delta[-6:-3]), key.translation + delta[-3:])
        calibration = delta[6:-6]
        point = landmark + jacobian @ calibration
        fx, fy, cx, cy = corrected_lens(CAMERA, calibration)
        pose, owner = exposed([pose, owner], twists, np.zeros(2), calibration)
        (at_row,) = exposed([pose], twists[:1], np.array([late_s]), np.zeros(0))
        camera = corrected_camera(IMU_FROM_CAMERA, calibration)
        x, y, z = (camera.inverse() @ at_row.inverse() @ owner).apply(point)
        return np.array([fx * x / z + cx, fy * y / z + cy])

    residual = np.array([0.05, -0.1])
    information, vector, used, _ = calibrated_information(
        LandmarkViews(
            (pixel(np.zeros(size)) + residual)[None], np.array([late_s]), landmark[None],
            jacobian[None], np.zeros((1, 3)),
        ),
        Frame.of(now), Frame.of(key), twists, Frame.of(camera_from_imu), Pinhole.of(CAMERA),
        PixelNoise(1.0, 1e6),
    )  # fmt: skip
    steps = 1e-6 * np.eye(size)
    gradient = np.column_stack([(pixel(step) - pixel(-step)) / 2e-6 for step in steps])
    assert used == 1
    np.testing.assert_allclose(information, gradient.T @ gradient, rtol=1e-3, atol=0.1)
    np.testing.assert_allclose(vector, gradient.T @ residual, rtol=1e-3, atol=1e-2)


def test_priors_and_errors_of_a_scan_are_in_the_units_of_the_state() -> None:
    """Degrees become radians; what a scan knows badly is y, not z, and yaw, not roll."""
    params = LivoParams(
        mount_rotation_sigma_deg=180.0, mount_translation_sigma_m=2.0, camera_clock_sigma_s=3.0,
        camera_rotation_sigma_deg=90.0, gyro_misalignment_sigma_deg=18.0, scan_tilt_sigma_deg=18.0,
        scan_yaw_sigma_deg=36.0, scan_lateral_sigma_m=0.3, scan_height_sigma_m=0.01,
        weak_sigma_deg=9.0, weak_sigma_m=0.7,
    )  # fmt: skip
    sigmas = prior_sigmas(params)
    assert len(sigmas) == CALIBRATION_DIM and sigmas[CLOCK] == 3.0
    np.testing.assert_allclose(sigmas[MOUNT_ROTATION], np.pi)
    np.testing.assert_allclose(sigmas[MOUNT_TRANSLATION], 2.0)
    np.testing.assert_allclose(sigmas[CAMERA_ROTATION], 0.5 * np.pi)
    np.testing.assert_allclose(sigmas[-15:-9], 0.1 * np.pi)
    np.testing.assert_array_equal(prior_sigmas(replace(params, prior_scale=4.0)), 4.0 * sigmas)
    rig = make_rig()
    rig = replace(rig, lidar=replace(rig.lidar, angle_sigma_deg=1.8, range_sigma_m=0.03))
    errors = scan_errors(rig, params)
    tenth = 0.1 * np.pi
    np.testing.assert_allclose(errors.floor_sigmas, [tenth, tenth, 2 * tenth, 0.3, 0.3, 0.01])
    assert errors.range_sigma_m == 0.03 and errors.weak_sigmas == (0.05 * np.pi, 0.7)
    assert errors.angle_sigma_rad == pytest.approx(0.01 * np.pi)


def test_calibration_is_carried_and_corrected() -> None:
    rng = np.random.default_rng(4)
    start = random_state(rng)
    state = NavState(
        0, start.rotation, start.position, start.velocity, start.gyro_bias, start.accel_bias,
        np.zeros(CALIBRATION_DIM),
    )  # fmt: skip
    base = STATE_DIM + CALIBRATION_DIM
    eskf = Eskf(state, np.full(base, 0.01))
    eskf.add_clone()
    eskf.propagate(filled_buffer(rng, 20), 20)
    np.testing.assert_allclose(np.diag(eskf.covariance)[STATE_DIM:base], 0.01)
    touched = eskf.touched([0])
    assert len(touched) == 6 + SHARED_DIM + 6
    row = rng.normal(size=len(touched))
    information, prior = np.outer(row, row), eskf.covariance.copy()
    delta = eskf.correction(touched, information, row)
    _, kept = eskf.boxplus(eskf.state, eskf.clones, delta)
    assert len(kept) == 1
    full = np.zeros(len(prior))
    full[touched] = row
    expected = prior @ full / (full @ prior @ full + 1.0)
    np.testing.assert_allclose(delta, expected, atol=1e-10)
    # not learning: the calibration stays, the rest moves as before and is as sure as before
    some = eskf.correction(touched, information, row, eskf.gains(0.0))[STATE_DIM:base]
    learnt = np.r_[CLOCK, SHARED_DIM:CALIBRATION_DIM]
    np.testing.assert_array_equal(some[learnt], delta[STATE_DIM:base][learnt])
    assert some[CLOCK] != 0.0
    np.testing.assert_array_equal(np.delete(some, learnt), 0.0)
    quarter, none = np.full(CALIBRATION_DIM, 0.25), np.zeros(CALIBRATION_DIM)
    part = eskf.correction(touched, information, row, quarter)[STATE_DIM:base]
    np.testing.assert_allclose(part, 0.25 * delta[STATE_DIM:base])
    partial = Eskf(state, np.full(base, 0.01))
    partial.covariance = prior.copy()
    partial.update_covariance(touched, information, quarter)
    # an estimate that takes a fraction keeps (1 - share)^2 of what full correction takes off
    lost = np.outer(expected, full @ prior)[STATE_DIM:base, STATE_DIM:base]
    kept_block = prior[STATE_DIM:base, STATE_DIM:base] - (1.0 - 0.75**2) * lost
    np.testing.assert_allclose(
        partial.covariance[STATE_DIM:base, STATE_DIM:base], kept_block, atol=1e-10
    )
    held = eskf.correction(touched, information, row, none)
    np.testing.assert_array_equal(held[STATE_DIM:base], 0.0)
    np.testing.assert_array_equal(held[:STATE_DIM], delta[:STATE_DIM])
    eskf.update_covariance(touched, information, none)
    shared = slice(STATE_DIM, base)
    np.testing.assert_array_equal(eskf.covariance[shared, shared], prior[shared, shared])
    posterior = prior - np.outer(expected, full @ prior)
    np.testing.assert_allclose(eskf.covariance[:15, :15], posterior[:15, :15], atol=1e-10)
    assert np.linalg.eigvalsh(eskf.covariance).min() > -1e-9


def test_a_loosely_coupled_filter_takes_the_pose_only() -> None:
    eskf = Eskf(state_at(np.eye(3), np.zeros(3)), np.ones(STATE_DIM))
    eskf.add_clone()
    information, vector = np.ones((12, 12)), np.ones(12)
    assert eskf.coupled(information, vector)[0] is information
    eskf.loosely_coupled = True
    left, gradient = eskf.coupled(information, vector)
    assert left.sum() == 36.0 and gradient.sum() == 6.0 and information.sum() == 144.0


def anchored_map(
    rng: np.random.Generator, clone: Pose, anchors: Anchors
) -> tuple[PlaneMap, np.ndarray]:
    plane_map = PlaneMap(1.0, capacity=1 << 14)
    surfaces = room_points(rng, walls=True)
    anchors.add(clone, np.zeros(0))
    plane_map.insert(surfaces + rng.normal(0, 0.01, surfaces.shape), clone.translation, 0)
    return plane_map, room_points(rng, walls=True)[::7]


@pytest.mark.parametrize("shift", [(0.0, 0.0, 0.0), (0.2, -0.1, 0.15)])
def test_a_scan_measures_the_pose_relative_to_the_clone_of_its_planes(
    shift: tuple[float, float, float],
) -> None:
    """The clone's own standard deviation of 5 cm stays with the pose; that of their difference
    becomes small. ``shift``: of the estimate of both since the map was made."""
    rng = np.random.default_rng(6)
    clone = Pose(np.eye(3), np.array([0.0, 0.0, 10.0]))
    eskf = Eskf(state_at(clone.rotation, clone.translation), np.full(STATE_DIM, 1e-8))
    eskf.covariance[3:6, 3:6] = 0.05**2 * np.eye(3)
    eskf.add_clone()
    anchors = Anchors()
    plane_map, world = anchored_map(rng, clone, anchors)
    position = np.array([0.4, 1.0, 12.0])
    eskf.state = state_at(np.eye(3), position + shift + np.array([0.05, -0.04, 0.06]))
    eskf.clones = [Pose(clone.rotation, clone.translation + shift)]
    eskf.covariance[3:6, 3:6] += 0.1**2 * np.eye(3)
    points = world - position
    update_with_scan(
        eskf, plane_map, anchors, placed(points),
        ScanErrors(range_sigma_m=0.02, angle_sigma_rad=1e-3, floor_sigmas=np.full(6, 1e-3)),
    )  # fmt: skip
    own = np.sqrt(np.diag(eskf.covariance)[3:6])
    np.testing.assert_allclose(own, 0.05, rtol=0.1)
    difference = np.zeros((3, len(eskf.covariance)))
    difference[:, 3:6], difference[:, 18:21] = np.eye(3), -np.eye(3)
    assert np.sqrt(np.diag(difference @ eskf.covariance @ difference.T)).max() < 5e-3
    gap = eskf.state.position - eskf.clones[0].translation
    np.testing.assert_allclose(gap, position - clone.translation, atol=0.01)


def test_the_map_follows_its_clone_and_the_successor() -> None:
    """Planes are at the present estimate of their clone; after its marginalisation they stay there,
    anchored to the nearest other clone."""
    rng = np.random.default_rng(7)
    first, second = (Pose(np.eye(3), np.array([x, 0.0, 10.0])) for x in (0.0, 3.0))
    anchors = Anchors()
    plane_map, _ = anchored_map(rng, first, anchors)
    anchors.add(second, np.zeros(0))
    moved = Pose(so3_exp(np.array([0.0, 0.0, 1e-3])), first.translation + [0.01, 0.02, -0.03])
    clones = [moved, Pose(second.rotation, second.translation + [0.0, 0.0, 0.02])]
    probes = np.column_stack([rng.uniform(-9, 9, (200, 2)), np.zeros(200)])

    def heights() -> np.ndarray:
        matched = plane_map.match(probes)
        rotations, translations = anchors.frames(clones, np.zeros(0), np.zeros(0, np.int64)).moves
        inside, owners = matched.centres[matched.found], matched.anchors[matched.found]
        turned = np.einsum("ij,ij->i", rotations[owners, 2], inside)
        return turned + translations[owners, 2]

    before = heights()
    np.testing.assert_allclose(np.median(before), -0.03, atol=2e-3)
    successor, move = anchors.reassignment(0, clones)
    assert successor == 1
    plane_map.reassign(0, successor, move)
    anchors.remove(0)
    del clones[0]
    assert (plane_map.match(probes).anchors <= 0).all()
    np.testing.assert_allclose(heights(), before, atol=1e-6)


def test_points_are_kept_relative_to_the_clone_as_it_was() -> None:
    """The clone has turned about z and moved since its creation, the mount has turned about the
    LIDAR and moved."""
    anchors, change = Anchors(), np.zeros(CALIBRATION_DIM)
    change[MOUNT_ROTATION], change[MOUNT_TRANSLATION] = [0.0, 0.0, 1e-4], [0.01, 0.0, 0.0]
    anchors.add(Pose(np.eye(3), np.array([1.0, 0.0, 9.0])), np.zeros(CALIBRATION_DIM))
    now = Pose(so3_exp(np.array([0.0, 0.0, np.pi / 2.0])), np.array([3.0, 1.0, 10.0]))
    sensor = np.array([3.0, 1.0, 9.0])
    (kept,) = anchors.as_kept(
        np.array([[3.0, 6.0, 0.0]]), sensor, now, change, so3_exp(np.array([0.0, 0.0, np.pi]))
    )
    # the beam, 5 m along y, turns back by 1e-4 about z; x of the IMU is -x
    before = np.array([3.0 + 5e-4 + 0.01, 6.0, 0.0])
    expected = np.array([before[1] - 1.0 + 1.0, -(before[0] - 3.0), -1.0])
    np.testing.assert_allclose(kept, expected, atol=1e-9)


@pytest.mark.parametrize(("late_ticks", "enters"), [(60, True), (90, False)])
def test_what_has_drifted_stays_out_of_the_map(late_ticks: int, enters: bool) -> None:
    """A scan 0.15 s after the clone, by an estimate that has drifted up by 5 cm, changes nothing,
    also where the map is still empty: the next scan sees the drift against what was there."""
    rng = np.random.default_rng(9)
    params = LivoParams(map_open_s=0.1, image_open_s=0.1)
    ground = AnchoredMap(params, np.zeros(3), 0, tick_hz=600)
    eskf = Eskf(state_at(np.eye(3), np.array([0.0, 0.0, 10.0])), np.full(STATE_DIM, 1e-4))
    eskf.add_clone()
    ground.begin(eskf, 10.0, 0)
    seen, bright = room_points(rng, walls=False) - [0.0, 0.0, 10.0], np.full(20_000, 9, np.uint8)
    near = seen[:, 0] < 0.0
    ground.extend(eskf, placed(seen[near]), bright[near], np.zeros(3))
    used, returns = ground.planes.used, int(ground.photometric.images[0].counts.sum())
    drifted = replace(eskf.state, tick=late_ticks, position=np.array([0.0, 0.0, 10.05]))
    eskf.state = drifted
    eskf.covariance[3:6, 3:6] += 0.1**2 * np.eye(3)
    ground.extend(eskf, placed(seen), bright, np.zeros(3))
    assert (ground.planes.used > used) == enters
    assert (int(ground.photometric.images[0].counts.sum()) > returns) == enters
    report = update_with_scan(
        eskf, ground.planes, ground.anchors, placed(seen[near][::7]),
        ScanErrors(range_sigma_m=0.02, angle_sigma_rad=1e-3, floor_sigmas=np.full(6, 1e-3)),
    )  # fmt: skip
    assert report.matched > 1000
    if not enters:
        gap = eskf.state.position - eskf.clones[0].translation
        np.testing.assert_allclose(gap, 0.0, atol=2e-3)


def flown(seed: int) -> tuple[Eskf, np.ndarray, np.ndarray]:
    """A LIDAR with a calibration error (0.3 degrees, 1 cm), carried level over the ground, first
    along x, then along y, by an odometry with errors of 5 mm a step, adding to its map as it goes.
    Returns the filter, the calibration error, and the true position."""
    rng, drift_m = np.random.default_rng(seed), 5e-3
    sigmas = np.repeat([5e-3, 0.01, 0.0], [3, 3, CALIBRATION_DIM - MOUNT_DIM])
    error = sigmas * rng.standard_normal(CALIBRATION_DIM)
    given = Pose(np.eye(3), np.array([0.0, 0.0, -0.1]))
    true, position = corrected_mount(given, error), np.array([-6.0, -6.0, 9.0])
    variances = np.concatenate([np.repeat([1e-10, 1e-8, 1e-8, 1e-8, 1e-8], 3), sigmas**2 + 1e-14])
    state = replace(state_at(np.eye(3), position), calibration=np.zeros(CALIBRATION_DIM))
    eskf, anchors, plane_map = Eskf(state, variances), Anchors(), PlaneMap(1.0, capacity=1 << 14)
    # over level ground the noise of normals adds spurious lateral information
    errors = ScanErrors(
        range_sigma_m=0.01, angle_sigma_rad=1e-3,
        floor_sigmas=np.array([1e-3, 1e-3, 0.01, 0.3, 0.3, 1e-3]),
    )  # fmt: skip
    for number in range(24):
        world = room_points(rng, walls=False)
        world = world[np.abs(world - position)[:, :2].max(axis=1) < 5.0]
        beams = true.inverse().apply(world + rng.normal(0.0, 0.01, world.shape) - position)
        mount = corrected_mount(given, eskf.state.calibration)
        if anchors:
            points = mount.apply(beams[::9])
            scan = placed(points, points - mount.translation)
            update_with_scan(eskf, plane_map, anchors, scan, errors)
            mount = corrected_mount(given, eskf.state.calibration)
        state = eskf.state
        eskf.add_clone()
        anchors.add(state.pose, state.calibration)
        sensor = state.position + state.rotation @ mount.translation
        plane_map.insert(state.pose.apply(mount.apply(beams)), sensor, len(anchors) - 1)
        step = np.array([1.0, 0.0, 0.0] if number < 12 else [0.0, 1.0, 0.0])
        position = position + step
        guess = state.position + step + rng.normal(0.0, drift_m, 3)
        eskf.state = replace(state, position=guess)
        eskf.covariance[3:6, 3:6] += drift_m**2 * np.eye(3)
        # attitude from an accelerometer and a compass
        attitude = 1e8 * np.eye(3)
        eskf.apply(np.arange(3), attitude, attitude @ so3_log(eskf.state.rotation.T))
    return eskf, error, position


def test_a_wrong_mount_is_found_in_flight_and_the_filter_is_consistent() -> None:
    """The odometry's heights err by 5 mm a step, or 17 mm over 12 m, so that the tilt is observable
    to 1.4 mrad, a quarter of the calibration error. The filter's standard deviation agrees, and its
    errors are consistent with it, as those of the position are (NEES)."""
    scores, values = [], []
    for seed in range(11, 21):
        eskf, error, true = flown(seed)
        sigma = np.sqrt(np.diag(eskf.covariance)[STATE_DIM : STATE_DIM + 2])
        left = eskf.state.calibration[:2] - error[:2]
        np.testing.assert_allclose(sigma, 1.4e-3, rtol=0.1)
        scores += (left / sigma).tolist()
        off = eskf.state.position - true
        values.append(off @ np.linalg.solve(eskf.covariance[3:6, 3:6], off))
    # chi-square with 20 and 30 degrees of freedom, 99.9 %
    assert np.mean(np.square(scores)) < 2.27 and 1.0 < np.mean(values) < 6.0
