"""The least position error that the sensors of a logged survey allow, beside what `livo` reaches.

A benchmark: it reads the truth. No estimator uses it.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import repeat
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from touchdown.experiments.benchmarks.ablation import replayed
from touchdown.experiments.benchmarks.limit import imaging, ranging
from touchdown.experiments.benchmarks.limit.information import (
    CONSTANTS,
    GROUPS,
    STATE,
    Densities,
    Motion,
    Rows,
    bound,
    constant_sigmas,
    imu_motion,
    landmark_informations,
    motion_information,
)
from touchdown.experiments.config.files import check_named_code
from touchdown.experiments.errors import UsageError
from touchdown.experiments.flight.replay import LoggedRun, open_run, replay_config
from touchdown.experiments.io.provenance import git_revision
from touchdown.experiments.io.tum import Trajectory
from touchdown.sim.api import GRAVITY_MPS2, SensorRig
from touchdown.sim.typing import Array

Report = Callable[[str], None]

PERIOD_S = 0.5
"""between states"""
LOOK_S = 5.0
"""between the instants at which the bound is evaluated"""
SETS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "camera, LIDAR, IMU": ("ranges", "intensities", "features"),
        "camera, LIDAR without intensities, IMU": ("ranges", "features"),
        "LIDAR, IMU": ("ranges", "intensities"),
        "LIDAR without intensities, IMU": ("ranges",),
        "camera, rangefinder, IMU": ("features", "heights"),
        "camera, IMU": ("features",),
        "IMU": (),
    }
)
REPLAYED: Mapping[str, str] = MappingProxyType(
    {"camera, LIDAR, IMU": "livo: tight, all on", "LIDAR, IMU": "livo: LIDAR only"}
)
"""variants of `ablation` by set of sensors"""
AS_IT_IS, QUIET = "as it is", "noise of the IMU a tenth"
_QUIETER = 10.0
_FEW, _COARSE_PX, _COMMON_M = 1000 / 24000, 3.0, 0.02


class Change(NamedTuple):
    """What makes measurements of one kind tell less."""

    weight: float = 1.0
    """factor of the information"""
    common: float = 0.0
    """see `Rows.with_common_error`"""


_FEWER, _COARSER = Change(_FEW), Change((imaging.PIXEL_SIGMA / _COARSE_PX) ** 2)
LESS: Mapping[str, Mapping[str, Change]] = MappingProxyType(
    {
        "1000 returns a scan": {"ranges": _FEWER, "intensities": _FEWER},
        "2 cm common to a patch's returns": {"ranges": Change(common=_COMMON_M)},
        "features to 3 px": {"features": _COARSER},
        "all three": {
            "ranges": Change(_FEW, _COMMON_M), "intensities": _FEWER, "features": _COARSER,
        },
    }
)  # fmt: skip
"""Measurements that tell less, by kind"""
_STILL_BEFORE_S = 0.7
_STILL_SIGMA = 1e-3
"""m, m/s and rad, of a vehicle that stands"""
_SMALL = 1e-6


class Problem:
    """A survey's states, constants and measurements."""

    def __init__(self, logged: LoggedRun, flight: ranging.Flight, rows: Mapping[str, Rows]) -> None:
        self.rows, self.scene = rows, logged.result.scene
        self.period_s = flight.period_s
        self._flight, self._rig = flight, logged.sensors.rig
        sheet = flight.config.imu
        self._densities = Densities(
            sheet.gyro_density, sheet.accel_density, sheet.gyro_bias_walk, sheet.accel_bias_walk
        )
        end = min(logged.to_s, float(flight.path.times_s[-1]))
        self.states = int(end / flight.period_s) + 1
        first = int(np.ceil(logged.from_s / flight.period_s))
        self.looks = list(range(self.states - 1, first, -round(LOOK_S / flight.period_s)))[::-1]
        self.still = int(max(logged.from_s - _STILL_BEFORE_S, 0.0) / flight.period_s) + 1
        self.sigmas = constant_sigmas(flight.config, self._rig.camera)
        self._motions: dict[float, list[Motion]] = {}

    def motions(self, quieter: float = 1.0) -> list[Motion]:
        """Of the IMU with ``quieter`` times less noise."""
        if quieter not in self._motions:
            densities = Densities(*(value / quieter for value in self._densities))
            self._motions[quieter] = _motions(self._flight, self._rig, self.states, densities)
        return self._motions[quieter]

    def before(self, states: int) -> Array:
        """Information that needs no sensor: the start, standing still, and constants."""
        imu, count = self._flight.config.imu, STATE * states
        diagonal = np.zeros(count + CONSTANTS)
        diagonal[count:] = self.sigmas**-2
        start = np.repeat([_SMALL, _SMALL, _SMALL, imu.gyro_bias_sigma, imu.accel_bias_sigma], 3)
        start[6:8] = self._rig.start_tilt_sigma_rad or _SMALL
        diagonal[:STATE] = np.maximum(start, _SMALL) ** -2
        for k in range(1, min(self.still, states)):
            diagonal[STATE * k : STATE * k + 6] = _STILL_SIGMA**-2
            diagonal[STATE * k + 8] = _STILL_SIGMA**-2
        return np.diag(diagonal)

    def covariances(
        self, names: Sequence[str], changes: Mapping[str, Change] = MappingProxyType({})
    ) -> list[dict[str, Array]]:
        """The position's covariances (3, 3) at each instant of ``looks``: `AS_IT_IS`, with one of
        `GROUPS` known, and with a `QUIET` IMU."""
        counts = [look + 1 for look in self.looks]
        rows = []
        for name in names:
            weight, common = changes.get(name, Change())
            fewer = self.rows[name]._replace(weight=weight * self.rows[name].weight)
            rows.append(fewer.with_common_error(common) if common else fewer)
        sensed: Iterable[Array] = repeat(np.zeros(()), len(counts))
        if rows:
            sensed = landmark_informations(Rows.joined(rows), counts, CONSTANTS)
        found = []
        for count, seen in zip(counts, sensed, strict=True):
            rest = self.before(count) + seen
            total = rest + motion_information(self.motions()[: count - 1], CONSTANTS)
            quiet = rest + motion_information(self.motions(_QUIETER)[: count - 1], CONSTANTS)
            position = STATE * (count - 1) + np.arange(3)
            one = {AS_IT_IS: bound(total, position), QUIET: bound(quiet, position)}
            for group, columns in GROUPS.items():
                known = STATE * count + np.concatenate([np.r_[part] for part in columns])
                left = np.setdiff1d(np.arange(len(total)), known)
                one[f"known: {group}"] = bound(total[np.ix_(left, left)], position)
            found.append(one)
        return found


def _motions(
    flight: ranging.Flight, rig: SensorRig, states: int, densities: Densities
) -> list[Motion]:
    path, mount = flight.path, rig.body_from_imu
    steps = np.diff(path.times_s)
    center = path.positions + path.rotations @ mount.translation
    velocity = np.gradient(center, path.times_s, axis=0)
    force_world = np.gradient(velocity, path.times_s, axis=0) + [0.0, 0.0, GRAVITY_MPS2]
    rotation = path.rotations @ mount.rotation
    back = np.swapaxes(rotation, 1, 2)
    force = np.einsum("nij,nj->ni", back, force_world)
    rate = np.einsum("nij,nj->ni", back, ranging.rates_at(path, path.times_s)[:, 3:])
    found = []
    for k in range(states - 1):
        start, end = np.searchsorted(
            path.times_s, flight.period_s * np.array([k, k + 1]) - 0.5 * steps.min()
        )
        step = flight.period_s / (end - start)
        part = slice(start, end)
        found.append(imu_motion(rotation[part], rate[part], force[part], step, densities))
    return found


def build(run: Path) -> Problem:
    """Reads a logged survey. Raises UsageError."""
    logged = open_run(run)
    config = replay_config(run)
    check_named_code(run / "config.json", [("scene", config.scene)])
    rig = logged.sensors.rig
    if not np.isfinite(logged.from_s):
        raise UsageError(f"'{run}' never took off: fly a survey with --log-sensors")
    flight = ranging.Flight(
        config, ranging.TrueSurface(config), Trajectory(logged.path / "truth.tum"), PERIOD_S
    )
    states = int(min(logged.to_s, float(flight.path.times_s[-1])) / PERIOD_S) + 1
    features = imaging.follow(flight, rig.camera, states)
    end_s = PERIOD_S * (states - 0.5)
    scans = (
        scan
        for obs in logged.sensors.observations(images=False)
        for scan in obs.scans
        if scan.end_time_s < end_s
    )
    some, near = ranging.collect(scans, flight)
    rows = {
        "ranges": ranging.range_rows(flight, some, features.points, features.normals),
        "intensities": ranging.intensity_rows(flight, near),
        "heights": ranging.height_rows(flight, end_s, features.points, features.normals),
        "features": imaging.image_rows(
            flight, rig.camera, features, config.livo.camera_hz * PERIOD_S
        ),
    }
    return Problem(logged, flight, rows)


def measure(run: Path, replays: bool, report: Report) -> dict[str, Any]:
    """The bounds of one survey, metres, and with ``replays`` what `livo` reaches. Raises
    UsageError."""
    problem = build(run)
    figures: dict[str, Any] = {
        "run": str(run),
        "scene": problem.scene,
        "revision": git_revision(),
        "bound_m": {},
        "changed_m": {},
    }
    for title, names in SETS.items():
        report(f"{run.name}: {title}")
        found = problem.covariances(names)
        figures["bound_m"][title] = _spread(found, AS_IT_IS)
        changed = {what: _spread(found, what)["mean"] for what in found[0] if what != AS_IT_IS}
        for what, changes in LESS.items():
            if set(changes) & set(names):
                less = problem.covariances(names, changes)
                changed[what] = _spread(less, AS_IT_IS)["mean"]
        figures["changed_m"][title] = changed
    if replays:
        report(f"{run.name}: replays")
        figures["reached_m"] = {
            title: replayed(open_run(run), variant)["error_m"]
            for title, variant in REPLAYED.items()
        }
    return figures


def _spread(found: list[dict[str, Array]], name: str) -> dict[str, float]:
    each = np.array([np.diag(one[name]) for one in found])
    total = np.sqrt(each.sum(axis=1))
    return {
        "mean": float(total.mean()),
        "end": float(total[-1]),
        **{axis: float(np.sqrt(each[:, k]).mean()) for k, axis in enumerate("xyz")},
    }


def table(figures: Sequence[Mapping[str, Any]]) -> str:
    """Tables in Markdown, metres: the bounds beside what is reached, and what changes them."""
    scenes = " | ".join(run["scene"] for run in figures)
    head = [f"| sensors | {scenes} |", "|---|" + "---|" * len(figures)]
    lines = ["Bound (m), mean over the survey", "", *head]
    for title in SETS:
        cells = [f"{run['bound_m'][title]['mean']:.4f}" for run in figures]
        lines.append(f"| {title} | " + " | ".join(cells) + " |")
    if all("reached_m" in run for run in figures):
        lines += ["", "`livo` on the same logs: mean error (m), and over the bound", "", *head]
        for title in REPLAYED:
            pairs = [(run["reached_m"][title], run["bound_m"][title]["mean"]) for run in figures]
            cells = [f"{error:.3f} ({error / minimum:.0f})" for error, minimum in pairs]
            lines.append(f"| {title} | " + " | ".join(cells) + " |")
    for title in SETS:
        lines += ["", f"{title}: bound (m) with a change", "", head[0].replace("sensors", "change")]
        lines.append(head[1])
        for what in figures[0]["changed_m"][title]:
            cells = [f"{run['changed_m'][title][what]:.4f}" for run in figures]
            lines.append(f"| {what} | " + " | ".join(cells) + " |")
    revisions = sorted({run["revision"] or "no revision" for run in figures})
    return "\n".join([*lines, "", "revision " + ", ".join(revisions)])
