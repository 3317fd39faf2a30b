"""The public interface of landing: selection, classification, lander and their parameters."""

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
    """Phases of a landing mission, in the order of a flight that succeeds."""

    INIT = "INIT"
    TAKEOFF = "TAKEOFF"
    SURVEY = "SURVEY"
    SELECT = "SELECT"
    APPROACH = "APPROACH"
    DESCEND = "DESCEND"
    TOUCHDOWN = "TOUCHDOWN"
    RETURN = "RETURN"
    DONE = "DONE"


TermName = Literal[
    "safe_probability", "energy", "clearance", "level",
    "smoothness", "flatness", "distance",
    "traffic", "plants",
]  # fmt: skip
"""Terms of the value of a site: the first four of the scorer ``risk``, the next three of ``paper``,
the last two of both."""

SiteRule = Literal[
    "highest_value", "lower_value", "least_bad", "commanded", "commanded_unchecked",
    "not_seen", "few_returns", "rough", "steep", "step", "object", "motion", "water",
    "tall_neighbour", "map_edge", "out_of_reach", "near_refused_site",
    "low_probability", "footprint_slope", "footprint_roughness",
    "unsafe_ground", "uncertain_ground", "unfamiliar_ground", "no_image",
]  # fmt: skip
"""Rules that prefer a site (first line), or refuse it by map, plane or class of the ground."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ScoreTerm:
    """One term of the value of a site."""

    name: TermName
    value: float
    """weighted: the terms of a site add up to its value"""
    quantity: float
    """what the term weights, in ``unit``"""
    unit: str
    """"" where it has none"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Candidate:
    """A candidate landing site, odom frame."""

    position_odom: Array
    """(3,) centre, on the ground"""
    normal_odom: Array
    """(3,) unit normal of the plane through the footprint"""
    c_sum: float
    """of the paper (Eq. 13), higher is better; 0 where unknown"""
    slope_deg: float
    roughness_m: float
    """largest |residual| to the plane within the footprint"""
    clearance_m: float
    """distance to the nearest cell that is not landable"""
    accepted: bool
    reason: str
    """reason of the acceptance or the refusal, as text"""
    rule: SiteRule
    value: float = float("nan")
    """what sites are ranked by, higher is better; NaN out of reach or unknown"""
    terms: tuple[ScoreTerm, ...] = ()
    """of ``value``"""
    cluster_bonus: float = 0.0
    """for clearance, beside ``value``: it chose this cell of its cluster, and ranks none"""
    step_m: float = float("nan")
    """highest step within the footprint"""
    safe_probability: float = float("nan")
    """of a touchdown that is safe by geometry; NaN where the scorer gives none"""
    class_predicted: str | None = None
    """most probable class of the ground; None where it was not classified"""
    class_probability: float = float("nan")
    """of ``class_predicted``"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Decision:
    """One choice among candidate sites."""

    time_s: float
    scorer: str
    candidates: tuple[Candidate, ...]
    """in the order of rank: accepted ones first, each part by value"""
    positions_world: Array
    """(N, 3) of the candidates, by the estimate of that moment"""
    why: str
    """why the first one won, or why there is none: one sentence"""
    given_up: str = ""
    """reason why the chosen site was given up later; empty where it was not"""


@dataclass(frozen=True, kw_only=True, slots=True)
class CostmapView:
    """The costmaps of one selection, for figures and recordings: rasters (rows, cols) float32 in
    [0, 1], higher is better, NaN where unknown, with ``origin_xy_m`` and ``cell_m`` (odom
    frame)."""

    origin_xy_m: Array
    cell_m: float
    total: NDArray[np.float32]
    flatness: NDArray[np.float32]
    smoothness: NDArray[np.float32]
    distance: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    value: NDArray[np.float32]
    """what sites are ranked by: ``total``, or the sum of the terms of the scorer; any range"""
    allowed: NDArray[np.bool_]
    """cells that the selector accepts as sites"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Selection:
    """One decision and its intermediate results; rasters (rows, cols) aligned with ``costmap``."""

    candidates: tuple[Candidate, ...]
    """accepted ones first, best first"""
    costmap: CostmapView | None
    """None where nothing was mapped; then the rasters are empty"""
    allowed: NDArray[np.bool_]
    """cells that the selector accepts as sites"""
    probability: NDArray[np.float32]
    """of a touchdown that is safe by geometry, by `landing.selection.risk`"""
    cluster: NDArray[np.int32]
    """number of the cluster (Eq. 19) that a cell belongs to, -1 outside"""
    modes: NDArray[np.int32]
    """(K, 2) row and col of each cluster's mode"""
    traffic_zone: NDArray[np.bool_] = field(default_factory=lambda: np.zeros((0, 0), np.bool_))
    """cells near a surface on which motion was observed"""


@dataclass(frozen=True, kw_only=True, slots=True)
class LanderView:
    """State of the lander for the recorder and the referee."""

    phase: Phase
    note: str
    """the last decision, as text"""
    candidates: tuple[Candidate, ...]
    costmap: CostmapView | None
    site_world: Array | None
    """(3,) the current target site, world frame"""
    committed_site_world: Array | None
    """(3,) the site as committed at 4 m, immutable after"""
    reference_world: Array
    """(3,) current position of the reference trajectory"""
    no_site: bool
    """no safe site was found: returning to the take-off spot"""
    aborted: bool
    """the landing was given up for another reason (a refused ``--site``, an unhealthy estimate)"""
    site_class: str | None = None
    """predicted class of the ground at the site; None without ground classification"""
    site_class_probability: float = float("nan")
    """of ``site_class``"""
    events: tuple[str, ...] = ()
    """messages of this control step, for the result"""
    decisions: tuple[Decision, ...] = ()
    """all so far, in the order of time"""
    slowed_s: float = 0.0
    """time by which wind has made trajectories longer than they were set, so far"""


@dataclass(frozen=True, kw_only=True, slots=True)
class GroundPrediction:
    """Predictions of a ground classifier for N images."""

    probabilities: Array
    """(N, 7) calibrated probabilities of ``scenes.api.LAND_CLASSES``, in their order"""
    in_distribution: NDArray[np.bool_]
    """(N,) False where an image lies far from the training data"""


class GroundClassifier(Protocol):
    """Predicts the class of the ground in square aerial images."""

    @property
    def image_size(self) -> int:
        """Side of the images that ``classify`` takes, pixels."""

    @property
    def min_probability(self) -> float:
        """Probability of safe ground below which an image counts as unsafe."""

    def classify(self, images: NDArray[np.uint8]) -> GroundPrediction:
        """Returns the predictions for images (N, S, S, 3) RGB with S = ``image_size``."""


class Lander(Protocol):
    """Flies the mission: turns estimates and maps into setpoints."""

    needs: SensorNeeds

    @property
    def phase(self) -> Phase:
        """Current phase of the mission."""

    def update(self, obs: Observation, estimate: Estimate, map_view: MapView) -> Setpoint:
        """Returns the setpoint of this control step; called once a step."""

    def view(self) -> LanderView:
        """Returns the current state for recorder and referee."""


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
    """time from the start of the first leg to the end of the last, where the wind lets the vehicle
    keep it"""
    climb_turn_deg: Annotated[float, Interval(ge=-360.0, le=360.0)] = 0.0
    """turn of the heading during the climb, which the survey keeps; 180 separates the
    accelerometer's bias from errors of roll and pitch"""
    min_height_m: Positive = 20.0
    """lowest height of the survey where the wind at ``height_m`` is too strong; above all
    obstacles"""


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
    """``risk``: sites are ranked by the probability of a safe touchdown; ``paper``: by C_sum (Eq.
    13) among sites that pass the geometric check"""
    min_safe_probability: Fraction = 0.95
    """a site with a lower probability of a safe touchdown is refused (``risk``)"""
    energy_weight: NotNegative = 0.05
    """penalty of the farthest site within reach relative to the nearest one (``risk``)"""
    level_weight: NotNegative = 0.2
    """penalty of ground at ``max_slope_deg`` relative to level ground (``risk``)"""
    gust_drift_s: NotNegative = 0.02
    """metres by which each m/s of wind reduces the clearance of a site (``risk``)"""
    clearance_weight: NotNegative = 0.1
    """bonus of a site with a clearance of ``clearance_full_m`` over one with none (``risk``); among
    the cells of one cluster, of one with ``clearance_enough_m`` (both scorers)"""
    clearance_full_m: Positive = 3.0
    """distance to ground that is not allowed from which the value no longer rises: twice
    ``clear_radius_m``"""
    clearance_enough_m: Positive = 1.0
    """the same within a cluster: the radius of a footprint"""
    plants_penalty: NotNegative = 0.15
    """subtracted from the value of a site among low plants, whose ground is inferred from few
    returns: more than the difference between two good sites on bare ground, less than
    ``traffic_penalty``"""
    refused_radius_m: NotNegative = 3.0
    """radius around a refused site in which no site is accepted again: twice ``clear_radius_m``, so
    that the two do not overlap"""
    candidate_spacing_m: NotNegative = 3.0
    """least distance between the candidates of a selection: twice ``clear_radius_m``"""
    risk_weights: tuple[
        float, float, float, float, float, float, float, float, float, float, float
    ] = (
        11.87, -1.83, -1.21, -0.2, -0.2, -0.2, -5.49, -0.2, -0.2, -1.06, -1.30,
    )  # fmt: skip
    """log-odds of a safe touchdown: constant; slope, step, object, spread, neighbour, confinement,
    sparsity and age (``landing.selection.risk_features``); the worst of slope, step and neighbour,
    and its excess over 0.8. Fitted by ``touchdown bench selector --fit``"""
    emergency: Literal["", "battery"] = ""
    """``battery``: land within ``emergency_s`` on the least bad site; empty: no emergency"""
    emergency_s: Positive = 45.0
    """from the end of the survey to the ground in an emergency"""
    site_xy_m: tuple[float, float] | None = None
    """a commanded site (world frame) instead of a chosen one"""
    check_site: bool = True
    """refuse a commanded site that is unsuitable by the map; off, it is accepted unchecked, for
    methods whose maps are no better than their positions"""
    survey_only: bool = False
    """stop after the survey (the positioning experiment)"""
    return_home: bool = False
    """after the survey back to the take-off spot, and down there, without choosing a site"""
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
    flatness_form: Literal["corrected", "literal"] = "corrected"
    """``corrected``, or Eqs. 16 and 17 to the letter"""
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
    """distance to an edge from which the smoothness term is 1"""
    slope_margin_deg: NotNegative = 0.5
    """taken off ``max_slope_deg`` for the error of the map"""
    step_margin_m: NotNegative = 0.02
    """taken off ``max_step_m`` for the error of the map"""
    map_margin_m: NotNegative = 0.35
    """margin around the footprint for the error of map and position at survey height"""
    low_margin_m: NotNegative = 0.15
    """the same margin at 10 m and below"""
    min_returns: NotNegative = 4.0
    """a cell with fewer is refused"""
    max_missing_ratio: Annotated[float, Interval(gt=0.0, le=1.0)] = 0.2
    """share of pulses without a return above which the ground counts as water"""
    traffic_penalty: NotNegative = 0.3
    """subtracted from the value of a site near a surface on which motion was observed"""
    max_candidates: Count = 12
    """candidates examined in one selection"""
    search_legs: CountOrZero = 1
    """additional survey legs where no site was found"""
    go_arounds: CountOrZero = 2
    """landings that may be broken off for another site"""
    unhealthy_hold_s: NotNegative = 1.0
    """duration of an unhealthy estimate after which the vehicle holds its position"""
    unhealthy_abort_s: NotNegative = 8.0
    """duration of an unhealthy estimate after which the vehicle descends where it is"""
    slow_in_wind: bool = False
    """slow the reference down where its motion through the felt wind would need more than the next
    three keys allow, and fly the survey lower where the wind leaves a hover no margin; where it
    does not, the reference keeps its time, to the bit"""
    wind_thrust_share: Annotated[float, Interval(gt=0.0, le=1.0)] = 0.94
    """largest mean rotor speed, over the fastest one, that the reference may need"""
    wind_tilt_deg: Annotated[float, Interval(gt=0.0, lt=60.0)] = 31.0
    """largest tilt that the reference may need, below control.max_tilt_deg"""
    wind_gust_share: NotNegative = 0.1
    """gusts that the reference leaves room for, over the felt wind"""
    climb_speed_mps: Positive = 3.0
    """vertical speed of the climb"""
    cruise_speed_mps: Positive = 7.0
    """horizontal speed between survey and site"""
    accel_mps2: Positive = 1.5
    """acceleration of straight ways: to the site, its correction and the sweep"""
    descent_speed_mps: Positive = 2.5
    """vertical speed of the descent"""
    obstacle_margin_m: NotNegative = 6.0
    """vertical clearance above the map on the way to the site"""
    look_height_m: Positive = 10.0
    """height above the site of the second look"""
    look_s: NotNegative = 1.0
    """hover before each look"""
    commit_height_m: Positive = 4.0
    """height above the site at which the site becomes final"""
    sweep_m: NotNegative = 1.0
    """half the width of the sweep at ``commit_height_m``"""
    final_speed_mps: Positive = 0.6
    """vertical speed below ``commit_height_m``"""
    final_accel_mps2: Positive = 0.5
    """vertical acceleration below ``commit_height_m``"""
    touchdown_speed_mps: Positive = 0.09
    """vertical speed at the first contact"""
    classifier: str = "auto"
    """``auto``: the network that is shipped with the project, if there is one; ``off``: sites are
    checked by geometry alone; else the path of a network's file"""
    classifier_min_probability: Fraction = 0.0
    """probability of a safe class below which a site is refused; 0: the limit in the network's
    file"""
    classifier_batch: Count = 3
    """sites that are classified in one batch; the batch with the first safe one is the last"""
    classifier_rounds: Count = 4
    """selections in all where no site is of a safe class"""
    classifier_patch_m: Positive = 6.4
    """side of the ground patch around a site that is classified"""
    classifier_images: Count = 64
    """largest number of survey images that are kept for classification"""
    classifier_batch_latency_s: NotNegative = 0.1
    """simulated compute time of each batch"""
    classifier_threads: Count = 1
    """of the processor, for classification"""
    allow_risky: bool = False
    """accept roads and roofs too; such a landing is judged by geometry"""


@dataclass(frozen=True, kw_only=True, slots=True)
class LabelledImages:
    """Aerial images of ground with their classes."""

    images: NDArray[np.uint8]
    """(N, S, S, 3) RGB"""
    labels: NDArray[np.int64]
    """(N,) index into ``classes``"""
    classes: tuple[str, ...]
    source: NDArray[np.int64]
    """(N,) index into ``sources``, the data sets of the images"""
    sources: tuple[str, ...]
