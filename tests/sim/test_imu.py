"""The IMU's ideal values, noise densities and bias walk."""

import numpy as np
import pytest
from numpy.typing import NDArray

from touchdown.sim.api import GRAVITY_MPS2, ImuParams
from touchdown.sim.frames import so3_exp
from touchdown.sim.imu import ImuSensor

from support.worlds import NO_NOISE

Array = NDArray[np.float64]

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


def test_circular_flight_integrates_back_to_its_velocity() -> None:
    """A level circle at 5 m/s with 1 rad/s: dead reckoning on the samples returns the velocity."""
    sensor = ImuSensor(NO_NOISE, 600, 3, 0)
    turn = so3_exp(np.array([0.0, 0.0, PERIOD_S]))
    rotation, velocity = np.eye(3), np.array([5.0, 0.0, 0.0])
    reckoned_rotation, reckoned = rotation, velocity
    for k in range(400):
        following = rotation @ turn
        sample = sensor.sample(3 * k, rotation, following, velocity, turn @ velocity)
        half = so3_exp(0.5 * PERIOD_S * sample.angular_velocity)
        force = reckoned_rotation @ half @ sample.specific_force
        reckoned = reckoned + PERIOD_S * (force - [0.0, 0.0, GRAVITY_MPS2])
        reckoned_rotation = reckoned_rotation @ half @ half
        rotation, velocity = following, turn @ velocity
    np.testing.assert_allclose(reckoned, velocity, atol=1e-9)
    np.testing.assert_allclose(reckoned_rotation, rotation, atol=1e-9)


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
    biases = np.array([ImuSensor(params, 600, 3, seed).bias for seed in range(400)])
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
