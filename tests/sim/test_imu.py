"""The IMU's ideal values, noise densities and bias walk."""

from dataclasses import replace

import numpy as np
import pytest

from touchdown.sim.api import GRAVITY_MPS2, ImuParams
from touchdown.sim.frames import so3_exp
from touchdown.sim.imu import WARM_UP_S, ImuErrors, ImuSensor
from touchdown.sim.typing import Array

from support.worlds import NO_NOISE

PERIOD_S = 3 / 600


def at_rest(sensor: ImuSensor, count: int) -> Array:
    """(count, 6) angular velocity and specific force of a level, resting IMU."""
    still = (np.eye(3), np.eye(3), np.zeros(3), np.zeros(3))
    samples = (sensor.sample(3 * (k + 1), *still) for k in range(count))
    return np.array([[*s.angular_velocity, *s.specific_force] for s in samples])


def test_constant_acceleration_in_a_turned_body() -> None:
    """Heading north (yaw 90 degrees), accelerating north at 2 m/s^2: forward in the body."""
    north = so3_exp(np.array([0.0, 0.0, np.pi / 2]))
    gained = np.array([0.0, 2.0 * PERIOD_S, 0.0])
    sample = ImuSensor(NO_NOISE, 600, 3, 0).sample(3, north, north, np.zeros(3), gained)
    np.testing.assert_allclose(sample.specific_force, [2.0, 0.0, GRAVITY_MPS2], atol=1e-9)


def test_constant_rotation_about_a_tilted_axis() -> None:
    rate = np.array([0.7, -2.0, 1.1])
    start = so3_exp(np.array([0.3, 0.2, -1.0]))
    end = start @ so3_exp(rate * PERIOD_S)
    sample = ImuSensor(NO_NOISE, 600, 3, 0).sample(3, start, end, np.zeros(3), np.zeros(3))
    np.testing.assert_allclose(sample.angular_velocity, rate, atol=1e-9)
    middle = start @ so3_exp(0.5 * rate * PERIOD_S)
    np.testing.assert_allclose(
        sample.specific_force, middle.T @ [0.0, 0.0, GRAVITY_MPS2], atol=1e-9
    )


def allan_deviation(series: Array, cluster: int) -> Array:
    """Non-overlapping Allan deviation of (N, C) samples averaged over ``cluster`` of them."""
    usable = len(series) // cluster * cluster
    means = series[:usable].reshape(-1, cluster, series.shape[1]).mean(axis=1)
    deviation: Array = np.sqrt(0.5 * np.mean(np.diff(means, axis=0) ** 2, axis=0))
    return deviation


@pytest.mark.parametrize("cluster", [1, 20])
def test_allan_deviation_is_the_density(cluster: int) -> None:
    """White noise of density d has the Allan deviation d / sqrt(T) at averaging time T."""
    params = ImuParams(gyro_bias_walk=0.0, accel_bias_walk=0.0)
    series = at_rest(ImuSensor(params, 600, 3, 4), 20_000)
    expected = np.array([params.gyro_density] * 3 + [params.accel_density] * 3)
    deviation = allan_deviation(series, cluster) * np.sqrt(cluster * PERIOD_S)
    np.testing.assert_allclose(deviation, expected, rtol=0.03 if cluster == 1 else 0.09)


def test_bias_walk_grows_with_the_root_of_time() -> None:
    params = ImuParams(gyro_density=0.0, accel_density=0.0)
    series = at_rest(ImuSensor(params, 600, 3, 4), 20_000)
    steps = np.std(series[200:] - series[:-200], axis=0)  # over 1 s
    walks = np.array([params.gyro_bias_walk] * 3 + [params.accel_bias_walk] * 3)
    np.testing.assert_allclose(steps, walks, rtol=0.35)
    fine = np.std(np.diff(series, axis=0), axis=0) / np.sqrt(PERIOD_S)
    np.testing.assert_allclose(fine, walks, rtol=0.03)


def test_turn_on_bias_over_many_devices() -> None:
    params = ImuParams()
    biases = np.array([ImuSensor(params, 600, 3, seed)._bias for seed in range(400)])
    assert np.std(biases[:, :3]) == pytest.approx(params.gyro_bias_sigma, rel=0.07)
    assert np.std(biases[:, 3:]) == pytest.approx(params.accel_bias_sigma, rel=0.07)


def test_vibration_grows_with_the_square_of_the_rotor_speed() -> None:
    """White as well, on top of the sensor's own noise; none with the rotors at rest, and the other
    random numbers stay what they are."""
    shaken = ImuParams(vibration_gyro_density=5e-3, vibration_accel_density=0.2)
    still = (np.eye(3), np.eye(3), np.zeros(3), np.zeros(3))
    for shake in (0.0, 1.0, 2.0):
        sensor, plain = ImuSensor(shaken, 600, 3, 2), ImuSensor(ImuParams(), 600, 3, 2)
        rows = []
        for k in range(4000):
            a, b = sensor.sample(3 * k, *still, shake), plain.sample(3 * k, *still)
            rows.append(
                [*(a.angular_velocity - b.angular_velocity), *(a.specific_force - b.specific_force)]
            )
        density = np.std(rows, axis=0) * np.sqrt(PERIOD_S)
        expected = shake * np.array([5e-3] * 3 + [0.2] * 3)
        np.testing.assert_allclose(density, expected, rtol=0.05, atol=1e-12)


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


def test_biases_drift_as_the_sensor_warms_up() -> None:
    """By ten kelvins: the whole of the drift after many time constants, 1 - 1/e of it after one."""
    params = replace(NO_NOISE, warm_up_k=10.0)
    still = (np.eye(3), np.eye(3), np.zeros(3), np.zeros(3))

    def drift(seed: int, after_s: float) -> Array:
        sample = ImuSensor(params, 600, 3, seed).sample(round(600 * after_s), *still)
        force = sample.specific_force - [0.0, 0.0, GRAVITY_MPS2]
        return np.concatenate([sample.angular_velocity, force])

    whole = np.array([drift(seed, 50 * WARM_UP_S) for seed in range(300)])
    expected = np.repeat([10 * np.radians(0.015), 10 * 0.2e-3 * GRAVITY_MPS2], 3)
    np.testing.assert_allclose(whole.std(axis=0), expected, rtol=0.15)
    np.testing.assert_allclose(drift(7, WARM_UP_S), (1.0 - np.exp(-1.0)) * whole[7], rtol=1e-6)
