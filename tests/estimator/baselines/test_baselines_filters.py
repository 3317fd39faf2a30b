"""The baselines' small parts: order of messages, alignment, anchors in the world, stereo depth,
shifts, flow and displacement on images of known motion; the GPS filter on synthetic fixes.
"""

import dataclasses
import math
from typing import Any

import cv2
import numpy as np
import pytest

from touchdown.estimator.api import CalibrationPriors, GpsEstimatorParams, StereoParams
from touchdown.estimator.baselines.aiding import BaroHeight, update, update_heading
from touchdown.estimator.baselines.gps import FollowingAnchor, GpsEstimator, WanderingAnchor
from touchdown.estimator.baselines.ground_flow import (
    level_directions,
    phase_shift,
    pixels_of,
    solve_displacement,
)
from touchdown.estimator.baselines.navigator import EpochQueue, Navigator, field_azimuth
from touchdown.estimator.baselines.stereo import GroundHeight, disparities, inverse_depths
from touchdown.estimator.filtering.error_state import GYRO_SCALE, SHARED_DIM, STATE_DIM
from touchdown.estimator.filtering.eskf import Eskf
from touchdown.estimator.filtering.imu_propagation import NavState
from touchdown.estimator.ground_below import GroundBelow
from touchdown.sim.api import (
    BarometerSample,
    CameraImage,
    CameraIntrinsics,
    GpsFix,
    ImuSample,
    MagnetometerParams,
    MagnetometerSample,
    Observation,
    RangefinderSample,
    SensorNeeds,
    SensorRig,
    SimParams,
)
from touchdown.sim.delivery import Latency
from touchdown.sim.frames import BODY_FROM_DOWNWARD_OPTICAL, Pose, rotation_from_yaw, so3_exp
from touchdown.sim.navigation.sensors import earth_field_world
from touchdown.sim.noise import GaussMarkov

from support.baselines_support import HZ, texture
from support.landing_support import make_obs, make_rig


def image(tick: int) -> CameraImage:
    return CameraImage(tick=tick, time_s=tick / HZ, rgb=np.zeros((2, 2, 3), np.uint8))


def make_fix(tick: int, position: np.ndarray, sigma: float = 0.5) -> GpsFix:
    return GpsFix(
        tick=tick, time_s=tick / HZ, position_world=position, velocity_world=np.zeros(3),
        sigma_position_m=np.full(3, sigma), sigma_velocity_mps=0.05,
    )  # fmt: skip


def make_filter(rotation: np.ndarray, sigma: float = 0.1) -> Eskf:
    zero = np.zeros(3)
    return Eskf(NavState(0, rotation, zero, zero, zero, zero), np.full(15, sigma**2))


def test_epochs_come_in_the_order_of_measurement() -> None:
    """A fix of tick 120 arrives at 192, an image of tick 60 at 96: nothing of tick 120 is final
    before tick 192."""
    queue = EpochQueue(make_rig(), SensorNeeds(camera_hz=10, gps=True, magnetometer=True))
    assert queue.take(make_obs(63, magnetometer=())) == []
    field = MagnetometerSample(tick=60, time_s=0.1, field_body_ut=np.ones(3))
    assert queue.take(make_obs(99, images=(image(60),), magnetometer=(field,))) == []
    (first,) = queue.take(make_obs(132))
    assert (first.tick, first.image is not None, first.magnetometer) == (60, True, (field,))
    fix = make_fix(120, np.zeros(3))
    (second,) = queue.take(make_obs(192, gps=(fix,), images=(image(120),)))
    assert second.tick == 120 and second.fix is fix and second.image is not None


def test_messages_after_their_epoch_are_counted_not_used() -> None:
    queue = EpochQueue(make_rig(), SensorNeeds(camera_hz=10))
    assert [e.tick for e in queue.take(make_obs(156, images=(image(120),)))] == [60, 120]
    assert queue.take(make_obs(160, images=(image(60),))) == [] and queue.late == 1


def test_images_of_varying_latency_all_get_their_epoch() -> None:
    """Log-normal latencies about the nominal one: a fixed delay would lose every second image."""
    queue = EpochQueue(make_rig(), SensorNeeds(camera_hz=10))
    latency = Latency(SimParams(latency_sigma=0.3), 0, b"images")
    arrivals: dict[int, list[CameraImage]] = {}
    for tick in range(60, 18_000, 60):
        arrivals.setdefault(latency.due(tick), []).append(image(tick))
    seen = []
    for now in range(3, 18_200, 3):
        for epoch in queue.take(make_obs(now, images=tuple(arrivals.get(now, ())))):
            seen.append(epoch.image is not None)
    assert queue.late <= 3 and sum(seen) >= 295
    assert len(seen) - sum(seen) <= 8


def test_heading_update_turns_about_the_vertical_alone() -> None:
    params = MagnetometerParams()
    true = so3_exp(np.array([0.02, 0.01, 0.0])) @ rotation_from_yaw(0.3)
    estimated = rotation_from_yaw(0.05) @ true
    eskf = make_filter(estimated)
    field = true.T @ earth_field_world(params)
    for _ in range(20):
        update_heading(eskf, field, field_azimuth(params), 0.01)
    np.testing.assert_allclose(eskf.state.rotation[2], estimated[2], atol=1e-9)
    np.testing.assert_allclose(eskf.state.rotation, true, atol=2e-3)


def test_update_is_the_textbook_one_and_outliers_weigh_less() -> None:
    """Prior variance 0.01, measurement variance 0.01: half way, half the variance."""
    eskf = make_filter(np.eye(3))
    z = np.arange(5, 6)
    update(eskf, z, np.eye(1), np.array([0.2]), np.array([[0.01]]), gate=3.0)  # 1.4 sigma
    assert eskf.state.position[2] == pytest.approx(0.1)
    assert eskf.covariance[5, 5] == pytest.approx(0.005)
    eskf = make_filter(np.eye(3))
    distance = update(eskf, z, np.eye(1), np.array([2.0]), np.array([[0.01]]), gate=3.0)
    assert distance == pytest.approx(2.0 / math.sqrt(0.02))
    inflated = 0.01 * distance**2 / 9.0
    assert eskf.state.position[2] == pytest.approx(2.0 * 0.01 / (0.01 + inflated))


def test_barometer_measures_from_where_it_stood() -> None:
    eskf = make_filter(np.eye(3), sigma=1.0)
    baro = BaroHeight(HZ, 0.1)

    def sample(tick: int, altitude: float) -> BarometerSample:
        return BarometerSample(tick=tick, time_s=tick / HZ, pressure_pa=1e5, altitude_m=altitude)

    baro.take(eskf, [sample(0, 7.0), sample(0, 7.2)], stationary=True)
    for _ in range(50):
        baro.take(eskf, [sample(0, 9.1)], stationary=False)
    assert eskf.state.position[2] == pytest.approx(2.0, abs=0.01)


def test_ground_below_keeps_the_last_echo_over_water() -> None:
    rig = make_rig()
    ground = GroundBelow(rig, memory_s=0.0)
    state = NavState(60, np.eye(3), np.array([0, 0, 20.0]), np.zeros(3), np.zeros(3), np.zeros(3))

    def echo(range_m: float) -> RangefinderSample:
        return RangefinderSample(tick=60, time_s=0.1, range_m=range_m)

    mount = np.array(rig.nav.rangefinder.position_body_m)
    ground.take([echo(18.5)], state)
    assert ground.height_m == pytest.approx(20.0 + mount[2] - 18.5)
    ground.take([echo(0.0)], state)
    assert ground.height_m == pytest.approx(20.0 + mount[2] - 18.5)
    tilted = dataclasses.replace(state, rotation=so3_exp(np.array([0.0, math.radians(60.0), 0.0])))
    ground.take([echo(10.0)], tilted)
    expected = 20.0 + float((tilted.rotation @ mount)[2]) - 5.0
    assert ground.height_m == pytest.approx(expected)


def test_the_spot_below_is_that_of_the_nearest_echo() -> None:
    rig = make_rig()
    ground = GroundBelow(rig, memory_s=0.5)
    state = NavState(60, np.eye(3), np.array([0, 0, 20.0]), np.zeros(3), np.zeros(3), np.zeros(3))
    assert ground.spot(0.1) is None
    readings = ((0.08, 18.0), (0.10, 0.0), (0.12, 18.4))
    ground.take([RangefinderSample(tick=60, time_s=t, range_m=r) for t, r in readings], state)
    mount = np.array(rig.nav.rangefinder.position_body_m)
    for time_s, range_m in ((0.099, 18.0), (0.104, 18.4), (0.149, 18.4)):
        np.testing.assert_allclose(ground.spot(time_s), mount - [0.0, 0.0, range_m], atol=1e-12)
    assert ground.spot(0.16) is None


def test_following_anchor_is_where_the_fixes_are() -> None:
    anchor = FollowingAnchor(follow_s=0.2)
    anchor.take(np.array([1.0, 2.0, 3.0]), np.array([0.5, 0.5, 0.8]), 0.2)
    np.testing.assert_array_equal(anchor.offset, [1.0, 2.0, 3.0])
    anchor.take(np.array([1.1, 2.0, 3.0]), np.array([0.5, 0.5, 0.8]), 0.4)
    for _ in range(40):
        anchor.step(0.005)
    np.testing.assert_allclose(anchor.offset, [1.0 + 0.1 * (1 - math.exp(-1.0)), 2.0, 3.0])
    np.testing.assert_allclose(np.diag(anchor.covariance), [0.25, 0.25, 0.64])


@pytest.mark.parametrize("seconds", [6.0, 120.0])
def test_wandering_anchor_learns_as_far_as_the_error_wanders(seconds: float) -> None:
    """Mean of a Gauss-Markov process over T with the correlation time tau: the best estimate of
    its offset has the variance 2 sigma^2 / (2 + T / tau). Perfect odometry."""
    sigma, tau_s, errors = np.array([0.5, 0.5, 0.8]), 60.0, []
    for seed in range(40):
        wander = GaussMarkov(sigma, tau_s, 0.2, np.random.default_rng(seed))
        anchor = WanderingAnchor(tau_s, 0.0, 1e-3, 0.1)
        for k in range(round(seconds / 0.2)):
            anchor.take(wander.step(), sigma, 0.2 * k)
        anchor.step(100.0)
        errors.append(anchor.offset)
    variance = 2.0 * sigma**2 / (2.0 + seconds / tau_s)
    np.testing.assert_allclose(np.diag(anchor.covariance), variance, rtol=0.01)
    squared = (np.array(errors) ** 2 / variance).mean()
    assert abs(squared - 1.0) < 3.5 * math.sqrt(2.0 / 120)


@pytest.mark.parametrize("shift", [3, 28])
def test_disparities_of_a_shifted_image(shift: int) -> None:
    """Searched for where the expected depth puts them: to the left."""
    big = texture(400)
    left = np.ascontiguousarray(big[50:290, 50:370])
    right = np.ascontiguousarray(big[50:290, 50 + shift : 370 + shift])
    pixels = np.array([[100.0, 100.0], [200.0, 150.0], [60.0, 180.0]])
    found, shifts = disparities(left, right, pixels, np.full(3, 25.0 / (shift - 0.5)), 25.0)
    np.testing.assert_array_equal(found, [0, 1, 2])
    np.testing.assert_allclose(shifts, shift, atol=0.02)


def test_ground_height_from_many_noisy_pairs() -> None:
    """Level ground 2 m above the take-off, seen from 32 m through disparities of one pixel with a
    tenth of noise: pair by pair 0.2 m, together better."""
    params = StereoParams(ground_density=0.0, disparity_floor_sigma=0.0, disparity_sigma=0.1)
    rng = np.random.default_rng(5)
    ground = GroundHeight(0.0, params)
    ground._variance = 25.0
    pose = Pose(BODY_FROM_DOWNWARD_OPTICAL, np.array([0.0, 0.0, 32.0]))
    rays = np.column_stack([rng.uniform(-0.5, 0.5, (200, 2)), np.ones(200)])
    for k in range(40):
        shifts = 30.0 / 30.0 + 0.1 * rng.standard_normal(200)
        ground.take(rays, shifts, pose, 30.0, 0.1 * k)
    assert ground.sigma_m < 0.06 and abs(ground.height_m - 2.0) < 4.0 * ground.sigma_m
    np.testing.assert_allclose(ground.depths(rays, pose), 32.0 - ground.height_m)


def test_a_corner_keeps_what_its_own_disparity_adds() -> None:
    """Prior 30 m +- 3 m is 1/300 of inverse depth; 0.1 pixel of 30 pixel metres is as much: the
    mean of both, half the variance."""
    params = StereoParams(relief_sigma_m=3.0, disparity_sigma=0.1)
    inverse, variance = inverse_depths(
        np.array([1]), np.array([1.2]), np.array([30.0, 30.0]), 30.0, params
    )
    np.testing.assert_allclose(inverse, [1 / 30.0, 0.5 * (1 / 30.0 + 1.2 / 30.0)])
    np.testing.assert_allclose(variance, [1 / 300.0**2, 0.5 / 300.0**2])


def test_a_reading_far_from_the_pads_heading_counts_less() -> None:
    """The reading on the pad cancels the offset of a magnetometer at that heading alone."""
    nav = Navigator(
        make_rig(), SensorNeeds(magnetometer=True), known_start=True,
        heading_sigma_deg=2.0,
    )  # fmt: skip
    assert nav._reading_sigma() == pytest.approx(np.radians(2.0))
    nav._pad_yaw = np.pi
    offset = 2.0 * nav._alignment.heading_sigma()
    expected = np.hypot(np.radians(2.0), np.sqrt(600.0) * offset)
    assert nav._reading_sigma() == pytest.approx(expected)


def _observations(seconds: float, seed: int) -> tuple[SensorRig, list[Observation], np.ndarray]:
    """A vehicle that stands, level and facing east: noisy IMU and field, fixes with the wandering
    error of the preset ``zou2024``. Also that error at the fixes (N, 3)."""
    rig = make_rig()
    rng = np.random.default_rng(seed)
    sigma = np.array([0.536, 0.536, 0.804])
    wander = GaussMarkov(sigma, 60.0, 0.2, np.random.default_rng([seed, 1]))
    field = earth_field_world(rig.nav.magnetometer)
    late: dict[int, GpsFix] = {}
    seen, errors = [], []
    for tick in range(3, round(seconds * HZ), 3):
        rate = 3e-3 * rng.standard_normal(3)
        force = np.array([0.0, 0.0, 9.81]) + 2e-2 * rng.standard_normal(3)
        imu = ImuSample(tick=tick, time_s=tick / HZ, angular_velocity=rate, specific_force=force)
        messages: dict[str, Any] = {"imu": (imu,)}
        if tick % 120 == 0:
            error = wander.step()
            errors.append(error)
            antenna = np.array([0.0, 0.0, 0.3]) + rig.nav.gps.antenna_body_m
            late[tick + 72] = GpsFix(
                tick=tick, time_s=tick / HZ, position_world=antenna + [5.0, -3.0, 1.0] + error,
                velocity_world=0.05 * rng.standard_normal(3), sigma_position_m=sigma,
                sigma_velocity_mps=0.05,
            )  # fmt: skip
        if tick % 12 == 0:
            reading = field + 0.2 * rng.standard_normal(3)
            messages["magnetometer"] = (
                MagnetometerSample(tick=tick, time_s=tick / HZ, field_body_ut=reading),
            )
        if tick in late:
            messages["gps"] = (late.pop(tick),)
        seen.append(make_obs(tick, **messages))
    return rig, seen, np.array(errors)


def test_gps_position_comes_from_the_fixes_and_not_from_the_pad() -> None:
    """The receiver reports 5 m east, 3 m south and 1 m above the pad; the estimate follows,
    whatever start the vehicle was given. Of the calibration the IMU's errors alone are estimated,
    no camera's."""
    rig, observations, errors = _observations(6.0, seed=4)
    priors = CalibrationPriors(camera_rotation_sigma_deg=1.0, imu_scale_sigma=0.003)
    estimator = GpsEstimator(rig, GpsEstimatorParams(), priors)
    estimates = [estimator.update(obs) for obs in observations]
    first = next(e for e in estimates if e.healthy)
    assert first.time_s == pytest.approx(0.32)
    offset = first.world_from_body.translation - [5.0, -3.0, 1.3]
    np.testing.assert_allclose(offset, errors[0], atol=0.03)
    last = estimates[-1].world_from_body.translation - [5.0, -3.0, 1.3]
    np.testing.assert_allclose(last, errors[-1], atol=0.15)
    variances = np.diag(estimator._nav.eskf.covariance)[STATE_DIM:]
    assert not variances[:SHARED_DIM].any()
    assert (variances[SHARED_DIM:][GYRO_SCALE] > 0.9 * 0.003**2).all()


CAMERA = CameraIntrinsics(width=320, height=240, fx=250.0, fy=250.0, cx=159.5, cy=119.5)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (-17.0, 11.0), (41.0, 30.0), (5.3, -2.6)])
def test_phase_correlation_finds_shifts_and_fractions_of_them(shift: tuple[float, float]) -> None:
    big = texture(400)
    move = np.float32([[1, 0, shift[0]], [0, 1, shift[1]]])
    moved = cv2.warpAffine(big, move, (400, 400), flags=cv2.INTER_CUBIC)
    found = phase_shift(big[72:328, 72:328].copy(), moved[72:328, 72:328].copy())
    assert found.response > 0.3
    np.testing.assert_allclose(found.pixels, shift, atol=0.15)


def test_phase_correlation_has_no_response_without_overlap() -> None:
    found = phase_shift(texture(256, 1), texture(256, 2))
    assert found.response < 0.2
    blank = np.full((256, 256), 90, np.uint8)
    assert phase_shift(blank, blank).response == 0.0


def test_level_directions_do_not_depend_on_the_attitude() -> None:
    tilted = so3_exp(np.array([0.1, -0.2, 0.7])) @ BODY_FROM_DOWNWARD_OPTICAL
    point = np.array([[1.5, -2.0]])
    pixels = pixels_of(point, CAMERA, tilted)
    np.testing.assert_allclose(level_directions(pixels, CAMERA, tilted), point, atol=1e-12)
    straight = level_directions(np.array([[159.5, 119.5]]), CAMERA, BODY_FROM_DOWNWARD_OPTICAL)
    np.testing.assert_allclose(straight, 0.0, atol=1e-12)


def test_displacement_of_exact_directions() -> None:
    """From 10 m, 0.4 m east, 0.3 m north, 0.5 m up: the ground moves the other way and shrinks."""
    before = np.random.default_rng(0).uniform(-0.5, 0.5, (60, 2))
    now = (10.0 * before - [0.4, 0.3]) / 10.5
    found = solve_displacement(before, now, 10.0, 1e-3)
    assert found is not None
    np.testing.assert_allclose(found.translation, [-0.4, -0.3, -0.5], atol=1e-9)
    assert found.used == 60


def test_displacement_survives_a_third_of_wrong_flow() -> None:
    rng = np.random.default_rng(1)
    before = rng.uniform(-0.5, 0.5, (90, 2))
    now = before - [0.04, -0.02] + 1e-4 * rng.standard_normal((90, 2))
    now[:30] += rng.uniform(0.05, 0.2, (30, 2))
    found = solve_displacement(before, now, 20.0, 1e-3)
    assert found is not None
    np.testing.assert_allclose(found.translation[:2], [-0.8, 0.4], atol=0.01)
    assert solve_displacement(before[:5], now[:5], 20.0, 1e-3) is None
    assert solve_displacement(np.full((40, 2), np.nan), now[:40], 20.0, 1e-3) is None
    assert solve_displacement(before, now, -1.0, 1e-3) is None


def test_attitude_errors_enter_the_displacement_by_its_jacobians() -> None:
    """Directions seen under a wrong attitude give a wrong shift; the true one follows from it by
    the derivatives."""
    rng = np.random.default_rng(2)
    before = rng.uniform(-0.5, 0.5, (200, 2))
    now = (10.0 * before + [0.3, -0.2]) / 10.0
    exact = solve_displacement(before, now, 10.0, 1e-3)
    assert exact is not None
    for which in ("before", "now"):
        error = np.array([2e-4, -1e-4, 3e-4])
        wrong = {"before": before, "now": now}
        rays = np.column_stack([wrong[which], -np.ones(200)]) @ so3_exp(error)
        wrong[which] = rays[:, :2] / -rays[:, 2:]
        found = solve_displacement(wrong["before"], wrong["now"], 10.0, 1e-3)
        assert found is not None
        jacobian = found.by_rotation_before if which == "before" else found.by_rotation_now
        np.testing.assert_allclose(
            found.translation + jacobian @ error, exact.translation, atol=2e-5
        )
