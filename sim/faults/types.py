"""Parameters of sensor faults on demand; part of `sim.api`: import them from there."""

import math
import re
from dataclasses import dataclass
from typing import Annotated

from annotated_types import Interval

from touchdown.sim.params import Fraction, Heading, NotNegative, parameters

FAULT_KINDS: dict[str, tuple[str, ...]] = {
    "lidar_nan": ("scans",),
    "lidar_empty": ("scans",),
    "lidar_blind": ("scans",),
    "lidar_soiled": ("scans",),
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
    "gps_spoof": ("gps",),
    "lidar_skew": ("scans",),
    "camera_skew": ("images",),
    "gps_skew": ("gps",),
    "miscalibration": ("scans",),
    "fog": ("scans", "images"),
    "rain": ("scans", "images"),
    "lens_dirt": ("images",),
    "low_sun": ("images",),
    "motor_loss": ("commands",),
    "gust": ("air",),
    "intruder": ("traffic",),
}
"""Kinds of faults and what each befalls: messages, commands to the rotors, the air, the ground."""

WORLD_KINDS = frozenset(
    ("miscalibration", "fog", "rain", "lens_dirt", "low_sun", "motor_loss", "gust", "intruder")
)
"""Those that happen where things are measured, at the time of measuring; others on delivery."""

PHASE_MARKS = ("takeoff", "survey", "select", "approach", "descend", "return")
"""phases of a mission at whose first beginning a fault may begin"""
_TIMED = frozenset(("miscalibration", "fog", "rain", "lens_dirt", "low_sun"))
"""kinds that begin at a time alone: sensors foresee them"""

MAX_MOTOR_LOSS = 0.5
"""of one rotor's thrust: with more, hovering level is beyond three others"""
MIN_VISIBILITY_M = 5.0
MIN_SUN_DEG = 3.0

_FORM = re.compile(
    r"(?P<kind>[a-z_]+)@(?P<start>[0-9.]+m?|[a-z]+)"
    r"(\+(?P<duration>[0-9.]+)|\*(?P<count>[0-9]{1,6}))?"
)


@dataclass(frozen=True, kw_only=True, slots=True)
class Fault:
    """One entry of the schedule; times are those of delivery. Without a duration and a count it
    lasts to the end of the flight."""

    kind: str
    start_s: float
    """infinite for one that begins at a mark"""
    duration_s: float | None = None
    count: int | None = None
    """that many messages of each of its streams, from the first at ``start_s`` or later; gusts of
    ``gust``"""
    mark: str = ""
    """what begins it in place of a time: a phase in lower case, or a height over the site such as
    ``12m``"""

    @property
    def text(self) -> str:
        """As it is written in the configuration."""
        until = "" if self.duration_s is None else f"+{self.duration_s:g}"
        start = self.mark or f"{self.start_s:g}"
        return f"{self.kind}@{start}{until}" + (f"*{self.count}" if self.count else "")


@parameters
class FaultParams:
    """Faults injected between the sensors and their readers (``sim/faults/injector.py``)."""

    events: tuple[str, ...] = ()
    """``KIND@START`` (to the end), ``KIND@START+DURATION`` in seconds of simulated time, or
    ``KIND@START*N`` for N messages. START is a time, a phase, or a height such as ``12m``: that of
    the legs over the site on the way down"""
    late_s: NotNegative = 0.3
    """additional delay of ``lidar_late`` and ``camera_late``"""
    soiled_deg: tuple[Heading, Heading] = (30.0, 90.0)
    """sector from which ``lidar_soiled`` takes the returns: from the first azimuth about the
    boresight to the second, from the long axis of the field of view on"""
    gps_jump_m: tuple[float, float, float] = (15.0, -10.0, 5.0)
    """offset of every position of ``gps_jump``, world frame"""
    gps_spoof_mps: tuple[float, float, float] = (0.5, -0.3, 0.0)
    """velocity at which ``gps_spoof`` draws positions away, world frame; it is in the reported
    velocity as well"""
    skew_s: Annotated[float, Interval(ge=-1.0, le=1.0)] = 0.02
    """offset that ``lidar_skew``, ``camera_skew`` and ``gps_skew`` add to stamps"""
    skew_ppm: Annotated[float, Interval(ge=-1e4, le=1e4)] = 0.0
    """rate at which such a clock runs fast, parts per million"""
    miscalibration_deg: Annotated[float, Interval(ge=0.0, le=20.0)] = 1.0
    """rotation of the LIDAR about an axis drawn from the seed"""
    miscalibration_m: Annotated[float, Interval(ge=0.0, le=0.5)] = 0.02
    """translation of the LIDAR in a direction drawn from the seed"""
    motor: Annotated[int, Interval(ge=0, le=11)] = 0
    """the rotor of ``motor_loss``, from 0"""
    motor_loss_fraction: Annotated[float, Interval(ge=0.0, le=1.0)] = 0.2
    """lost fraction of that rotor's thrust; 1: it stands"""
    gust_kmh: Annotated[float, Interval(ge=0.0, le=200.0)] = 30.0
    """speed up to which a ``gust`` blows, mean wind included"""
    gust_rise_s: Annotated[float, Interval(ge=0.05, le=60.0)] = 1.5
    """from its beginning to its peak"""
    gust_direction_deg: Heading | None = None
    """direction it blows to, counter-clockwise from east; None: that of the mean wind"""
    fog_visibility_m: Annotated[float, Interval(ge=MIN_VISIBILITY_M, le=1e5)] = 200.0
    """meteorological optical range in ``fog``: where contrast has fallen to 2 %"""
    rain_mmph: Annotated[float, Interval(ge=0.0, le=200.0)] = 25.0
    """rate of ``rain``, millimetres an hour"""
    dirt_fraction: Annotated[float, Interval(ge=0.0, le=0.9)] = 0.1
    """fraction of the image that ``lens_dirt`` covers"""
    dirt_size: Annotated[float, Interval(ge=0.002, le=0.2)] = 0.02
    """size of its blobs (correlation length), as a fraction of the image's width"""
    dirt_transmission: Fraction = 0.4
    """fraction of light that passes it"""
    low_sun_deg: Annotated[float, Interval(ge=MIN_SUN_DEG, le=90.0)] = 10.0
    """elevation of ``low_sun``"""
    low_sun_azimuth_deg: Heading | None = None
    """its azimuth, counter-clockwise from east; None: that of the scene's sun"""
    glare: Fraction = 0.03
    """fraction of the sunlight on the lens that strays over the whole image"""

    def schedule(self) -> tuple[Fault, ...]:
        """ValueError: an entry that is not understood, in one sentence."""
        return tuple(parse_fault(text) for text in self.events)

    def check(self, mean_wind_kmh: float) -> None:
        """Raises ValueError for a schedule that cannot happen in this mean wind."""
        for fault in self.schedule():
            if self.events.count(fault.text) > 1:
                raise ValueError(f"fault '{fault.text}' is listed twice")
            if fault.kind == "low_sun" and (fault.start_s or fault.duration_s):
                raise ValueError(
                    f"fault '{fault.text}': the sun stands still during a flight, give low_sun@0"
                )
            if fault.kind == "gust" and self.gust_kmh < mean_wind_kmh:
                raise ValueError(
                    f"fault '{fault.text}': faults.gust_kmh = {self.gust_kmh:g} is below "
                    f"wind.mean_kmh = {mean_wind_kmh:g}, which it includes"
                )


def parse_fault(text: str) -> Fault:
    """``lidar_dropout@12.5+1`` -> its parts. ValueError: not of that form, unknown, without length,
    or a count where nothing is counted."""
    match = _FORM.fullmatch(text.strip())
    if match is None:
        raise ValueError(
            f"fault '{text}' is not of the form KIND@START, KIND@START+DURATION in seconds or "
            "KIND@START*N messages, such as lidar_dropout@20+1 or lidar_dropout@12m"
        )
    kind = match["kind"]
    if kind not in FAULT_KINDS:
        raise ValueError(f"unknown fault '{kind}' in '{text}'; known: {', '.join(FAULT_KINDS)}")
    mark = match["start"] if match["start"][-1].isalpha() else ""
    if mark:
        _check_mark(text, kind, mark)
    try:
        start = math.inf if mark else float(match["start"])
        duration = None if match["duration"] is None else float(match["duration"])
    except ValueError:
        raise ValueError(f"fault '{text}': START and DURATION must be numbers of seconds") from None
    if duration is not None and not duration > 0.0:
        raise ValueError(f"fault '{text}': DURATION must be above 0 seconds")
    if duration is not None and kind == "intruder":
        raise ValueError(f"fault '{text}': faults of this kind last traffic.intruder_stays_s")
    count = None if match["count"] is None else int(match["count"])
    if count is not None:
        _check_count(text, kind, count)
    return Fault(kind=kind, start_s=start, duration_s=duration, count=count, mark=mark)


def _check_mark(text: str, kind: str, mark: str) -> None:
    if kind in _TIMED:
        raise ValueError(
            f"fault '{text}': {kind} begins at a time, give seconds in place of {mark}"
        )
    if not re.fullmatch(r"[0-9]+(\.[0-9]+)?m", mark) and mark not in PHASE_MARKS:
        raise ValueError(
            f"fault '{text}': '{mark}' is no time, no height such as 12m and no phase; phases: "
            f"{', '.join(PHASE_MARKS)}"
        )


def _check_count(text: str, kind: str, count: int) -> None:
    if kind in WORLD_KINDS and kind != "gust":  # N gusts
        raise ValueError(
            f"fault '{text}': {kind} acts on the world, not on single messages; give {kind}@START "
            f"or {kind}@START+DURATION"
        )
    if count == 0:
        raise ValueError(f"fault '{text}': N must be 1 or more")
    if kind == "timestamp_swap" and count % 2:
        raise ValueError(f"fault '{text}': stamps are swapped in pairs; give an even N, such as *2")
