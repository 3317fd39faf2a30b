"""The public interface of landing: selection, classification, lander and their parameters."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from touchdown.controller.api import Setpoint
from touchdown.estimator.api import Estimate, MapView
from touchdown.landing.parameters import GateName as GateName
from touchdown.landing.parameters import GroundParams as GroundParams
from touchdown.landing.parameters import LandingParams as LandingParams
from touchdown.landing.parameters import SelectorParams as SelectorParams
from touchdown.landing.parameters import SemanticMapParams as SemanticMapParams
from touchdown.landing.parameters import SurveyParams as SurveyParams
from touchdown.landing.parameters import TermName as TermName
from touchdown.landing.parameters import Zou2024SelectorParams as Zou2024SelectorParams
from touchdown.landing.watching import Finding as Finding
from touchdown.landing.watching import Verdict as Verdict
from touchdown.landing.watching import Watch as Watch
from touchdown.landing.watching import WatchInput as WatchInput
from touchdown.landing.watching import WatchReport as WatchReport
from touchdown.landing.watching import WatchRig as WatchRig
from touchdown.sim.api import Observation, SensorNeeds, SensorRig, VehicleModel
from touchdown.sim.typing import Array


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


SiteRule = Literal[
    "highest_value", "lower_value", "least_bad", "commanded", "commanded_unchecked",
    "not_seen", "few_returns", "rough", "steep", "step", "object", "motion", "water",
    "tall_neighbour", "map_edge", "out_of_reach", "near_refused_site",
    "low_probability", "footprint_slope", "footprint_roughness",
    "unsafe_ground", "uncertain_ground", "unfamiliar_ground", "no_image", "by_selector",
]  # fmt: skip
"""Rules that prefer a site (first line), or refuse it by map, plane or class of the ground, or for
a reason of an external selector's own."""

RULE_KEYS: Mapping[str, str] = {
    "low_probability": "landing.min_safe_probability",
    "steep": "landing.max_slope_deg",
    "footprint_slope": "landing.max_slope_deg",
    "step": "landing.max_step_m",
    "object": "landing.max_step_m",
    "rough": "landing.ground.rough_std_m",
    "footprint_roughness": "landing.max_step_m",
    "tall_neighbour": "landing.ground.tall_m",
    "water": "landing.max_missing_ratio",
    "few_returns": "landing.min_returns",
    "not_seen": "survey.legs",
    "map_edge": "survey.legs",
    "near_refused_site": "landing.refused_radius_m",
    "unsafe_ground": "landing.allowed_classes",
    "uncertain_ground": "landing.unknown_ground",
    "unfamiliar_ground": "landing.unknown_ground",
    "no_image": "landing.classifier",
}
"""The key that decides what a rule refuses; rules without one follow from energy."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ScoreTerm:
    """One term of the value of a site."""

    name: str
    """a `TermName`, or that of an external selector's own"""
    value: float
    """weighted: the terms of a site add up to its value"""
    quantity: float = float("nan")
    """what the term weights, in ``unit``"""
    unit: str = ""
    """"" where it has none"""


@dataclass(frozen=True, kw_only=True, slots=True)
class TermLayer:
    """One term of the score in every cell, (rows, cols); NaN unknown."""

    name: str
    """name of the term, as in `ScoreTerm`"""
    value: NDArray[np.float32]
    """weighted, as it is added"""
    quantity: NDArray[np.float32]
    """what the term is made of, in ``unit``"""
    unit: str = ""


@dataclass(frozen=True, kw_only=True, slots=True)
class Candidate:
    """A candidate landing site, odom frame."""

    position_odom: Array
    """(3,) centre, on the ground"""
    c_sum: float
    """Eq. 13 with the weights of ``landing.zou2024``, higher is better; 0 where unknown"""
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
    """terms that add up to ``value``"""
    cluster_bonus: float = 0.0
    """bonus for clearance, beside ``value``: it chose this cell of its cluster, and ranks none"""
    step_m: float = float("nan")
    """highest step within the footprint"""
    safe_probability: float = float("nan")
    """probability of a touchdown that is safe by geometry; NaN for a site of an external selector
    and off the map"""
    class_predicted: str | None = None
    """most probable class of the ground; None where it was not classified"""
    class_probability: float = float("nan")
    """probability of ``class_predicted``"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Decision:
    """One choice among candidate sites."""

    time_s: float
    selector: str
    candidates: tuple[Candidate, ...]
    """candidates in the order of rank: accepted ones first, each part by value"""
    positions_world: Array
    """(N, 3) of the candidates, by the estimate of that moment"""
    why: str
    """why the first one won, or why there is none: one sentence"""
    given_up: str = ""
    """reason why the chosen site was given up later; empty where it was not"""


@dataclass(frozen=True, kw_only=True, slots=True)
class SemanticView:
    """The semantic map: nodes (rows, cols) of a grid, odom frame."""

    origin_xy_m: Array
    """(2,) of the first node"""
    spacing_m: float
    probabilities: NDArray[np.float32]
    """(rows, cols, 7) of ``scenes.api.LAND_CLASSES``, fused over all views; uniform where nothing
    was seen"""
    weight: NDArray[np.float32]
    """(rows, cols) reliable views of a node; 0 without one"""


@dataclass(frozen=True, kw_only=True, slots=True)
class CostmapView:
    """The costmaps of one selection, for figures and recordings: rasters (rows, cols) float32 in
    [0, 1], higher is better, NaN where unknown, with ``origin_xy_m`` and ``cell_m`` (odom
    frame)."""

    origin_xy_m: Array
    cell_m: float
    total: NDArray[np.float32]
    """C_sum (Eq. 13) of the next three"""
    flatness: NDArray[np.float32]
    smoothness: NDArray[np.float32]
    distance: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    value: NDArray[np.float32]
    """what sites are ranked by, the sum of ``terms``; any range"""
    allowed: NDArray[np.bool_]
    """cells that the selector accepts as sites"""
    terms: tuple[TermLayer, ...] = ()
    """terms of the selector"""
    semantics: SemanticView | None = None
    """the semantic map that the selector read"""


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
    """probability of a touchdown that is safe by geometry, by
    `landing.selection.probability`; of an external selector the quantity of its term
    ``probability``, without that 1 where a site is accepted"""
    cluster: NDArray[np.int32]
    """number of the cluster (Eq. 19) that a cell belongs to, -1 outside"""
    modes: NDArray[np.int32]
    """(K, 2) row and col of each cluster's mode"""
    traffic_zone: NDArray[np.bool_] = field(default_factory=lambda: np.zeros((0, 0), np.bool_))
    """cells near a surface on which motion was observed"""


@dataclass(frozen=True, kw_only=True, slots=True)
class SelectorRig:
    """What a selector knows before the flight."""

    vehicle: VehicleModel
    """the airframe's data sheet: ``footprint_radius_m``, ``leg_height_m`` and more"""
    landing: LandingParams
    """keys ``landing.*``: what ground is safe to land on, such as ``max_slope_deg``, and how many
    candidates are examined"""


@dataclass(frozen=True, kw_only=True, slots=True)
class SelectorInput:
    """What a selector knows at a decision; positions in the odom frame."""

    map_view: MapView
    """the elevation map; ``coarse`` covers the survey"""
    estimate: Estimate
    """pose and motion of the hovering vehicle"""
    reach_m: float = float("inf")
    """horizontal distance to a site that the remaining energy allows"""
    avoid_odom: Array = field(default_factory=lambda: np.zeros((0, 3)))
    """(N, 3) sites that were refused already: no site within ``landing.refused_radius_m`` of one is
    taken"""
    unsafe_ground_odom: Array = field(default_factory=lambda: np.zeros((0, 3)))
    """(N, 3) those of them that were refused for the kind of their ground"""
    wind_mps: float = 0.0
    """estimated wind speed"""
    semantics: SemanticView | None = None
    """class of the ground as all views so far show it; None without ground classification"""
    emergency: bool = False
    """the first site in reach is taken even where none is accepted"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Site:
    """A landing site that a selector offers."""

    position_odom: Array
    """(2,) or (3,) centre, odom frame; the height of the ground is that of the map"""
    terms: tuple[ScoreTerm, ...]
    """terms that add up to what ranks the site, higher is better; each site has terms of these
    names"""
    accepted: bool = True
    reason: str = ""
    """why it is accepted or refused, in words"""


@dataclass(frozen=True, kw_only=True, slots=True)
class RankedSites:
    """The answer of a selector."""

    sites: tuple[Site, ...]
    """the best first; ``landing.max_candidates`` of them are examined"""
    layers: tuple[TermLayer, ...] = ()
    """the terms in every cell, (rows, cols) of the coarse map: they are drawn as the costmap; the
    quantity of one named ``probability`` is that of a safe touchdown, which `bench selector`
    judges"""


class Selector(Protocol):
    """``select`` is called while the vehicle hovers: at the end of the survey, after a further leg,
    after a go-around, and again where ground classification has refused all sites. It must be
    deterministic, must not modify its input, and returns no site where nothing is mapped."""

    def select(self, seen: SelectorInput) -> RankedSites: ...


@dataclass(frozen=True, kw_only=True, slots=True)
class LanderView:
    """State of the lander for the recorder and the referee."""

    phase: Phase
    reference_world: Array
    """(3,) current position of the reference trajectory"""
    note: str = ""
    """the last decision, as text"""
    candidates: tuple[Candidate, ...] = ()
    costmap: CostmapView | None = None
    site_world: Array | None = None
    """(3,) the current target site, world frame"""
    committed_site_world: Array | None = None
    """(3,) the site as committed at 4 m, immutable after"""
    no_site: bool = False
    """no safe site was found: returning to the take-off spot"""
    aborted: bool = False
    """the landing was given up for another reason (a refused ``--site``, an unhealthy estimate)"""
    site_class: str | None = None
    """predicted class of the ground at the site; None without ground classification"""
    site_class_probability: float = float("nan")
    """probability of ``site_class``"""
    events: tuple[str, ...] = ()
    """messages of this control step, for the result"""
    decisions: tuple[Decision, ...] = ()
    """all so far, in the order of time"""
    watch: WatchReport | None = None
    """what the watch says in this control step; None where it does not look"""
    slowed_s: float = 0.0
    """time by which wind has made trajectories longer than they were set, so far"""


@dataclass(frozen=True, kw_only=True, slots=True)
class GroundPrediction:
    """Predictions of a ground classifier for N images."""

    probabilities: Array
    """(N, 7) calibrated probabilities of ``scenes.api.LAND_CLASSES``, in their order"""
    in_distribution: NDArray[np.bool_]
    """(N,) False where an image lies far from the training data"""


@dataclass(frozen=True, kw_only=True, slots=True)
class ClassifierRig:
    """What a ground classifier knows before the flight."""

    classes: tuple[str, ...]
    """classes of the ground, in the order of probabilities: ``scenes.api.LAND_CLASSES``"""
    patch_m: float
    """side of the square of ground that an image shows, metres"""
    landing: LandingParams
    """keys ``landing.*``: the classes that are landed on and more"""


class GroundClassifier(Protocol):
    """Predicts the class of the ground in square aerial images. ``classify`` is called at a
    decision with patches around candidate sites, ``landing.classifier_batch`` at most, each call
    taking ``landing.classifier_batch_latency_s`` of simulated time, at the recheck with one,
    and for the semantic map with ``landing.semantics.squares`` every tenth of a second. Images are
    level and along the axes of the camera, without haze and lens distortion. It must be
    deterministic and must not modify its input."""

    @property
    def image_size(self) -> int:
        """Side of the images that ``classify`` takes, pixels."""

    @property
    def min_probability(self) -> float:
        """Probability of safe ground below which an image counts as unsafe."""

    def classify(self, images: NDArray[np.uint8]) -> GroundPrediction:
        """Returns the predictions for images (N, S, S, 3) RGB with S = ``image_size``."""


@dataclass(frozen=True, kw_only=True, slots=True)
class LanderRig:
    """What a lander knows before the flight."""

    sensors: SensorRig
    """calibration and data sheets, as an estimator knows them; with the take-off pose"""
    landing: LandingParams
    """keys ``landing.*``: speeds, limits, ``survey_only`` and more"""
    survey: SurveyParams
    """keys ``survey.*``: what is to be surveyed"""
    select: Callable[[SelectorInput], Selection]
    """the flight's selector, shipped or external"""
    classifier: GroundClassifier | None
    """the flight's ground classifier; None without one"""
    watch: Watch | None = None
    """the flight's watch; None where it is off"""


class Lander(Protocol):
    """Flies the mission: turns estimates and maps into setpoints. The phase of ``view`` tells the
    referee what is flown: SURVEY is judged, a touchdown counts from DESCEND on and in RETURN,
    and in DONE the flight is over once the vehicle is at rest. It must be deterministic and must
    not modify its input; what it decides takes no simulated time but what it hovers for."""

    needs: SensorNeeds

    def update(self, obs: Observation, estimate: Estimate, map_view: MapView) -> Setpoint:
        """Returns the setpoint of this control step; called once a step."""

    def view(self) -> LanderView:
        """Returns the current state for recorder and referee."""


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
