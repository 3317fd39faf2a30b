"""Vibration of a simulated IMU beside that of recorded flights, and the fit of the model to them.

The logs are those of Hurwitz and Klein ("Quadrotor Dead Reckoning with Multiple Inertial Sensors",
2023): four Xsens DOT IMUs on a DJI Phantom 4. Rotor speeds are not in them. While it hovers, the
line of the rotors' turns lies at 32 Hz, the alias of 88 Hz in samples of 120 Hz; in steady flight
at 5 m/s that of the front rotors lies at 38 Hz, the alias of 82 Hz; in manoeuvres it moves between
20 and 50 Hz. So the model is compared at rotor speeds of 88 Hz with a standard deviation of 8 Hz.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.errors import UsageError
from touchdown.sim import vibration
from touchdown.sim.api import ImuParams
from touchdown.sim.vibration import PropellerVibration

Array = NDArray[np.float64]

AXES = ("gyro x", "gyro y", "gyro z", "accel x", "accel y", "accel z")
BANDS_HZ = ((10, 20), (20, 30), (30, 40), (40, 50), (50, 60))
"""below 10 Hz the vehicle's own motion covers the vibration"""
RECORDED_HZ = 120.0
RECORDED_HOVER_HZ, RECORDED_SPREAD_HZ, RECORDED_WANDER_S = 88.0, 8.0, 0.5
_STEADY, _STEADY_FROM_S, _STEADY_HZ = "StraightLine/path_2", 5.0, 82.0
_SEGMENT = 256
_SECONDS = 120.0
_AS_RECORDED = ImuParams(vibration_harmonics=1.0, vibration_broadband=1.0)


def density(samples: Array, rate_hz: float) -> tuple[Array, Array]:
    """Frequencies (F,) Hz and power spectral density (F, 6) of (N, 6) samples (Welch)."""
    from scipy.signal import welch

    frequencies, found = welch(samples, rate_hz, nperseg=_SEGMENT, axis=0)
    return frequencies, found


def band_rms(samples: Array, rate_hz: float) -> Array:
    """(6, bands) root mean square of each axis within ``BANDS_HZ``."""
    frequencies, found = density(samples, rate_hz)
    return np.stack([_within(frequencies, found, low, high) for low, high in BANDS_HZ], axis=1)


def _within(frequencies: Array, found: Array, low: float, high: float) -> Array:
    # the last band ends at the Nyquist frequency, which belongs to it
    inside = (frequencies >= low) & ((frequencies < high) | (frequencies == 0.5 * RECORDED_HZ))
    inside &= frequencies <= high
    step = frequencies[1] - frequencies[0]
    rms: Array = np.sqrt(found[inside].sum(axis=0) * step)
    return rms


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
    with file.open() as lines:
        names = lines.readline().strip().split(",")
    if missing := [name for name in columns if name not in names]:
        raise UsageError(f"'{file}' has no column {missing[0]}; it has {', '.join(names)}")
    try:
        table = np.loadtxt(file, delimiter=",", skiprows=1, ndmin=2)[
            :, [*map(names.index, columns)]
        ]
    except (ValueError, IndexError) as error:
        raise UsageError(f"'{file}' is not a table of numbers: {error}") from error
    if len(table) < _SEGMENT:
        raise UsageError(f"'{file}' has {len(table)} samples; a spectrum needs {_SEGMENT}")
    table[:, 1:4] = np.radians(table[:, 1:4])
    return table


def recorded_vibration(
    seconds: float, seed: int = 0, levels: tuple[Array, Array] = vibration.LEVELS
) -> Array:
    """(N, 6) samples of the model at the recorded vehicle's rotor speeds, as its sensor samples."""
    rng = np.random.default_rng(seed)
    hover = 2.0 * np.pi * RECORDED_HOVER_HZ
    share = RECORDED_SPREAD_HZ / RECORDED_HOVER_HZ
    speeds = _wander(rng, round(seconds * RECORDED_HZ), RECORDED_HZ, hover, share)
    model = PropellerVibration(_AS_RECORDED, 1.0 / RECORDED_HZ, hover, seed, levels)
    return np.array([model.sample(row) for row in speeds])


def _wander(
    rng: np.random.Generator, count: int, rate_hz: float, mean: float, share: float
) -> Array:
    """(N, 4) rotor speeds, each a Gauss-Markov process about ``mean``."""
    keep = np.exp(-1.0 / (rate_hz * RECORDED_WANDER_S))
    drive = np.sqrt(1.0 - keep**2) * rng.standard_normal((count, 4))
    drive[0] = rng.standard_normal(4)
    for k in range(1, count):
        drive[k] += keep * drive[k - 1]
    speeds: Array = mean * (1.0 + share * drive)
    return speeds


# ------------------------------------------------------------------------------- the fit


def fit(recordings: dict[str, Array]) -> dict[str, Array]:
    """``harmonics`` (2, 6) and ``modes`` (M, 6): the levels of ``sim.vibration`` that reproduce the
    ``recorded`` (6, bands) root mean squares, medians over all recordings.

    The line of the rotors' turns comes from the steady flight, where it stands apart: its power
    above the floor beside it, over what the mean over a sample leaves of it. The rest is a least
    squares fit of powers that are not negative. The mean hides most of blade pass, so that it is
    held between half and three times that line.
    """
    from scipy.optimize import lsq_linear

    recorded = np.median([band_rms(r[:, 1:], RECORDED_HZ) for r in recordings.values()], axis=0)
    steady = [r for name, r in recordings.items() if name.startswith(_STEADY)]
    if not steady:
        raise UsageError(f"the recordings lack {_STEADY}, whose rotor speeds are steady")
    turns = np.median([_line(r) for r in steady], axis=0)
    parts = _unit_parts() ** 2
    levels = np.zeros((len(parts), 6))
    for axis in range(6):
        relative = (parts / recorded[axis] ** 2).T
        # of the power of any band at most 0.6; where no line stands out, next to nothing
        most_line = 0.6 / float(relative[:, 0].max())
        line = float(np.clip(turns[axis] ** 2, 1e-6 * most_line, most_line))
        least, most = np.zeros(len(parts) - 1), np.full(len(parts) - 1, np.inf)
        least[0], most[0] = 0.25 * line, 9.0 * line
        found = lsq_linear(relative[:, 1:], 1.0 - relative[:, 0] * line, bounds=(least, most))
        levels[:, axis] = np.sqrt([line, *found.x])
    levels *= levels >= 0.1 * recorded.min(axis=1)
    return {"recorded": recorded, "harmonics": levels[:2], "modes": levels[2:]}


def _line(recording: Array) -> Array:
    """(6,) root mean square of the line of the turns in the steady flight, in hover."""
    frequencies, found = density(recording[recording[:, 0] > _STEADY_FROM_S, 1:], RECORDED_HZ)
    line = (frequencies >= 33.0) & (frequencies < 43.0)
    beside = ((frequencies >= 27.0) & (frequencies < 32.0)) | (
        (frequencies >= 45.0) & (frequencies < 50.0)
    )
    power = (found[line] - found[beside].mean(axis=0)).sum(axis=0)
    step = frequencies[1] - frequencies[0]
    left = np.sinc(_STEADY_HZ / RECORDED_HZ) * (_STEADY_HZ / RECORDED_HOVER_HZ) ** 2
    rms: Array = np.sqrt(np.maximum(power * step, 0.0)) / left
    return rms


def _unit_parts() -> Array:
    """(2 + M, bands) root mean squares, in the recordings' samples, of each part at level 1."""
    rows = []
    for part in range(2 + len(vibration.MODE_HZ)):
        lines, modes = np.zeros((2, 6)), np.zeros((len(vibration.MODE_HZ), 6))
        (lines if part < 2 else modes)[part if part < 2 else part - 2] = 1.0
        samples = recorded_vibration(_SECONDS, levels=(lines, modes))
        rows.append(np.sqrt((band_rms(samples, RECORDED_HZ) ** 2).mean(axis=0)))
    return np.array(rows)


def measure(folder: Path) -> dict[str, Any]:
    """The fit to the recordings in ``folder``, and the model's ``simulated`` root mean squares
    beside the ``recorded`` ones. Raises UsageError."""
    found: dict[str, Any] = dict(fit(read_recordings(folder)))
    found["simulated"] = band_rms(recorded_vibration(_SECONDS), RECORDED_HZ)
    return found


def rows(found: dict[str, Any]) -> list[str]:
    """Lines of the printed table: recorded and simulated root mean square in each band."""
    bands = "".join(f"{f'{low}-{high} Hz':>18}" for low, high in BANDS_HZ)
    lines = [f"{'':8}{bands}   recorded, simulated"]
    for axis, name in enumerate(AXES):
        pairs = zip(found["recorded"][axis], found["simulated"][axis], strict=True)
        lines.append(f"{name:8}" + "".join(f"{a:10.4f}{b:8.4f}" for a, b in pairs))
    return lines
