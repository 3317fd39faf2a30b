"""Inertial sensors: in flight, at rest, and the motion of the vehicle."""

from pathlib import Path

import numpy as np
import yaml

from touchdown.experiments.config.loading import load_config
from touchdown.experiments.flight.run import fly_and_judge
from touchdown.experiments.flight.wiring import build_flight_stack, build_scene
from touchdown.experiments.gap.card import Curves, first_file
from touchdown.experiments.gap.vibration import (
    BANDS_HZ,
    RECORDED_HZ,
    SECONDS,
    band_rms,
    read_recordings,
    recorded_vibration,
)
from touchdown.experiments.recording.recorder import StepRecord
from touchdown.sim.api import ImuParams
from touchdown.sim.imu import ImuSensor
from touchdown.sim.typing import Array

_SEEDS = (1, 2, 3)
_MOTION_HZ = np.geomspace(0.4, 8.0, 12)
"""edges of bands of the vehicle's own motion, below its vibration"""
_ALLAN_S = np.array([0.005, 0.01, 0.015, 0.02, 0.03, 0.04])
_STILL = 5.0
"""standard deviations of the noise of its sheet within which a sensor is at rest, motors off"""
_FEWEST = 30
_SHORTEST_S = 8.0


def vibration(data: Path) -> Curves | None:
    """log10 of the root mean square of each axis in each band, 10 to 60 Hz, (rad/s, m/s^2)."""
    if not (data / "flight").is_dir():
        return None
    recorded = [
        band_rms(one[:, 1:], RECORDED_HZ) for one in read_recordings(data / "flight").values()
    ]
    simulated = [band_rms(recorded_vibration(SECONDS, seed), RECORDED_HZ) for seed in _SEEDS]
    middles = np.tile([0.5 * (low + high) for low, high in BANDS_HZ], 6)
    return Curves(middles, *(np.log10(np.reshape(x, (len(x), -1))) for x in (recorded, simulated)))


def turning(data: Path) -> Curves | None:
    """log10 of the root mean square of the angular rate in bands of the vehicle's motion, rad/s."""
    return _moving(data, slice(0, 3))


def pushing(data: Path) -> Curves | None:
    """log10 of the root mean square of the specific force in the same bands, m/s^2."""
    return _moving(data, slice(3, 6))


def _moving(data: Path, axes: slice) -> Curves | None:
    if not (data / "flight").is_dir():
        return None
    flown = [
        one
        for name, one in read_recordings(data / "flight").items()
        if name.startswith("StraightLine") and len(one) > _SHORTEST_S * RECORDED_HZ
    ]
    if len(flown) < 2:
        return None
    recorded = [_bands(one[:, 1:][:, axes], RECORDED_HZ) for one in flown]
    simulated = [_bands(samples[:, axes], rate) for samples, rate in map(_survey, _SEEDS)]
    middles = np.sqrt(_MOTION_HZ[1:] * _MOTION_HZ[:-1])
    return Curves(middles, np.array(recorded), np.array(simulated))


def _bands(samples: Array, rate_hz: float) -> Array:
    """(bands,) log10 of the root mean square over all axes of (N, A) samples."""
    from scipy.signal import welch

    frequencies, density = welch(samples, rate_hz, nperseg=round(6.0 * rate_hz), axis=0)
    total = density.sum(axis=1)
    fine = np.linspace(_MOTION_HZ[:-1], _MOTION_HZ[1:], 20)
    mean = np.interp(fine, frequencies, total).mean(axis=0)
    return np.asarray(np.log10(np.sqrt(mean * np.diff(_MOTION_HZ))))


class _Imu:
    """A recorder of inertial samples in the air."""

    def __init__(self) -> None:
        self.rows: list[Array] = []

    def tick(self, step: StepRecord) -> None:
        if step.truth.world_from_body.translation[2] > 5.0:
            self.rows += [
                np.concatenate([one.angular_velocity, one.specific_force]) for one in step.obs.imu
            ]

    def close(self) -> None:
        pass


def _survey(seed: int) -> tuple[Array, float]:
    """(N, 6) inertial samples of a survey in `field`, steered by the truth, and their rate."""
    config = load_config(
        None, {"mapper.enabled": False}, scene="flat", estimator="oracle", seed=seed,
        survey_only=True, profile="field",
    )  # fmt: skip
    kept = _Imu()
    fly_and_judge(config, build_flight_stack(config, build_scene(config)), kept, None)
    return np.array(kept.rows), config.sim.tick_hz / config.sim.imu_ticks


def at_rest(data: Path) -> Curves | None:
    """log10 of the Allan deviation of each axis at rest, (rad/s, m/s^2), of a sensor by its own
    sheet."""
    file = first_file(data, "mav0/imu0/data.csv")
    if file is None:
        return None
    folder = file.parents[1]
    table = np.loadtxt(file, delimiter=",")[:, 1:]
    text = (folder / "imu0" / "sensor.yaml").read_text(encoding="utf-8")
    sheet = yaml.safe_load(text.partition("\n")[2])  # its first line is not of YAML 1.1
    params = ImuParams(
        gyro_density=float(sheet["gyroscope_noise_density"]),
        accel_density=float(sheet["accelerometer_noise_density"]),
        gyro_bias_walk=float(sheet["gyroscope_random_walk"]),
        accel_bias_walk=float(sheet["accelerometer_random_walk"]),
    )
    rate = float(sheet["rate_hz"])
    first = table[:_FEWEST, 3:]
    moves = np.abs(table[:, 3:] - first.mean(axis=0)) > _STILL * params.accel_density * np.sqrt(
        rate
    )
    still = table[: int(np.argmax(moves.any(axis=1))) or len(table)]
    if len(still) < _FEWEST:
        return None
    model = ImuSensor(params, 600, round(600 / rate), seed=1)
    level, zero = np.eye(3), np.zeros(3)
    made = [model.sample(k, level, level, zero, zero, 0.0, np.zeros(4)) for k in range(len(still))]
    simulated = np.array([np.concatenate([m.angular_velocity, m.specific_force]) for m in made])
    both = [np.log10(allan_deviation(samples, rate, _ALLAN_S)) for samples in (still, simulated)]
    taus = np.tile(_ALLAN_S, 2)
    return Curves(taus, *(np.concatenate([one[:3], one[3:]], axis=1) for one in both))


def allan_deviation(samples: Array, rate_hz: float, taus_s: Array) -> Array:
    """(A, T) overlapping Allan deviation of (N, A) samples at (T,) averaging times."""
    total = np.concatenate([np.zeros((1, samples.shape[1])), np.cumsum(samples, axis=0)])
    found = []
    for count in np.maximum(np.rint(taus_s * rate_hz).astype(int), 1):
        means = (total[count:] - total[:-count]) / count
        steps = means[count:] - means[:-count]
        found.append(np.sqrt(0.5 * np.mean(steps**2, axis=0)))
    return np.array(found).T
