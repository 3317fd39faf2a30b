"""The error-state filter against analytic motion, finite differences and known offsets."""

import numpy as np
import pytest

from touchdown.estimator.filtering.error_state import CALIBRATION_DIM, IMU_DIM, STATE_DIM
from touchdown.estimator.filtering.eskf import Eskf
from touchdown.estimator.filtering.imu_propagation import (
    ImuBuffer,
    NavState,
    NoiseDensities,
    integrate,
    propagate_nominal,
    transition,
)
from touchdown.sim.api import GRAVITY_MPS2, ImuParams
from touchdown.sim.frames import Pose, so3_exp, so3_log

from support.livo_support import STEP_S, filled_buffer, random_state

IMU_ERRORS = slice(STATE_DIM + CALIBRATION_DIM - IMU_DIM, STATE_DIM + CALIBRATION_DIM)


def test_circle_is_integrated_to_second_order() -> None:
    """Level circular flight: radius 5 m, 1 rad/s, nose along the tangent. A sample that is the
    exact mean over its interval leaves an error of less than a tenth of a millimetre a turn."""
    radius, rate, count = 5.0, 1.0, 1257
    start = Pose(np.eye(3), np.array([0.0, -radius, 0.0]))
    gyro = np.tile([0.0, 0.0, rate], (count, 1))
    # the mean of the specific force over a step, seen from the attitude of its middle
    half = 0.5 * rate * STEP_S
    specific = radius * rate**2 * np.sin(half) / half
    force = np.tile([0.0, specific, GRAVITY_MPS2], (count, 1))
    rotations, positions, velocities = integrate(
        start.rotation, start.translation, np.array([radius * rate, 0.0, 0.0]), gyro, force, STEP_S,
        GRAVITY_MPS2,
    )  # fmt: skip
    angle = rate * STEP_S * count
    expected = radius * np.array([np.sin(angle), -np.cos(angle), 0.0])
    np.testing.assert_allclose(positions[-1], expected, atol=1e-4)
    np.testing.assert_allclose(
        velocities[-1], radius * rate * np.array([np.cos(angle), np.sin(angle), 0.0]), atol=1e-4
    )
    np.testing.assert_allclose(rotations[-1], so3_exp(np.array([0.0, 0.0, angle])), atol=1e-9)


def test_constant_force_gives_a_parabola_and_biases_give_none() -> None:
    """What the sensors show beside their biases is no rotation and 1, -2, 3 m/s^2."""
    start = NavState(
        0, np.eye(3), np.array([5.0, 6.0, 7.0]), np.array([1.0, 2.0, -1.0]),
        np.array([0.01, -0.02, 0.03]), np.array([0.1, 0.2, -0.3]),
    )  # fmt: skip
    acceleration, count = np.array([1.0, -2.0, 3.0]), 100
    gyro = np.tile(start.gyro_bias, (count, 1))
    force = np.tile(acceleration + [0.0, 0.0, GRAVITY_MPS2] + start.accel_bias, (count, 1))
    end = propagate_nominal(start, 3 * np.arange(1, count + 1), gyro, force, STEP_S).end
    t = count * STEP_S
    moved = start.position + start.velocity * t + 0.5 * acceleration * t**2
    np.testing.assert_allclose(end.position, moved, atol=1e-12)
    np.testing.assert_allclose(end.velocity, start.velocity + acceleration * t, atol=1e-12)
    np.testing.assert_allclose(end.rotation, np.eye(3), atol=1e-12)


def test_transition_matches_finite_differences() -> None:
    rng = np.random.default_rng(3)
    state = random_state(rng)
    buffer = filled_buffer(rng, 20)
    ticks, gyro, force, _ = buffer.samples(20)
    rotations, _, _ = integrate(
        state.rotation, state.position, state.velocity, gyro - state.gyro_bias,
        force - state.accel_bias, STEP_S, GRAVITY_MPS2,
    )  # fmt: skip
    total, _, _ = transition(
        rotations, gyro - state.gyro_bias, force - state.accel_bias, STEP_S,
        NoiseDensities(0.0, 0.0, 0.0, 0.0),
    )  # fmt: skip
    eskf = Eskf(state, np.ones(STATE_DIM))
    for k in range(STATE_DIM):
        np.testing.assert_allclose(slope(eskf, (ticks, gyro, force), k), total[:, k], atol=4e-3)


def slope(eskf: Eskf, samples: tuple[np.ndarray, ...], k: int) -> np.ndarray:
    """(15,) derivative of the state after some samples by the error coordinate ``k`` before."""
    ends = []
    for sign in (1.0, -1.0):
        delta = np.zeros(eskf.base)
        delta[k] = sign * 1e-5
        moved, _ = eskf.boxplus(eskf.state, [], delta)
        ends.append(propagate_nominal(moved, *samples, STEP_S).end)
    plus, minus = ends
    turned = so3_log(minus.rotation.T @ plus.rotation)
    names = ("position", "velocity", "gyro_bias", "accel_bias")
    moved_by = [getattr(plus, name) - getattr(minus, name) for name in names]
    return np.concatenate([turned, *moved_by]) / 2e-5


def calibrated_state(rng: np.random.Generator) -> NavState:
    """A random state with IMU errors of a few hundredths; the rest of the calibration is zero."""
    state = random_state(rng)
    state.calibration = np.zeros(CALIBRATION_DIM)
    state.calibration[-IMU_DIM:] = rng.normal(0.0, 0.03, IMU_DIM)
    state.calibration[-9:] *= 1e-2  # rad/s per m/s^2
    return state


def test_samples_are_corrected_by_bias_then_scale() -> None:
    """A gyroscope that shows 2 % too much, an accelerometer 3 %: to first order the truth."""
    rng = np.random.default_rng(21)
    state = random_state(rng)
    rate, force = rng.normal(0.0, 1.0, (2, 5, 3))
    same = state.corrected(rate + state.gyro_bias, force + state.accel_bias)
    np.testing.assert_allclose(same, (rate, force), atol=1e-12)
    scale = np.array([0.02, 0.0, 0.0, 0.0, 0.03, 0.0])
    state.calibration = np.concatenate(
        [np.ones(CALIBRATION_DIM - IMU_DIM), scale, np.zeros(IMU_DIM - 6)]
    )
    shown = rate * (1.0 + scale[:3]) + state.gyro_bias, force * (1.0 + scale[3:]) + state.accel_bias
    found = state.corrected(*shown)
    np.testing.assert_allclose(found[0], rate, atol=5e-4 * np.abs(rate).max())
    np.testing.assert_allclose(found[1], force, atol=1e-3 * np.abs(force).max())
    assert np.abs(found[0] - same[0]).max() < 0.1 * np.abs(shown[0] - rate).max()


@pytest.mark.parametrize(
    ("errors", "shown", "force"),
    [
        # a turn about z of which 1 % shows in x and 2 % in y
        ([0.0, 0.01, 0.0, 0.02, *[0.0] * 11], [0.01, 0.02, 1.0], [0.0, 0.0, 0.0]),
        # 2e-3 rad/s per m/s^2 of the y axis to forces along x
        ([*[0.0] * 9, 2e-3, *[0.0] * 5], [0.0, 0.02, 1.0], [10.0, 4.0, 9.8]),
    ],
    ids=["misalignment", "g-sensitivity"],
)
def test_what_the_gyroscope_shows_beside_the_rate_is_taken_out(
    errors: list[float], shown: list[float], force: list[float]
) -> None:
    state = random_state(np.random.default_rng(24))
    state.calibration = np.concatenate([np.zeros(CALIBRATION_DIM - 15), errors])
    rate, _ = state.corrected(shown + state.gyro_bias[None], force + state.accel_bias[None])
    np.testing.assert_allclose(rate, [[0.0, 0.0, 1.0]], atol=1e-12)


def test_derivative_by_the_imu_errors_matches_finite_differences() -> None:
    rng = np.random.default_rng(22)
    state = calibrated_state(rng)
    ticks, gyro, force, _ = filled_buffer(rng, 20).samples(20)
    gyro, force = gyro + [0.8, -0.6, 0.7], force + [6.0, -5.0, 0.0]
    rate, specific = state.corrected(gyro, force)
    rotations, _, _ = integrate(
        state.rotation, state.position, state.velocity, rate, specific, STEP_S, GRAVITY_MPS2
    )
    _, _, by_errors = transition(
        rotations, rate, specific, STEP_S, NoiseDensities(0.0, 0.0, 0.0, 0.0)
    )
    eskf = Eskf(state, np.ones(STATE_DIM + CALIBRATION_DIM))
    for k in range(IMU_DIM):
        expected = slope(eskf, (ticks, gyro, force), IMU_ERRORS.start + k)
        assert np.abs(expected).max() > 0.01
        # the derivative is by the corrected sample, a scale error of 3 % from the raw one
        np.testing.assert_allclose(by_errors[:, k], expected, rtol=0.12, atol=6e-3)


def test_covariance_with_scale_errors_follows_the_dense_formula() -> None:
    """``F P F^T + Q`` over navigation state, calibration and a clone."""
    rng = np.random.default_rng(23)
    state = calibrated_state(rng)
    base = STATE_DIM + CALIBRATION_DIM
    eskf = Eskf(state, np.ones(base))
    eskf.add_clone()
    root = rng.normal(size=(base + 6, base + 6))
    prior = 0.01 * root @ root.T
    eskf.covariance = prior.copy()
    buffer = filled_buffer(rng, 20)
    _, gyro, force, _ = buffer.samples(20)
    rate, specific = state.corrected(gyro, force)
    rotations, positions, _ = integrate(
        state.rotation, state.position, state.velocity, rate, specific, STEP_S, GRAVITY_MPS2
    )
    total, noise, by_errors = transition(rotations, rate, specific, STEP_S, buffer.densities)
    eskf.propagate(buffer, 20)
    dense, added = np.eye(base + 6), np.zeros((base + 6, base + 6))
    dense[:STATE_DIM, :STATE_DIM], dense[:STATE_DIM, IMU_ERRORS] = total, by_errors
    added[:STATE_DIM, :STATE_DIM] = noise
    np.testing.assert_allclose(eskf.covariance, dense @ prior @ dense.T + added, atol=1e-12)
    nav = eskf.covariance[:STATE_DIM]
    np.testing.assert_array_equal(nav, eskf.covariance[:, :STATE_DIM].T)
    np.testing.assert_allclose(eskf.state.position, positions[-1], atol=1e-12)
    np.testing.assert_allclose(eskf.rate, rate[-3:].mean(axis=0), atol=1e-12)
    np.testing.assert_array_equal(eskf.state.calibration, state.calibration)


def test_noise_at_rest_grows_as_white_noise_does() -> None:
    """Over T seconds at rest: angle variance d^2 T, velocity variance d^2 T, position d^2 T^3 / 3
    (plus the tilt's share, tiny over 0.1 s)."""
    count, duration = 20, 0.1
    rotations = np.tile(np.eye(3), (count + 1, 1, 1))
    force = np.tile([0.0, 0.0, GRAVITY_MPS2], (count, 1))
    densities = NoiseDensities(2e-4, 2e-3, 0.0, 0.0)
    _, noise, _ = transition(rotations, np.zeros((count, 3)), force, STEP_S, densities)
    assert noise[2, 2] == pytest.approx(4e-8 * duration)
    assert noise[8, 8] == pytest.approx(4e-6 * duration)
    assert noise[5, 5] == pytest.approx(4e-6 * duration**3 / 3.0, rel=0.1)
    walks = NoiseDensities(0.0, 0.0, 3e-5, 4e-4)
    _, noise, _ = transition(rotations, np.zeros((count, 3)), force, STEP_S, walks)
    np.testing.assert_allclose(np.diag(noise)[9:12], 9e-10 * duration)
    np.testing.assert_allclose(np.diag(noise)[12:], 16e-8 * duration)
    assert noise[2, 2] == pytest.approx(9e-10 * duration**3 / 3.0, rel=0.1)


def test_update_equals_the_textbook_gain() -> None:
    """Information form against K = P H^T (H P H^T + R)^-1 on a random problem with two clones."""
    rng = np.random.default_rng(4)
    eskf = Eskf(random_state(rng), np.full(STATE_DIM, 0.01))
    root = rng.normal(size=(STATE_DIM, STATE_DIM))
    eskf.covariance = 0.01 * root @ root.T
    eskf.add_clone()
    eskf.propagate(filled_buffer(rng, 20), 20)
    eskf.add_clone()
    prior = eskf.covariance.copy()
    touched = eskf.touched([1, 0])
    jacobian = rng.normal(size=(40, len(touched)))
    residual = rng.normal(size=40)
    variance = 0.3
    full = np.zeros((40, len(prior)))
    full[:, touched] = jacobian
    gain = prior @ full.T @ np.linalg.inv(full @ prior @ full.T + variance * np.eye(40))
    information = jacobian.T @ jacobian / variance
    delta = eskf.correction(touched, information, jacobian.T @ residual / variance)
    eskf.update_covariance(touched, information)
    np.testing.assert_allclose(delta, gain @ residual, atol=1e-8)
    np.testing.assert_allclose(eskf.covariance, prior - gain @ full @ prior, atol=1e-8)


def test_a_fresh_clone_moves_with_the_pose_and_marginalising_leaves_the_rest() -> None:
    rng = np.random.default_rng(5)
    eskf = Eskf(random_state(rng), np.full(STATE_DIM, 0.01))
    eskf.add_clone()
    eskf.propagate(filled_buffer(rng, 20), 20)
    eskf.add_clone()
    touched = eskf.touched([])
    information = 1e12 * np.eye(6)
    shift = np.array([0.0, 0.0, 0.0, 0.1, -0.2, 0.3])
    delta = eskf.correction(touched, information, information @ shift)
    np.testing.assert_allclose(delta[eskf.clone_indices(1)], shift, atol=1e-6)
    kept = eskf.covariance[np.ix_(eskf.clone_indices(1), eskf.clone_indices(1))].copy()
    eskf.remove_clone(0)
    np.testing.assert_array_equal(
        eskf.covariance[np.ix_(eskf.clone_indices(0), eskf.clone_indices(0))], kept
    )


def test_errors_of_a_clone_alone_are_its_own() -> None:
    eskf = Eskf(random_state(np.random.default_rng(6)), np.full(STATE_DIM, 0.01))
    eskf.add_clone(np.array([0.0, 0.0, 1e-4, 0.0, 0.0, 4e-4]))
    clone, pose = eskf.clone_indices(0), np.arange(6)
    own = eskf.covariance[np.ix_(clone, clone)]
    np.testing.assert_allclose(own, np.diag([0.01, 0.01, 0.0101, 0.01, 0.01, 0.0104]))
    np.testing.assert_array_equal(eskf.covariance[np.ix_(clone, pose)], 0.01 * np.eye(6))
    np.testing.assert_array_equal(eskf.covariance[np.ix_(pose, pose)], 0.01 * np.eye(6))


def test_an_error_vector_moves_state_and_clones_alike() -> None:
    rng = np.random.default_rng(7)
    eskf = Eskf(random_state(rng), np.full(STATE_DIM, 0.01))
    eskf.add_clone()
    error = rng.normal(0.0, 0.1, 6)
    delta = np.concatenate([error, np.zeros(STATE_DIM - 6), error])
    state, (clone,) = eskf.boxplus(eskf.state, eskf.clones, delta)
    turned = eskf.state.rotation @ so3_exp(error[:3])
    for moved in (state.pose, clone):
        np.testing.assert_allclose(moved.rotation, turned, atol=1e-12)
        np.testing.assert_allclose(moved.translation, eskf.state.position + error[3:], atol=1e-12)


def test_a_full_buffer_is_an_error_not_growth() -> None:
    buffer = ImuBuffer(ImuParams(), STEP_S, capacity=4)
    for i in range(4):
        buffer.push(3 * i, np.zeros(3), np.zeros(3), False)
    with pytest.raises(RuntimeError, match="full"):
        buffer.push(12, np.zeros(3), np.zeros(3), False)
    buffer.drop(3)
    assert buffer.count == 1 and buffer.until(9) == 1 and buffer.until(8) == 0
