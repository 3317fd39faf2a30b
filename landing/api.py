"""What the rest of the project may know of landing."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated, Literal, Protocol

import numpy as np
from annotated_types import Interval
from numpy.typing import NDArray

from touchdown.controller.api import Setpoint
from touchdown.estimator.api import Estimate, MapView
from touchdown.sim.api import (
    FORBID_EXTRA,
    Count,
    CountOrZero,
    Fraction,
    NotNegative,
    Observation,
    Positive,
    SensorNeeds,
)

Array = NDArray[np.float64]


class Phase(StrEnum):
    INIT = "INIT"
    TAKEOFF = "TAKEOFF"
    SURVEY = "SURVEY"
    SELECT = "SELECT"
    APPROACH = "APPROACH"
    DESCEND = "DESCEND"
    TOUCHDOWN = "TOUCHDOWN"
    RETURN = "RETURN"
    DONE = "DONE"


@dataclass(frozen=True, kw_only=True, slots=True)
class Candidate:
    """A possible landing site, odom frame."""

    position_odom: Array
    """(3,) centre, on the ground"""
    normal_odom: Array
    """(3,) unit normal of the plane through the footprint"""
    score: float
    """C_sum at the mode (Eq. 13), higher is better"""
    flatness: float
    smoothness: float
    distance: float
    slope_deg: float
    roughness_m: float
    """largest |residual| to the plane within the footprint"""
    clearance_m: float
    """distance to the nearest cell that is not landable"""
    accepted: bool
    reason: str
    """why it was chosen or refused, in words"""
    safe_probability: float = float("nan")
    """of a touchdown that is safe by geometry; NaN where the scorer does not say"""
    class_predicted: str | None = None
    """what ground classification takes the ground for; None where it was not asked"""
    class_probability: float = float("nan")
    """of ``class_predicted``"""


@dataclass(frozen=True, kw_only=True, slots=True)
class CostmapView:
    """The costmaps of one selection, for pictures and recordings; (rows, cols) float32 in [0, 1],
    higher is better, NaN where unknown, on the grid ``origin_xy_m``, ``cell_m`` (odom frame)."""

    origin_xy_m: Array
    cell_m: float
    total: NDArray[np.float32]
    flatness: NDArray[np.float32]
    smoothness: NDArray[np.float32]
    distance: NDArray[np.float32]
    rgb: NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True, slots=True)
class Selection:
    """One decision with all that led to it; rasters (rows, cols) on the grid of ``costmap``."""

    candidates: tuple[Candidate, ...]
    """accepted ones first, best first"""
    costmap: CostmapView | None
    """None where nothing was mapped; then the rasters are empty"""
    allowed: NDArray[np.bool_]
    """cells that the selector would land on"""
    probability: NDArray[np.float32]
    """of a touchdown that is safe by geometry, as `landing.selection.risk` believes"""
    cluster: NDArray[np.int32]
    """number of the cluster (Eq. 19) that a cell belongs to, -1 outside"""
    modes: NDArray[np.int32]
    """(K, 2) row and col of each cluster's mode"""
    driven: NDArray[np.bool_] = field(default_factory=lambda: np.zeros((0, 0), np.bool_))
    """near a surface on which something was seen to move"""


@dataclass(frozen=True, kw_only=True, slots=True)
class LanderView:
    """What the recorder and the referee may see of the lander."""

    phase: Phase
    note: str
    """the last decision in words"""
    candidates: tuple[Candidate, ...]
    costmap: CostmapView | None
    site_world: Array | None
    """(3,) the site flown to, world frame"""
    committed_site_world: Array | None
    """(3,) the site as committed at 4 m, immutable after"""
    reference_world: Array
    """(3,) position of the reference trajectory now"""
    no_site: bool
    """no safe site was found: returning to the take-off spot"""
    aborted: bool
    """gave up for another reason (a refused ``--site``, energy)"""
    site_class: str | None = None
    """what ground classification takes the ground of the site for; None where it is off"""
    site_class_probability: float = float("nan")
    """of ``site_class``"""


@dataclass(frozen=True, kw_only=True, slots=True)
class PlaceOpinion:
    """What a classifier says of N pictures."""

    chances: Array
    """(N, 7) calibrated probabilities of ``scenes.api.LAND_CLASSES``, in their order"""
    familiar: NDArray[np.bool_]
    """(N,) False where a picture is far from all that the classifier was trained on"""


class GroundClassifier(Protocol):
    """Names the kind of ground in square pictures from the air."""

    @property
    def image_size(self) -> int:
        """Pixels across that ``look`` takes."""

    @property
    def least_probability(self) -> float:
        """Of safe ground, below which a picture counts as unsafe: what suits the classifier."""

    def look(self, pictures: NDArray[np.uint8]) -> PlaceOpinion:
        """Of pictures (N, S, S, 3) RGB with S = ``image_size``."""


class Lander(Protocol):
    needs: SensorNeeds

    @property
    def phase(self) -> Phase: ...

    def update(self, obs: Observation, estimate: Estimate, map_view: MapView) -> Setpoint: ...

    def view(self) -> LanderView: ...


@dataclass(frozen=True, kw_only=True, slots=True)
class SurveyParams:
    """The circuitous scan of the paper's Fig. 9a: legs joined by minimum-jerk turns."""

    __pydantic_config__ = FORBID_EXTRA

    height_m: Positive = 30.0
    """above the take-off ground"""
    legs: Count = 3
    """number of parallel legs"""
    leg_length_m: Positive = 50.0
    """length of a leg"""
    leg_spacing_m: Positive = 20.0
    """distance between neighbouring legs"""
    duration_s: Positive = 36.0
    """time from the start of the first leg to the end of the last"""


@dataclass(frozen=True, kw_only=True, slots=True)
class LandingParams:
    __pydantic_config__ = FORBID_EXTRA

    weight_flatness: NotNegative = 0.5
    """weight of flatness in C_sum (Eq. 13)"""
    weight_smoothness: NotNegative = 0.3
    """weight of smoothness in C_sum"""
    weight_distance: NotNegative = 0.2
    """weight of distance in C_sum"""
    scorer: Literal["risk", "paper"] = "risk"
    """``risk``: by the probability of a safe touchdown; ``paper``: by C_sum (Eq. 13) among sites
    that pass the check of the ground"""
    min_safe_probability: Fraction = 0.95
    """a site that is less likely to be safe is refused (``risk``)"""
    energy_weight: NotNegative = 0.05
    """what the farthest site within reach loses beside the nearest one (``risk``)"""
    level_weight: NotNegative = 0.2
    """what ground at ``max_slope_deg`` loses beside level ground (``risk``)"""
    gust_drift_s: NotNegative = 0.02
    """metres that each m/s of wind takes off the room around a site (``risk``)"""
    risk_weights: tuple[
        float, float, float, float, float, float, float, float, float, float, float
    ] = (
        11.87, -1.83, -1.21, -0.2, -0.2, -0.2, -5.49, -0.2, -0.2, -1.06, -1.30,
    )  # fmt: skip
    """log-odds of a safe touchdown: constant; slope, step, object, spread, neighbour, confinement,
    sparsity and age (``landing.selection.risk_features``); the worst of slope, step and neighbour,
    and what that has beyond 0.8. Fitted by ``touchdown bench selector --fit``"""
    emergency: Literal["", "battery"] = ""
    """``battery``: land within ``emergency_s`` on the least bad site; empty: no emergency"""
    emergency_s: Positive = 45.0
    """from the end of the survey to the ground in an emergency"""
    site_xy_m: tuple[float, float] | None = None
    """a commanded site (world frame) instead of a chosen one"""
    check_site: bool = True
    """whether a commanded site that the map says is unsuitable is refused; off, it is flown to on
    the word of whoever commands it, for methods whose maps are no better than their positions"""
    survey_only: bool = False
    """stop after the survey (the positioning experiment)"""
    second_look: bool = True
    """look at the site again from ``look_height_m`` before landing on it"""
    decision_latency_s: NotNegative = 0.3
    """simulated time that a site selection takes"""
    max_slope_deg: Annotated[float, Interval(gt=0.0, lt=90.0)] = 5.0
    """steepest ground that is landed on"""
    max_step_m: Positive = 0.10
    """highest step or object under the footprint"""
    clear_radius_m: Positive = 1.5
    """radius around the site that must be free of taller objects"""
    flatness_form: str = "corrected"
    """``corrected`` or ``literal`` (Eqs. 16 and 17 to the letter)"""
    flatness_sigma_deg: Positive = 5.0
    """sigma of Eq. 16 in the corrected form"""
    normal_half_width_m: Positive = 0.5
    """half the window that normals are fitted in"""
    edge_blur_m: NotNegative = 0.3
    """sigma of the blur before Canny"""
    edge_low: Annotated[float, Interval(ge=0.0, le=255.0)] = 40.0
    """lower hysteresis threshold of Canny on the 8-bit colour map"""
    edge_high: Annotated[float, Interval(ge=0.0, le=255.0)] = 100.0
    """hysteresis thresholds of Canny on the 8-bit colour map"""
    smoothness_full_m: Positive = 8.0
    """an edge farther away than this costs nothing more"""
    slope_margin_deg: NotNegative = 0.5
    """taken off ``max_slope_deg`` for the error of the map"""
    step_margin_m: NotNegative = 0.02
    """taken off ``max_step_m`` for the error of the map"""
    map_margin_m: NotNegative = 0.35
    """the footprint is widened by this: error of map and position from survey height"""
    low_margin_m: NotNegative = 0.15
    """the same for a look from 10 m and below"""
    min_returns: NotNegative = 4.0
    """a cell with fewer is not trusted"""
    max_missing_ratio: Annotated[float, Interval(gt=0.0, le=1.0)] = 0.2
    """share of pulses without return above which the ground counts as water"""
    traffic_penalty: NotNegative = 0.3
    """taken off C_sum when sites are ranked, near a surface on which something was seen to move"""
    max_candidates: Count = 12
    """candidates examined in one selection"""
    search_legs: CountOrZero = 1
    """further survey legs when no site was found"""
    go_arounds: CountOrZero = 2
    """landings that may be broken off for another site"""
    unhealthy_hold_s: NotNegative = 1.0
    """an estimate that says it is unhealthy for this long stops the vehicle where it is"""
    unhealthy_abort_s: NotNegative = 8.0
    """and for this long ends the flight: straight down"""
    climb_speed_mps: Positive = 3.0
    """vertical speed of the climb"""
    cruise_speed_mps: Positive = 7.0
    """horizontal speed between survey and site"""
    descent_speed_mps: Positive = 2.5
    """vertical speed of the descent"""
    obstacle_margin_m: NotNegative = 6.0
    """height above anything mapped while flying over it"""
    look_height_m: Positive = 10.0
    """height above the site of the second look"""
    commit_height_m: Positive = 4.0
    """height above the site at which the site becomes final"""
    sweep_m: NotNegative = 1.0
    """half the width of the sweep at ``commit_height_m``"""
    final_speed_mps: Positive = 0.6
    """vertical speed below ``commit_height_m``"""
    touchdown_speed_mps: Positive = 0.09
    """vertical speed at the first contact"""
    classifier: str = "auto"
    """``auto``: by the network that comes with the project, if one does; ``off``: sites are judged
    by geometry alone; else the path of a network's file"""
    classifier_min_probability: Fraction = 0.0
    """of a safe class, below which a site is refused; 0: what the network's file says"""
    place_batch: Count = 3
    """sites that are classified together, before the first safe one ends it"""
    place_rounds: Count = 4
    """how often other sites are looked for where none was of a safe class"""
    classifier_patch_m: Positive = 6.4
    """side of the square of ground around a site that is classified"""
    place_pictures: Count = 64
    """pictures of the survey that are kept for it"""
    place_batch_latency_s: NotNegative = 0.1
    """what a decision takes longer for every batch"""
    classifier_threads: Count = 1
    """of the processor, that classify"""
    allow_risky: bool = False
    """land on roads and roofs too; such a flight is judged on geometry"""


@dataclass(frozen=True, kw_only=True, slots=True)
class LabelledPictures:
    """Pictures of ground from the air, and what each shows."""

    images: NDArray[np.uint8]
    """(N, S, S, 3) RGB"""
    labels: NDArray[np.int64]
    """(N,) index into ``classes``"""
    classes: tuple[str, ...]
    source: NDArray[np.int64]
    """(N,) index into ``sources``, the data sets that they come from"""
    sources: tuple[str, ...]
