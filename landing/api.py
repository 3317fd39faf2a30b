"""What the rest of the project may know of landing."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from touchdown.controller.api import Setpoint
from touchdown.estimator.api import Estimate, MapView
from touchdown.sim.api import FORBID_EXTRA, Observation, SensorNeeds

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
    traffic_zone: NDArray[np.bool_] = field(default_factory=lambda: np.zeros((0, 0), np.bool_))
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
class GroundPrediction:
    """What a classifier says of N pictures."""

    probabilities: Array
    """(N, 7) calibrated probabilities of ``scenes.api.LAND_CLASSES``, in their order"""
    in_distribution: NDArray[np.bool_]
    """(N,) False where a picture is far from all that the classifier was trained on"""


class GroundClassifier(Protocol):
    """Names the kind of ground in square pictures from the air."""

    @property
    def image_size(self) -> int:
        """Pixels across that ``look`` takes."""

    @property
    def min_probability(self) -> float:
        """Of safe ground, below which a picture counts as unsafe: what suits the classifier."""

    def classify(self, images: NDArray[np.uint8]) -> GroundPrediction:
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

    height_m: float = 30.0
    """above the take-off ground"""
    legs: int = 3
    leg_length_m: float = 50.0
    leg_spacing_m: float = 20.0
    duration_s: float = 36.0


@dataclass(frozen=True, kw_only=True, slots=True)
class LandingParams:
    __pydantic_config__ = FORBID_EXTRA

    weight_flatness: float = 0.5
    weight_smoothness: float = 0.3
    weight_distance: float = 0.2
    scorer: Literal["risk", "paper"] = "risk"
    """``risk``: by the probability of a safe touchdown; ``paper``: by C_sum (Eq. 13) among sites
    that pass the check of the ground"""
    min_safe_probability: float = 0.95
    """a site that is less likely to be safe is refused (``risk``)"""
    energy_weight: float = 0.05
    """what the farthest site within reach loses beside the nearest one (``risk``)"""
    level_weight: float = 0.2
    """what ground at ``max_slope_deg`` loses beside level ground (``risk``)"""
    gust_drift_s: float = 0.02
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
    emergency_s: float = 45.0
    """from the end of the survey to the ground in an emergency"""
    site_xy_m: tuple[float, float] | None = None
    """a commanded site (world frame) instead of a chosen one"""
    check_site: bool = True
    """whether a commanded site that the map says is unsuitable is refused; off, it is flown to on
    the word of whoever commands it, for methods whose maps are no better than their positions"""
    survey_only: bool = False
    """stop after the survey (the positioning experiment)"""
    second_look: bool = True
    decision_latency_s: float = 0.3
    max_slope_deg: float = 5.0
    max_step_m: float = 0.10
    clear_radius_m: float = 1.5
    flatness_form: str = "corrected"
    """``corrected`` or ``literal`` (Eqs. 16 and 17 to the letter)"""
    flatness_sigma_deg: float = 5.0
    """sigma of Eq. 16 in the corrected form"""
    normal_half_width_m: float = 0.5
    """half the window that normals are fitted in"""
    edge_blur_m: float = 0.3
    edge_low: float = 40.0
    edge_high: float = 100.0
    """hysteresis thresholds of Canny on the 8-bit colour map"""
    smoothness_full_m: float = 8.0
    """an edge farther away than this costs nothing more"""
    slope_margin_deg: float = 0.5
    step_margin_m: float = 0.02
    map_margin_m: float = 0.35
    """the footprint is widened by this: error of map and position from survey height"""
    low_margin_m: float = 0.15
    """the same for a look from 10 m and below"""
    min_returns: float = 4.0
    """a cell with fewer is not trusted"""
    max_missing_ratio: float = 0.2
    """share of pulses without return above which the ground counts as water"""
    traffic_penalty: float = 0.3
    """taken off C_sum when sites are ranked, near a surface on which something was seen to move"""
    max_candidates: int = 12
    search_legs: int = 1
    """further survey legs when no site was found"""
    go_arounds: int = 2
    unhealthy_hold_s: float = 1.0
    """an estimate that says it is unhealthy for this long stops the vehicle where it is"""
    unhealthy_abort_s: float = 8.0
    """and for this long ends the flight: straight down"""
    climb_speed_mps: float = 3.0
    cruise_speed_mps: float = 7.0
    descent_speed_mps: float = 2.5
    obstacle_margin_m: float = 6.0
    """height above anything mapped while flying over it"""
    look_height_m: float = 10.0
    commit_height_m: float = 4.0
    sweep_m: float = 1.0
    final_speed_mps: float = 0.6
    touchdown_speed_mps: float = 0.09
    classifier: str = "auto"
    """``auto``: by the network that comes with the project, if one does; ``off``: sites are judged
    by geometry alone; else the path of a network's file"""
    classifier_min_probability: float = 0.0
    """of a safe class, below which a site is refused; 0: what the network's file says"""
    classifier_batch: int = 3
    """sites that are classified together, before the first safe one ends it"""
    classifier_rounds: int = 4
    """how often other sites are looked for where none was of a safe class"""
    classifier_patch_m: float = 6.4
    """side of the square of ground around a site that is classified"""
    classifier_images: int = 64
    """pictures of the survey that are kept for it"""
    classifier_batch_latency_s: float = 0.1
    """what a decision takes longer for every batch"""
    classifier_threads: int = 1
    """of the processor, that classify"""
    allow_risky: bool = False
    """land on roads and roofs too; such a flight is judged on geometry"""


@dataclass(frozen=True, kw_only=True, slots=True)
class LabelledImages:
    """Pictures of ground from the air, and what each shows."""

    images: NDArray[np.uint8]
    """(N, S, S, 3) RGB"""
    labels: NDArray[np.int64]
    """(N,) index into ``classes``"""
    classes: tuple[str, ...]
    source: NDArray[np.int64]
    """(N,) index into ``sources``, the data sets that they come from"""
    sources: tuple[str, ...]
