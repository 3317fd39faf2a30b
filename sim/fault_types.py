"""What can go wrong with a sensor on demand; part of `sim.api`: import it from there."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from sim.nav_types import FORBID_EXTRA

FAULT_KINDS: dict[str, tuple[str, ...]] = {
    "lidar_nan": ("scans",),
    "lidar_empty": ("scans",),
    "lidar_blind": ("scans",),
    "lidar_dropout": ("scans",),
    "lidar_frozen": ("scans",),
    "lidar_late": ("scans",),
    "camera_black": ("images",),
    "camera_dropout": ("images",),
    "camera_frozen": ("images",),
    "camera_late": ("images",),
    "timestamp_repeat": ("scans", "images"),
    "timestamp_swap": ("scans", "images"),
    "gps_dropout": ("gps",),
    "gps_frozen": ("gps",),
    "gps_jump": ("gps",),
}
"""Kinds of faults and the messages that each befalls."""

_FORM = re.compile(r"(?P<kind>[a-z_]+)@(?P<start>[0-9.]+)(\+(?P<duration>[0-9.]+))?")


@dataclass(frozen=True, kw_only=True, slots=True)
class Fault:
    """One entry of the schedule; times are those of delivery."""

    kind: str
    start_s: float
    duration_s: float | None
    """None: the first message (of either stream) delivered at ``start_s`` or later, and no other;
    of a swap the first two"""

    @property
    def text(self) -> str:
        """As it is written in the configuration."""
        until = "" if self.duration_s is None else f"+{self.duration_s:g}"
        return f"{self.kind}@{self.start_s:g}{until}"


@dataclass(frozen=True, kw_only=True, slots=True)
class FaultParams:
    """Faults put between the sensors and those who read them (``sim/faults.py``)."""

    __pydantic_config__ = FORBID_EXTRA

    events: tuple[str, ...] = ()
    """``KIND@START`` or ``KIND@START+DURATION``, seconds of simulated time"""
    late_s: float = 0.3
    """additional delay of ``lidar_late`` and ``camera_late``"""
    gps_jump_m: tuple[float, float, float] = (15.0, -10.0, 5.0)
    """offset of every position of ``gps_jump``, world frame"""

    def schedule(self) -> tuple[Fault, ...]:
        """ValueError: an entry that is not understood, in one sentence."""
        return tuple(parse_fault(text) for text in self.events)


def parse_fault(text: str) -> Fault:
    """``lidar_dropout@12.5+1`` -> its parts. ValueError: not of that form, unknown, or without
    length."""
    match = _FORM.fullmatch(text.strip())
    if match is None:
        raise ValueError(
            f"fault '{text}' is not of the form KIND@START or KIND@START+DURATION in seconds, such "
            "as lidar_dropout@20+1"
        )
    kind = match["kind"]
    if kind not in FAULT_KINDS:
        raise ValueError(f"unknown fault '{kind}' in '{text}'; known: {', '.join(FAULT_KINDS)}")
    try:
        start = float(match["start"])
        duration = None if match["duration"] is None else float(match["duration"])
    except ValueError:
        raise ValueError(f"fault '{text}': START and DURATION must be numbers of seconds") from None
    if not math.isfinite(start) or (duration is not None and not duration > 0.0):
        raise ValueError(f"fault '{text}': DURATION must be above 0 seconds")
    return Fault(kind=kind, start_s=start, duration_s=duration)
