"""Vibration of a simulated IMU beside that of recorded flights.

The logs are those of Hurwitz and Klein ("Quadrotor Dead Reckoning with Multiple Inertial Sensors",
2023): four Xsens DOT IMUs on a DJI Phantom 4. Rotor speeds are not in them. While it hovers, the
line of the rotors' turns lies at 32 Hz, the alias of 88 Hz in samples of 120 Hz; in steady flight
at 5 m/s that of the front rotors lies at 38 Hz, the alias of 82 Hz; in manoeuvres it moves between
20 and 50 Hz. So the model is compared at rotor speeds of 88 Hz with a standard deviation of 8 Hz.
"""

from pathlib import Path

import numpy as np
import pandas as pd

from touchdown.experiments.errors import UsageError
from touchdown.sim.api import ImuParams
from touchdown.sim.typing import Array
from touchdown.sim.vibration import PropellerVibration

BANDS_HZ = ((10, 20), (20, 30), (30, 40), (40, 50), (50, 60))
"""below 10 Hz the vehicle's own motion covers the vibration"""
RECORDED_HZ = 120.0
RECORDED_HOVER_HZ, RECORDED_SPREAD_HZ, RECORDED_WANDER_S = 88.0, 8.0, 0.5
_SEGMENT = 256
SECONDS = 120.0
"""of the model, beside recordings of ten to sixty"""
_AS_RECORDED = ImuParams(vibration_harmonics=1.0, vibration_broadband=1.0)


def band_rms(samples: Array, rate_hz: float) -> Array:
    """(6, bands) root mean square of each axis of (N, 6) samples within ``BANDS_HZ`` (Welch)."""
    from scipy.signal import welch

    frequencies, found = welch(samples, rate_hz, nperseg=_SEGMENT, axis=0)
    return np.stack([_within(frequencies, found, low, high) for low, high in BANDS_HZ], axis=1)


def _within(frequencies: Array, found: Array, low: float, high: float) -> Array:
    # the last band ends at the Nyquist frequency, which belongs to it
    inside = (frequencies >= low) & ((frequencies < high) | (frequencies == 0.5 * RECORDED_HZ))
    inside &= frequencies <= high
    step = frequencies[1] - frequencies[0]
    return np.sqrt(found[inside].sum(axis=0) * step)


def read_recordings(folder: Path) -> dict[str, Array]:
    """(N, 7) time, rad/s and m/s^2 of every recording ``KIND/path_N/IMU_M.csv``, by name. Raises
    UsageError without one."""
    files = sorted(folder.glob("*/*/IMU_*.csv"))
    if not files:
        raise UsageError(
            f"'{folder}' holds no recording */*/IMU_*.csv; give the folder of the flights of "
            "Hurwitz and Klein (github.com/ansfl/Quadrotor-Dead-Reckoning-with-Multiple-Inertial-"
            "Sensors)"
        )
    return {str(file.relative_to(folder))[:-4]: _read(file) for file in files}


def _read(file: Path) -> Array:
    columns = ["time", *(f"{kind}_{axis}" for kind in ("Gyr", "Acc") for axis in "XYZ")]
    try:
        table = pd.read_csv(file, usecols=columns)[columns].to_numpy(float)
    except ValueError as error:
        raise UsageError(f"'{file}' is no recording: {error}") from error
    if not np.isfinite(table).all():
        raise UsageError(f"'{file}' is no recording: a number is missing in it")
    if len(table) < _SEGMENT:
        raise UsageError(f"'{file}' has {len(table)} samples; a spectrum needs {_SEGMENT}")
    table[:, 1:4] = np.radians(table[:, 1:4])
    return table


def recorded_vibration(seconds: float, seed: int = 0) -> Array:
    """(N, 6) samples of the model at the recorded vehicle's rotor speeds, as its sensor samples."""
    rng = np.random.default_rng(seed)
    hover = 2.0 * np.pi * RECORDED_HOVER_HZ
    fraction = RECORDED_SPREAD_HZ / RECORDED_HOVER_HZ
    speeds = _wander(rng, round(seconds * RECORDED_HZ), RECORDED_HZ, hover, fraction)
    model = PropellerVibration(_AS_RECORDED, 1.0 / RECORDED_HZ, hover, seed)
    return np.array([model.sample(row) for row in speeds])


def _wander(
    rng: np.random.Generator, count: int, rate_hz: float, mean: float, fraction: float
) -> Array:
    """(N, 4) rotor speeds, each a Gauss-Markov process about ``mean``."""
    from scipy.signal import lfilter

    keep = np.exp(-1.0 / (rate_hz * RECORDED_WANDER_S))
    drive = np.sqrt(1.0 - keep**2) * rng.standard_normal((count, 4))
    drive[0] = rng.standard_normal(4)
    return np.asarray(mean * (1.0 + fraction * lfilter([1.0], [1.0, -keep], drive, axis=0)))
