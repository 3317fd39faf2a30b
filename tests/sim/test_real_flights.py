"""The sensor models beside recorded flights: quadrotor flights with several IMUs and RTK positions
(Hurwitz and Klein, "Quadrotor Dead Reckoning with Multiple Inertial Sensors", 2023, CC BY 4.0).

The environment variable TOUCHDOWN_DATA names a directory whose ``flight`` holds them.
"""

import os
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import welch

from touchdown.sim.api import GpsParams, ImuParams
from touchdown.sim.imu import ImuSensor
from touchdown.sim.navigation.gps import GpsSensor

Array = NDArray[np.float64]

FLIGHTS = Path(os.environ.get("TOUCHDOWN_DATA", "")) / "flight"
BAND_HZ = (10.0, 60.0)
"""Above what the vehicle itself does, below the recorded IMUs' Nyquist frequency."""

pytestmark = pytest.mark.skipif(
    "TOUCHDOWN_DATA" not in os.environ or not FLIGHTS.is_dir(),
    reason="TOUCHDOWN_DATA names no directory with recorded flights",
)


def densities(samples: Array, rate_hz: float) -> Array:
    """(6,) median amplitude density in the band, of (N, 6) gyro and accelerometer samples;
    two-sided as in `sim.api.ImuParams`: white noise has the standard deviation d sqrt(rate)."""
    frequency, power = welch(samples, rate_hz, nperseg=256, axis=0)
    inside = (frequency > BAND_HZ[0]) & (frequency < BAND_HZ[1])
    density: Array = np.sqrt(0.5 * np.median(power[inside], axis=0))
    return density


def recorded() -> Array:
    """(F, 6) densities of every recorded IMU, rad/s and m/s^2 per sqrt(Hz)."""
    found = []
    for path in sorted(FLIGHTS.glob("*/*/IMU_*.csv")):
        rows = np.genfromtxt(path, delimiter=",", skip_header=1)
        rate_hz = 1.0 / np.median(np.diff(rows[:, 0]))
        found.append(densities(np.hstack([np.radians(rows[:, 7:10]), rows[:, 4:7]]), rate_hz))
    assert len(found) > 10
    return np.array(found)


def hovering(params: ImuParams) -> Array:
    """(6,) densities of a simulated IMU in a perfect hover."""
    sensor = ImuSensor(params, 600, 3, 1)
    still = (np.eye(3), np.eye(3), np.zeros(3), np.zeros(3), 1.0)
    samples = [sensor.sample(3 * k, *still) for k in range(8000)]
    rows = np.array([[*s.angular_velocity, *s.specific_force] for s in samples])
    return densities(rows, 200.0)


def test_propellers_shake_an_imu_far_above_its_data_sheet() -> None:
    """The recorded sensors have data sheet densities near the simulated ones (0.007 deg/s and
    120 micro-g per sqrt(Hz)); in flight they read tens to hundreds of times that. The documented
    vibration densities reproduce the median of all flights within a factor of 1.4."""
    real = np.median(recorded(), axis=0)
    quiet = hovering(ImuParams())
    assert (real[:3] > 4.0 * quiet[:3]).all()
    assert (real[3:] > 30.0 * quiet[3:]).all()
    shaken = hovering(ImuParams(vibration_gyro_density=4e-3, vibration_accel_density=0.12))
    ratio = np.array(
        [np.median(real[:3]) / np.median(shaken[:3]), np.median(real[3:]) / np.median(shaken[3:])]
    )
    assert (np.abs(np.log(ratio)) < np.log(1.4)).all(), ratio


def test_rtk_fixes_are_as_smooth_as_recorded_ones() -> None:
    """Second differences of straight flights at 10 Hz hold little motion: they bound the noise from
    fix to fix. The preset lies below that bound and within a factor of ten of it."""
    rough = []
    for path in sorted(FLIGHTS.glob("StraightLine/*/GT.csv")):
        north_east = np.genfromtxt(path, delimiter=",", skip_header=1)[:, 7:9]
        rough.append(np.std(np.diff(north_east, n=2, axis=0), axis=0) / np.sqrt(6.0))
    bound = float(np.median(rough))
    sensor = GpsSensor(GpsParams(preset="rtk", period_ticks=60), 600, 0)
    still = (np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3))
    fixes = np.array([sensor.sample(60 * k, *still).position_world[:2] for k in range(3000)])
    ours = float(np.mean(np.std(np.diff(fixes, n=2, axis=0), axis=0)) / np.sqrt(6.0))
    assert 0.1 * bound < ours < bound
