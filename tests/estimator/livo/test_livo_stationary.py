"""At rest: what the gyroscope and the accelerometer show is shared between bias and response;
gravity alignment.
"""

from dataclasses import replace

import numpy as np
import pytest

from touchdown.estimator.filtering.error_state import (
    ACCEL_BIAS,
    CALIBRATION_DIM,
    GYRO_BIAS,
    IMU_DIM,
    STATE_DIM,
    VELOCITY,
)
from touchdown.estimator.filtering.eskf import Eskf
from touchdown.estimator.filtering.imu_propagation import ImuBuffer, NavState
from touchdown.estimator.filtering.inertial_filter import InertialFilter
from touchdown.estimator.filtering.zero_velocity import (
    RestJudgement,
    ZeroVelocityUpdate,
    align_with_gravity,
    judge_rest,
)
from touchdown.sim.api import GRAVITY_MPS2, ImuParams, ImuSample
from touchdown.sim.frames import so3_exp, so3_log

from support.landing_support import make_obs
from support.livo_flight import make_rig
from support.livo_support import STEP_S, state_at

UP = np.array([0.0, 0.0, GRAVITY_MPS2])
G_SIGMA = 1.8e-4


def filter_at_rest(tilt_sigma: float = 1e-4) -> Eskf:
    zero = np.zeros(3)
    state = NavState(0, np.eye(3), zero, zero, zero, zero, np.zeros(CALIBRATION_DIM))
    variances = np.zeros(STATE_DIM + CALIBRATION_DIM)
    variances[:2], variances[2] = tilt_sigma**2, 1e-8
    variances[GYRO_BIAS], variances[12:15] = 0.003**2, 0.03**2
    variances[-9:] = G_SIGMA**2
    variances[-IMU_DIM + 3 : -IMU_DIM + 6] = 0.003**2
    return Eskf(state, variances)


def rest(eskf: Eskf, known: bool, rate: np.ndarray, seconds: float = 2.0) -> None:
    update = ZeroVelocityUpdate(2.4e-4, STEP_S, known)
    imu = ImuParams(gyro_density=2.4e-4, accel_density=1.7e-3)
    buffer, stationary = ImuBuffer(imu, STEP_S), np.ones(20, np.bool_)
    for k in range(round(seconds / STEP_S / 20)):
        gyro, force = np.tile(rate, (20, 1)), np.tile(UP, (20, 1))
        for i in range(20):
            buffer.push(3 * (20 * k + i + 1), gyro[i], force[i], True)
        eskf.propagate(buffer, 20)
        assert update.update(eskf, gyro, force, stationary)
        buffer.drop(20)


@pytest.mark.parametrize("known", [True, False])
def test_the_heading_stays_known_at_rest_whatever_responds_to_gravity(known: bool) -> None:
    eskf, rate = filter_at_rest(), np.array([0.002, -0.001, 0.0025])
    rest(eskf, known, rate)
    # the sum of bias and response is known, neither of them is
    shown = eskf.state.gyro_bias + GRAVITY_MPS2 * eskf.state.imu_errors[-9:].reshape(3, 3)[:, 2]
    np.testing.assert_allclose(shown, rate, atol=2e-4)
    sigmas = np.sqrt(np.diag(eskf.covariance))
    assert sigmas[11] > 0.8 * G_SIGMA * GRAVITY_MPS2
    # heading: no longer uncertain by the response times gravity times two seconds (0.2 deg)
    assert np.degrees(sigmas[2]) < 0.05
    # and propagation without updates does not make it so
    imu = ImuParams(gyro_density=2.4e-4, accel_density=1.7e-3)
    buffer = ImuBuffer(imu, STEP_S)
    start = eskf.state.tick
    for i in range(200):
        buffer.push(start + 3 * (i + 1), rate, UP, False)
    eskf.propagate(buffer, 200)
    assert np.degrees(np.sqrt(eskf.covariance[2, 2])) < 0.06


def free_filter(velocity: np.ndarray) -> Eskf:
    """Standard deviations as those that a rest is measured with: each is corrected by half."""
    zero, sigmas = np.zeros(3), np.repeat([1e-3, 2e-3, 5e-3, 1e-3, 0.03], 3)
    return Eskf(NavState(0, np.eye(3), zero, velocity, zero, zero), sigmas**2)


def test_rest_measures_velocity_rate_and_the_pose_where_it_began() -> None:
    velocity, rate = np.array([0.01, -0.02, 0.005]), np.array([1e-3, 0.0, -5e-4])
    eskf, update = free_filter(velocity), ZeroVelocityUpdate(0.0, STEP_S)
    samples = np.tile(rate, (20, 1)), np.tile(UP, (20, 1)), np.ones(20, np.bool_)
    before = np.diag(eskf.covariance)[:12]
    assert update.update(eskf, *samples)
    np.testing.assert_allclose(eskf.state.velocity, 0.5 * velocity, atol=1e-12)
    np.testing.assert_allclose(eskf.state.gyro_bias, 0.5 * rate, atol=1e-12)
    np.testing.assert_allclose(np.diag(eskf.covariance)[:12], 0.5 * before, rtol=1e-9)
    # half the variance is left, so that a third of what it has drifted is taken back
    turned, moved = so3_exp(np.array([0.0, 0.0, 6e-3])), np.array([3e-3, 0.0, -6e-3])
    eskf.state = replace(eskf.state, rotation=turned, position=moved)
    assert update.update(eskf, *samples)
    np.testing.assert_allclose(eskf.state.position, moved * 2.0 / 3.0, atol=1e-12)
    np.testing.assert_allclose(so3_log(eskf.state.rotation), [0.0, 0.0, 4e-3], atol=1e-9)


@pytest.mark.parametrize("motion", ["shaken", "turning", "pushed", "flying"])
def test_motion_is_no_rest_and_ends_one(motion: str) -> None:
    gyro, force, stationary = np.zeros((20, 3)), np.tile(UP, (20, 1)), np.ones(20, np.bool_)
    still = gyro.copy(), force.copy(), stationary.copy()
    if motion == "shaken":
        force[::2, 0] += 0.2
        force[1::2, 0] -= 0.2
    elif motion == "turning":
        gyro[:, 1] = 0.02
    elif motion == "pushed":
        force[:, 1] += 0.3
    else:
        stationary[7] = False
    eskf, update = free_filter(np.array([0.01, 0.0, 0.0])), ZeroVelocityUpdate(0.0, STEP_S)
    assert update.update(eskf, *still)
    prior, covariance = eskf.state, eskf.covariance.copy()
    assert not update.update(eskf, gyro, force, stationary) and eskf.state is prior
    np.testing.assert_array_equal(eskf.covariance, covariance)
    moved = np.array([0.5, 0.0, 0.0])
    eskf.state = replace(prior, position=moved)
    assert update.update(eskf, *still)
    np.testing.assert_allclose(eskf.state.position, moved, atol=1e-12)


def test_alignment_shares_the_vertical_force_between_bias_and_scale() -> None:
    eskf = filter_at_rest(0.05)
    align_with_gravity(eskf, UP * 1.004, 1e-3)
    bias, scale = eskf.state.accel_bias[2], eskf.state.imu_errors[5]
    assert bias + scale * GRAVITY_MPS2 == pytest.approx(0.004 * GRAVITY_MPS2, abs=1e-4)
    # as their variances: 0.03^2 and (0.003 g)^2
    assert bias / (scale * GRAVITY_MPS2) == pytest.approx((0.03 / (0.003 * GRAVITY_MPS2)) ** 2)


def tilted(rotation: np.ndarray, tilt_sigma: float, bias_sigma: float) -> Eskf:
    sigmas = np.repeat([1e-6, 1e-6, 1e-6, 1e-6, bias_sigma], 3)
    sigmas[:2] = tilt_sigma
    assert len(sigmas) == STATE_DIM
    return Eskf(state_at(rotation, np.zeros(3)), sigmas**2)


@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_a_tilt_of_ten_degrees_is_levelled(yaw: float) -> None:
    heading = so3_exp(np.array([0.0, 0.0, yaw]))
    true = heading @ so3_exp(np.radians(10.0) * np.array([0.6, -0.8, 0.0]))
    eskf = tilted(heading, 0.3, 1e-12)
    align_with_gravity(eskf, true.T @ UP, 1e-5)
    level = eskf.state.rotation.T @ UP / GRAVITY_MPS2
    np.testing.assert_allclose(level, true.T[:, 2], atol=1e-6)
    np.testing.assert_allclose(eskf.state.rotation, true, atol=1e-6)  # the heading stays
    assert np.sqrt(np.diag(eskf.covariance)[:2]).max() < 2e-6
    assert np.abs(eskf.state.accel_bias).max() < 1e-9


def correlation(eskf: Eskf, tilt_axis: int, bias_axis: int) -> float:
    cov, bias = eskf.covariance, ACCEL_BIAS.start + bias_axis
    return float(cov[tilt_axis, bias] / np.sqrt(cov[tilt_axis, tilt_axis] * cov[bias, bias]))


def test_tilt_and_bias_are_fully_correlated_afterwards() -> None:
    """The specific force along y is ``g roll + bias``, along x it is ``bias - g pitch``."""
    sigma_b = 0.2
    eskf = tilted(np.eye(3), 0.3, sigma_b)
    align_with_gravity(eskf, UP + [0.1, -0.05, 0.02], 5e-3)
    assert correlation(eskf, 0, 1) == pytest.approx(-1.0, abs=0.01)
    assert correlation(eskf, 1, 0) == pytest.approx(1.0, abs=0.01)
    tilt = np.sqrt(np.diag(eskf.covariance)[:2])
    np.testing.assert_allclose(tilt, sigma_b / GRAVITY_MPS2, rtol=0.02)
    # along the vertical nothing is hidden by a tilt
    assert np.sqrt(eskf.covariance[14, 14]) == pytest.approx(5e-3, rel=0.15)
    lost = 0.5 * (0.1**2 + 0.05**2) / GRAVITY_MPS2  # of gravity's reaction, by the tilt
    assert eskf.state.accel_bias[2] == pytest.approx(0.02 + lost, abs=5e-5)


def test_a_half_turn_separates_bias_from_tilt() -> None:
    """Exact samples of a vehicle that stands, tilted, and is turned about the vertical; its
    velocity is known to be zero."""
    bias = np.array([0.12, -0.07, 0.03])
    true = so3_exp(np.array([0.03, -0.02, 0.0]))
    eskf = tilted(np.eye(3), 0.1, 0.2)
    align_with_gravity(eskf, true.T @ UP + bias, 1e-3)
    hidden = np.abs(eskf.state.accel_bias - bias)[:2]
    assert hidden.max() > 0.05
    imu = ImuParams(gyro_density=1e-6, accel_density=1e-4, gyro_bias_walk=0.0, accel_bias_walk=0.0)
    rate = np.array([0.0, 0.0, np.pi / 8.0])
    for number in range(80):
        buffer = ImuBuffer(imu, STEP_S)
        for k in range(20):
            now = so3_exp(rate * STEP_S * (20 * number + k + 0.5)) @ true
            buffer.push(3 * (20 * number + k + 1), now.T @ rate, now.T @ UP + bias, True)
        eskf.propagate(buffer, 20)
        touched, information = np.r_[VELOCITY], 1e6 * np.eye(3)
        delta = eskf.correction(touched, information, -information @ eskf.state.velocity)
        eskf.state, eskf.clones = eskf.boxplus(eskf.state, eskf.clones, delta)
        eskf.update_covariance(touched, information)
    sigma = np.sqrt(np.diag(eskf.covariance))
    assert sigma[ACCEL_BIAS].max() < 2e-3
    np.testing.assert_allclose(eskf.state.accel_bias, bias, atol=2e-3)
    end = so3_exp(rate * STEP_S * 1600) @ true
    np.testing.assert_allclose(eskf.state.rotation[2], end[2], atol=3e-4)
    assert np.abs(eskf.state.accel_bias - bias)[:2].max() < 0.05 * hidden.max()


def _judged(rate: float, pull: float, noise: float, seed: int = 1) -> RestJudgement:
    """Of 33 samples with biases of ``rate`` and ``pull``, and ``noise`` times that of the sheet."""
    imu, rng = ImuParams(gyro_bias_sigma=3e-3, accel_bias_sigma=0.03), np.random.default_rng(seed)
    spread = noise / np.sqrt(STEP_S)
    gyro = [rate, 0.0, 0.0] + spread * imu.gyro_density * rng.standard_normal((33, 3))
    force = UP + [0.0, 0.0, pull] + spread * imu.accel_density * rng.standard_normal((33, 3))
    return judge_rest(gyro, force, np.repeat([3e-3, 0.03], 3), imu, STEP_S)


def test_samples_at_rest_widen_the_sheet_where_they_are_beyond_chance() -> None:
    imu = ImuParams()
    assert {_judged(0.005, 0.05, 1.0, seed) for seed in range(100)} == {
        RestJudgement(1.0, 0.0, 0.0)
    }
    noisy = _judged(0.0, 0.0, 4.0)
    assert noisy.bias_factor == 1.0
    assert noisy.gyro_density == pytest.approx(4.0 * imu.gyro_density, rel=0.2)
    assert noisy.accel_density == pytest.approx(4.0 * imu.accel_density, rel=0.2)
    assert _judged(0.0, 0.0, 9.0).gyro_density == 0.0  # shaken
    # one of four, and five times as large as 3.6e-3, that of bias and creeping: 2.4 in the mean
    assert _judged(5.0 * 3.6e-3, 0.0, 1.0).bias_factor == pytest.approx(2.5, rel=0.05)
    assert _judged(0.0, 0.3, 1.0).bias_factor == pytest.approx(3.5, rel=0.05)


def _started(rate: float, noise: float, rotors: float = 0.0) -> InertialFilter:
    """A filter after a quarter of a second at rest."""
    rng, sheet = np.random.default_rng(3), make_rig().imu
    inertial = InertialFilter(make_rig())
    for k in range(1, 51):
        gyro = [rate, 0.0, 0.0] + noise * sheet.gyro_density / np.sqrt(
            STEP_S
        ) * rng.standard_normal(3)
        force = UP + noise * sheet.accel_density / np.sqrt(STEP_S) * rng.standard_normal(3)
        sample = ImuSample(
            tick=3 * k, time_s=k * STEP_S, angular_velocity=gyro, specific_force=force
        )
        inertial.take_imu(
            make_obs(3 * k, time_s=k * STEP_S, imu=(sample,), rotor_speed_radps=np.full(4, rotors))
        )
    inertial.carry_to(150)
    return inertial


def test_a_gyroscope_far_off_its_sheet_is_known_before_take_off() -> None:
    inertial = _started(rate=0.02, noise=1.0)
    assert inertial.stationary
    assert inertial.eskf.state.gyro_bias[0] == pytest.approx(0.02, rel=0.15)
    # what turns with its rotors on may turn indeed
    assert not _started(rate=0.02, noise=1.0, rotors=50.0).stationary


def test_a_noisy_imu_is_believed_to_be_and_still_stands() -> None:
    sheet, usual, noisy = make_rig().imu, _started(0.0, 1.0), _started(0.0, 5.0)
    assert usual.stationary and noisy.stationary
    assert usual._buffer.densities.gyro == sheet.gyro_density
    known = noisy._buffer.densities
    assert known.gyro == pytest.approx(np.hypot(1.0, 5.0) * sheet.gyro_density, rel=0.2)
    assert known.accel == pytest.approx(np.hypot(1.0, 5.0) * sheet.accel_density, rel=0.2)
