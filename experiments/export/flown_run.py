"""A finished run as exporters read it."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from touchdown.experiments.errors import UsageError

LIBRARY = "touchdown export"
"""name of the writer in exported files"""
SAME_TIME_S = 1e-6


@dataclass(frozen=True, kw_only=True, slots=True)
class ExportOptions:
    """What of a run is exported, and how."""

    poses: str = "estimate"
    """``estimate``, ``truth`` or, for TUM alone, ``reference``: which trajectory is written, or
    where the vehicle is taken to have been"""
    points: str = "map"
    """PLY: ``map``, the run's own, or ``scans``, all returns of the LIDAR"""
    every: int = 1
    """PLY of scans: one return of so many"""
    images: str = "compressed"
    """MCAP: ``compressed`` (PNG, as logged), ``raw`` or ``none``"""
    tf: str = "all"
    """MCAP: ``all`` transforms; ``odom``: not that from map to odom; ``none`` that moves"""
    origin: tuple[float, float, float] | None = None
    """MCAP: latitude, longitude (degrees) and height (m) of the world's origin"""
    judged: bool = False
    """TUM, CSV: only rows at which positions are judged"""


@dataclass(slots=True)
class Exported:
    """What was written."""

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
        if not found.is_file():
            raise UsageError(f"'{self.path}' has no {name}")
        return found

    def sensors(self) -> Path:
        """The sensor log of the run, or of the flight that it replayed. Raises UsageError."""
        from touchdown.experiments.io.sensor_log import FILE_NAME

        own, replayed = self.path / FILE_NAME, self.result.get("replay_of")
        if not own.is_file() and replayed and (Path(replayed) / FILE_NAME).is_file():
            return Path(replayed) / FILE_NAME
        if not own.is_file():
            raise UsageError(
                f"'{self.path}' has no {FILE_NAME}: fly with --log-sensors to export what sensors "
                "said; tum, csv and the map as ply do not need it"
            )
        return own

    def span_s(self) -> tuple[float, float]:
        """Positions are judged from here on, and before there: never, where it never took off;
        always, in runs of earlier versions, which do not tell."""
        first, last = self.result.get("span_s") or (-np.inf, None)
        return (
            np.inf if first is None else float(first),
            np.inf if last is None else float(last),
        )

    def wanted_s(self, judged: bool) -> tuple[float, float]:
        """The span to export: all, or ``judged`` alone. Raises UsageError where that is nothing."""
        if not judged:
            return -np.inf, np.inf
        first_s, end_s = self.span_s()
        if first_s == np.inf:
            raise UsageError(f"'{self.path}' never took off: no row is judged; leave out --judged")
        return first_s, end_s


def open_flown(run: Path) -> FlownRun:
    """Raises UsageError for what is no run directory."""
    if not (run / "result.json").is_file():
        raise UsageError(f"'{run}' is no run directory: it has no result.json")
    try:
        result = json.loads((run / "result.json").read_text(encoding="utf-8"))
    except (ValueError, OSError) as error:
        raise UsageError(f"'{run}' cannot be read: {error}") from error
    if not isinstance(result, dict):
        raise UsageError(f"'{run}' is no run directory: its result.json is no result")
    return FlownRun(run, result)
