"""The receiver's error: spread, correlation, delay, lever arm, presets."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from touchdown.sim.api import GpsFix, GpsParams
from touchdown.sim.frames import rotation_from_yaw
from touchdown.sim.navigation.gps import GpsSensor
from touchdown.sim.noise import GaussMarkov, random_stream

Array = NDArray[np.float64]

CENTRED = GpsParams(antenna_body_m=(0.0, 0.0, 0.0))
PERIOD_S = 0.2


def fix(sensor: GpsSensor, tick: int = 120, position: Array | None = None) -> GpsFix:
    where = np.zeros(3) if position is None else position
    return sensor.sample(tick, np.eye(3), where, np.zeros(3), np.zeros(3))


def errors(params: GpsParams, seed: int, count: int) -> Array:
    """(count, 3) position errors of one receiver at 5 Hz."""
    sensor = GpsSensor(params, 600, seed)
    return np.array([fix(sensor).position_world for _ in range(count)])


def autocorrelation(series: Array, lag: int) -> Array:
    """(C,) mean of x(t) x(t + lag) of a zero-mean process, (N, C) samples."""
    return np.mean(series[: len(series) - lag] * series[lag:], axis=0)


def test_autocorrelation_fits_sigma_and_tau() -> None:
    """5 hours: 3000 correlation times bound the statistical error of a second moment of a
    Gauss-Markov process to sqrt(2 / 3000) = 2.6 %, so 8 % are three standard deviations."""
    rng = random_stream(1, "autocorrelation")
    sigma = np.array([0.536, 0.536, 0.804])
    process = GaussMarkov(sigma, 6.0, PERIOD_S, rng)
    series = np.array([process.step() for _ in range(90_000)])
    np.testing.assert_allclose(series.mean(axis=0), 0.0, atol=0.06)
    for lag_s in (0.0, 1.2, 6.0, 12.0):
        measured = autocorrelation(series, round(lag_s / PERIOD_S)) / sigma**2
        np.testing.assert_allclose(measured, math.exp(-lag_s / 6.0), atol=0.08)
    lags = np.arange(45)
    curve = np.array([autocorrelation(series, lag).sum() for lag in lags])
    slope = np.polyfit(lags * PERIOD_S, np.log(curve), 1)[0]
    assert -1.0 / slope == pytest.approx(6.0, rel=0.15)


def test_the_receiver_wanders_like_the_process() -> None:
    """The increments of a fix over one period: sigma^2 2 (1 - exp(-T / tau)) per axis, which tests
    tau apart from sigma; across devices the first fix has the stationary spread."""
    series = errors(CENTRED, 5, 20_000)
    steps = np.std(np.diff(series, axis=0), axis=0)
    sigma = np.array([0.536, 0.536, 1.5 * 0.536])
    np.testing.assert_allclose(steps, sigma * math.sqrt(2.0 * -math.expm1(-0.2 / 60.0)), rtol=0.03)
    first = np.array([errors(CENTRED, seed, 1)[0] for seed in range(600)])
    np.testing.assert_allclose(np.std(first, axis=0), sigma, rtol=0.1)


def test_zou2024_preset_gives_the_published_mean_error() -> None:
    """36 s surveys: mean 3-D error 1.01 m with a standard deviation of 0.37 m between flights
    (the closed form of the mean of the norm of these three normals is 1.012 m)."""
    means = [
        float(np.linalg.norm(errors(CENTRED, seed, 180), axis=1).mean()) for seed in range(150)
    ]
    assert np.mean(means) == pytest.approx(1.012, abs=3.0 * 0.37 / math.sqrt(150))
    assert np.std(means) == pytest.approx(0.37, abs=0.07)


def test_velocity_is_white() -> None:
    sensor = GpsSensor(CENTRED, 600, 2)
    speeds = np.array([fix(sensor).velocity_world for _ in range(20_000)])
    np.testing.assert_allclose(np.std(speeds, axis=0), 0.05, rtol=0.03)
    lagged = np.mean(speeds[1:] * speeds[:-1], axis=0) / 0.05**2
    np.testing.assert_allclose(lagged, 0.0, atol=0.03)


def test_the_antenna_is_measured_not_the_body() -> None:
    """Antenna 1 m ahead, heading north, turning left at 2 rad/s: 1 m north of the body and moving
    west at 2 m/s beside the body's own 3 m/s upwards."""
    params = GpsParams(
        antenna_body_m=(1.0, 0.0, 0.0), sigma_xy_m=0.0, sigma_z_m=0.0, velocity_sigma_mps=0.0
    )
    message = GpsSensor(params, 600, 0).sample(
        240, rotation_from_yaw(np.pi / 2), np.array([5.0, 6.0, 7.0]), np.array([0.0, 0.0, 3.0]),
        np.array([0.0, 0.0, 2.0]),
    )  # fmt: skip
    assert (message.tick, message.time_s) == (240, 0.4)
    np.testing.assert_allclose(message.position_world, [5.0, 7.0, 7.0], atol=1e-12)
    np.testing.assert_allclose(message.velocity_world, [-2.0, 0.0, 3.0], atol=1e-12)
