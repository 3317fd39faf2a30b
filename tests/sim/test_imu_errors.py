"""The IMU off the centre of mass, and its turn-on errors."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.sim.test_imu import at_rest
from touchdown.sim.api import GRAVITY_MPS2, ImuParams
from touchdown.sim.frames import so3_exp
from touchdown.sim.imu import ImuErrors, ImuSensor

from support.worlds import NO_NOISE

Array = NDArray[np.float64]

SEEDS = 400


def drawn(params: ImuParams) -> Array:
    """(SEEDS, 6, 6) what IMUs of as many seeds make of rates and forces, less the identity."""
    return np.array([ImuErrors(params, seed).matrix - np.eye(6) for seed in range(SEEDS)])


def test_scale_errors_lie_on_the_diagonal_with_their_sigma() -> None:
    found = drawn(replace(NO_NOISE, scale_sigma=3e-3))
    diagonal = found[:, np.arange(6), np.arange(6)]
    np.testing.assert_allclose(diagonal.std(axis=0), 3e-3, rtol=0.12)
    np.testing.assert_allclose(np.corrcoef(diagonal.T), np.eye(6), atol=0.2)
    found[:, np.arange(6), np.arange(6)] = 0.0
    assert not found.any()


def test_misalignment_mixes_the_axes_of_one_sensor_only() -> None:
    found = drawn(replace(NO_NOISE, misalignment_sigma_deg=0.1))
    own = np.kron(np.eye(2), np.ones((3, 3))) - np.eye(6)
    np.testing.assert_allclose(found.std(axis=0), np.radians(0.1) * own, rtol=0.12)


def test_gyroscope_answers_to_specific_force() -> None:
    found = drawn(replace(NO_NOISE, gyro_g_sensitivity=1e-4))
    np.testing.assert_allclose(found[:, :3, 3:].std(axis=0), 1e-4, rtol=0.12)
    found[:, :3, 3:] = 0.0
    assert not found.any()


def test_one_error_leaves_the_draws_of_the_others_alone() -> None:
    alone = ImuErrors(replace(NO_NOISE, misalignment_sigma_deg=0.1), 5).matrix
    both = ImuErrors(replace(NO_NOISE, misalignment_sigma_deg=0.1, scale_sigma=0.01), 5).matrix
    np.testing.assert_array_equal((both - alone)[~np.eye(6, dtype=bool)], 0.0)


def test_samples_carry_the_errors() -> None:
    """At rest g acts along z: column 5 of the matrix, before bias and noise."""
    params = replace(
        NO_NOISE, scale_sigma=0.01, misalignment_sigma_deg=0.5, gyro_g_sensitivity=1e-3
    )
    sensor = ImuSensor(params, 600, 3, 11)
    expected = GRAVITY_MPS2 * ImuErrors(params, 11).matrix[:, 5]
    np.testing.assert_allclose(at_rest(sensor, 1)[0], expected, atol=1e-12)
    assert np.abs(expected[:5]).min() > 1e-4 and abs(expected[5] - GRAVITY_MPS2) > 1e-3


def test_bias_is_not_scaled() -> None:
    params = replace(NO_NOISE, scale_sigma=0.5, gyro_bias_sigma=0.1)
    plain = at_rest(ImuSensor(replace(params, scale_sigma=0.0), 600, 3, 4), 1)
    scaled = at_rest(ImuSensor(params, 600, 3, 4), 1)
    np.testing.assert_allclose(scaled[0, :3], plain[0, :3], atol=1e-12)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_samples_saturate(sign: float) -> None:
    params = replace(NO_NOISE, gyro_range=3.0, accel_range=20.0)
    sensor = ImuSensor(params, 600, 3, 0)
    turned = so3_exp(np.array([0.0, 0.0, sign * 10.0 * 3 / 600]))
    pushed = np.array([sign * 100.0 * 3 / 600, 0.0, 0.0])
    sample = sensor.sample(3, np.eye(3), turned, np.zeros(3), pushed)
    assert sample.angular_velocity[2] == sign * 3.0
    assert sample.specific_force[0] == sign * 20.0
    assert sample.specific_force[2] == pytest.approx(GRAVITY_MPS2)
