"""Gravity alignment: a known tilt, its correlation with the bias, and what a turn adds."""

import numpy as np
import pytest

from touchdown.estimator.filtering.error_state import ACCEL_BIAS, STATE_DIM, VELOCITY
from touchdown.estimator.filtering.eskf import Eskf
from touchdown.estimator.filtering.imu_propagation import ImuBuffer
from touchdown.estimator.filtering.zero_velocity import align_with_gravity
from touchdown.sim.api import GRAVITY_MPS2, ImuParams
from touchdown.sim.frames import so3_exp

from support.livo_filter_support import STEP_S
from support.livo_lidar_support import state_at

UP = np.array([0.0, 0.0, GRAVITY_MPS2])


def filter_at(rotation: np.ndarray, tilt_sigma: float, bias_sigma: float) -> Eskf:
    sigmas = np.repeat([1e-6, 1e-6, 1e-6, 1e-6, bias_sigma], 3)
    sigmas[:2] = tilt_sigma
    assert len(sigmas) == STATE_DIM
    return Eskf(state_at(rotation, np.zeros(3)), sigmas**2)


@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_a_tilt_of_ten_degrees_is_levelled(yaw: float) -> None:
    heading = so3_exp(np.array([0.0, 0.0, yaw]))
    true = heading @ so3_exp(np.radians(10.0) * np.array([0.6, -0.8, 0.0]))
    eskf = filter_at(heading, 0.3, 1e-12)
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
    eskf = filter_at(np.eye(3), 0.3, sigma_b)
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
    eskf = filter_at(np.eye(3), 0.1, 0.2)
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
