"""The GPS filter on synthetic fixes, and the sensor needs of the baselines."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from touchdown.estimator.api import GpsEstimatorParams
from touchdown.estimator.baselines.gps import GpsEstimator
from touchdown.sim.api import GpsFix, ImuSample, MagnetometerSample, Observation, SensorRig
from touchdown.sim.navigation.magnetometer import earth_field_world
from touchdown.sim.noise import GaussMarkov

from support.baselines_support import HZ, make_rig


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
        imu = ImuSample(
            tick=tick,
            time_s=tick / HZ,
            angular_velocity=3e-3 * rng.standard_normal(3),
            specific_force=np.array([0.0, 0.0, 9.81]) + 2e-2 * rng.standard_normal(3),
        )
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
        seen.append(
            Observation(
                tick=tick, time_s=tick / HZ, rotor_speed_radps=np.zeros(4), battery_fraction=1.0,
                **messages,
            )
        )  # fmt: skip
    return rig, seen, np.array(errors)


def test_gps_position_comes_from_the_fixes_and_not_from_the_pad() -> None:
    """The receiver reports 5 m east, 3 m south and 1 m above the pad; the estimate follows,
    whatever start the vehicle was given."""
    rig, observations, errors = _observations(6.0, seed=4)
    estimator = GpsEstimator(rig, GpsEstimatorParams())
    estimates = [estimator.update(obs) for obs in observations]
    first = next(e for e in estimates if e.healthy)
    assert first.time_s == pytest.approx(0.32)
    offset = first.world_from_body.translation - [5.0, -3.0, 1.3]
    np.testing.assert_allclose(offset, errors[0], atol=0.03)
    last = estimates[-1].world_from_body.translation - [5.0, -3.0, 1.3]
    np.testing.assert_allclose(last, errors[-1], atol=0.15)


def test_gps_error_over_many_flights_is_that_of_its_receiver() -> None:
    """Normalised errors of 40 independent streams average to 3, one for each axis."""
    squared = []
    for seed in range(40):
        rig, observations, _ = _observations(1.0, seed)
        estimator = GpsEstimator(rig)
        for obs in observations:
            estimate = estimator.update(obs)
        error = estimate.world_from_body.translation - [5.0, -3.0, 1.3]
        squared.append(error @ np.linalg.solve(estimate.position_covariance, error))
    # chi-square of 120 degrees of freedom over 40: 3 +- 0.39
    assert abs(np.mean(squared) - 3.0) < 3.0 * 0.39


def test_without_fixes_gps_is_not_healthy() -> None:
    rig, observations, _ = _observations(4.0, seed=1)
    estimator = GpsEstimator(rig)
    for obs in observations:
        cut = obs.gps if obs.time_s < 1.0 else ()
        estimate = estimator.update(dataclasses.replace(obs, gps=cut))
    assert not estimate.healthy
