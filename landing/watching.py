"""Types of the watch: what it is given while the vehicle descends, and what it answers."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal, Protocol

from touchdown.estimator.api import Estimate, GridMap, MapView
from touchdown.landing.parameters import LandingParams
from touchdown.sim.api import Observation, SensorNeeds, SensorRig
from touchdown.sim.typing import Array


class Verdict(StrEnum):
    """What a watch says of the descent."""

    GO = "go on"
    WAIT = "wait"
    MOVE = "move aside"
    CLIMB = "climb and look"


@dataclass(frozen=True, kw_only=True, slots=True)
class Finding:
    """One thing that a watch has seen."""

    kind: Literal["person", "moving", "new", "object", "known", "slope", "step", "water"]
    """``person``: a person, rider or animal in images; ``new``: it has appeared, or the map has it
    not as it was when the site was chosen; ``object``, ``slope``, ``step``, ``water``: under the
    legs; ``known``: none of them"""
    position_odom: Array
    """(3,) middle of its upper side"""
    velocity_odom: Array
    """(2,) m/s; 0 where it stands"""
    height_m: float
    """above the ground around it"""
    width_m: float
    distance_m: float
    """horizontal, from the site to its nearest point"""


@dataclass(frozen=True, kw_only=True, slots=True)
class WatchReport:
    """What a watch says at a control step."""

    verdict: Verdict = Verdict.GO
    reason: str = ""
    """what is in the way, in words; with GO what keeps it from seeing, empty where nothing does"""
    findings: tuple[Finding, ...] = ()
    aside_odom: Array | None = None
    """(2,) where it is safe to land, with MOVE"""
    height_m: float = float("nan")
    """height of the body above the ground below, as scans show it; NaN where they do not"""


@dataclass(frozen=True, kw_only=True, slots=True)
class WatchRig:
    """What a watch knows before the flight."""

    sensors: SensorRig
    """calibration and data sheets, as an estimator knows them"""
    landing: LandingParams
    """keys ``landing.*``: speeds and limits of the descent"""


@dataclass(frozen=True, kw_only=True, slots=True)
class WatchInput:
    """What a watch is given in a control step; positions in the odom frame."""

    obs: Observation
    """messages that arrived"""
    estimate: Estimate
    """motion of the vehicle: over seconds it counts, over longer times it may have drifted"""
    map_view: MapView
    site_odom: Array
    """(3,) where the vehicle is going to touch down"""
    touchdown_s: float
    """time until then"""
    known: GridMap | None
    """the map around the site as it was when the site was chosen, a copy; None where there is
    none"""


class Watch(Protocol):
    """Looks at the landing place while the vehicle descends to it. ``look`` is called in each
    control step from 15 m above the ground to the touchdown; it must be deterministic, must not
    modify its input, and must take for a message only what has arrived. After a break of more than
    a second it begins anew."""

    needs: SensorNeeds

    def look(self, seen: WatchInput) -> WatchReport: ...
