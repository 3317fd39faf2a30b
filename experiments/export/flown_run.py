"""Finished run, export options and results, as all exporters use them."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from touchdown.experiments.errors import UsageError, reason_of
from touchdown.experiments.io.run_directory import SENSORS_FILE
from touchdown.experiments.io.untrusted import read_object
from touchdown.sim.files.opening import no_file

LIBRARY = "touchdown export"
"""name of the writer in exported files"""
SAME_TIME_S = 1e-6


class GeodeticPoint(NamedTuple):
    """Point on or above the ellipsoid of WGS 84."""

    latitude_deg: float
    longitude_deg: float
    height_m: float


@dataclass(frozen=True, kw_only=True, slots=True)
class ExportOptions:
    """Content and form of an export."""

    poses: str = "estimate"
    """trajectory: ``estimate``, ``truth`` or, for TUM alone, ``reference``"""
    points: str = "map"
    """PLY: ``map``, the run's own, or ``scans``, all returns of the LIDAR"""
    every: int = 1
    """PLY of scans: one of this many returns is written"""
    images: str = "compressed"
    """MCAP: ``compressed`` (PNG, as logged), ``raw`` or ``none``"""
    tf: str = "all"
    """MCAP: ``all`` transforms; ``odom``: all but map to odom; ``none``: static ones alone"""
    origin: GeodeticPoint | None = None
    """MCAP, plan: the world's origin"""
    judged: bool = False
    """TUM, CSV: only rows at which the position error is evaluated"""


@dataclass(slots=True)
class Exported:
    """Result of an export."""

    out: Path
    counts: dict[str, int] = field(default_factory=dict)
    """of messages, points or rows, by name"""
    notes: list[str] = field(default_factory=list)
    facts: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class FlownRun:
    """A run directory, of a flight or of a replay."""

    path: Path
    result: dict[str, Any]

    def file(self, name: str) -> Path:
        """Raises UsageError where the run lacks it."""
        found = self.path / name
        if reason := no_file(found):
            raise UsageError(f"'{self.path}': its {name} {reason}")
        return found

    def sensors(self) -> Path:
        """The sensor log of the run, or of the flight that it replayed. Raises UsageError."""
        own, replayed = self.path / SENSORS_FILE, self.result.get("replay_of")
        if not own.is_file() and isinstance(replayed, str) and self._is_replay_of(Path(replayed)):
            return Path(replayed) / SENSORS_FILE
        if not own.is_file():
            raise UsageError(
                f"'{self.path}' has no {SENSORS_FILE}: fly with --log-sensors to export sensor "
                "data; tum, csv and the map as ply do not need it"
            )
        return own

    def _is_replay_of(self, flight: Path) -> bool:
        """True if the run directory ``flight``, whose path is that of the result, is of the flight
        that the result describes and has a log."""
        try:
            flown = read_object(flight / "result.json")
        except (OSError, ValueError):
            return False
        same = all(flown.get(key) == self.result.get(key) for key in ("scene", "seed"))
        return (
            same
            and self.result.get("flown_by") in (None, flown.get("estimator"))
            and (flight / SENSORS_FILE).is_file()
        )

    def span_s(self) -> tuple[float, float]:
        """Begin and end of the evaluated span, s: (inf, inf) for a flight that never took off,
        (-inf, inf) for runs of earlier versions, which do not record it."""
        first, last = self.result.get("span_s") or (-np.inf, None)
        return (np.inf if first is None else float(first), np.inf if last is None else float(last))

    def wanted_s(self, judged: bool) -> tuple[float, float]:
        """Span to export: all, or ``judged`` alone. Raises UsageError if it is empty."""
        if not judged:
            return -np.inf, np.inf
        first_s, end_s = self.span_s()
        if first_s == np.inf:
            raise UsageError(f"'{self.path}' never took off: no row is judged; leave out --judged")
        return first_s, end_s


def open_flown(run: Path) -> FlownRun:
    """Raises UsageError for what is no run directory."""
    if reason := no_file(run / "result.json"):
        raise UsageError(f"'{run}' is no run directory: its result.json {reason}")
    try:
        result = read_object(run / "result.json")
    except (ValueError, OSError) as error:
        reason = reason_of(error)
        raise UsageError(f"'{run / 'result.json'}' is no result of a run: {reason}") from error
    return FlownRun(run, result)
