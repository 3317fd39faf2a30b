"""Parameters of landing; part of `landing.api`."""

from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal

from annotated_types import Interval

from touchdown.sim.api import Count, CountOrZero, Fraction, NotNegative, Positive, parameters


@parameters
class SurveyParams:
    """The circuitous scan of the paper's Fig. 9a: legs joined by minimum-jerk turns."""

    height_m: Positive = 30.0
    """height above the take-off ground"""
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
    path: str = "serpentine"
    """``serpentine``; ``spiral``, outward from the take-off spot in ``legs`` turns that are
    ``leg_spacing_m`` apart; or a file: GeoJSON, whose polygon is covered by parallel legs and whose
    line is followed, or a plan of QGroundControl"""
    waypoints_m: tuple[tuple[float, float, float], ...] = ()
    """path in place of ``path``: metres east and north of the take-off spot, and height above it;
    read from the file"""
    trajectory: str = ""
    """TUM file of a trajectory that somebody flew, world z up: the vehicle is carried along it from
    the take-off spot, and nothing else of the survey is flown"""
    trajectory_lowest_m: Annotated[float, Interval(ge=0.3, le=500.0)] | None = None
    """height of the legs at its lowest pose over the take-off ground; None: on the ground where it
    starts about as low, else 2 m"""
    home_wgs84: tuple[float, float, float] | None = None
    """latitude and longitude (degrees) and height (m) of the take-off spot on WGS 84, for files;
    None: as the file says"""

    @property
    def is_serpentine(self) -> bool:
        """True where legs are flown, and not waypoints."""
        return self.path == "serpentine" and not self.waypoints_m


TermName = Literal[
    "probability",
    "flatness",
    "smoothness",
    "distance",
    "clearance",
    "slope",
    "traffic",
    "plants",
    "ground",
]
"""Terms of the score of a site, by `landing.selection.terms`."""

LandClass = Literal["lawn", "field", "path", "road", "building"]
"""Classes of solid ground, of `scenes.api.LAND_CLASSES`."""

GateName = Literal["geometry", "probability", "reach", "class"]
"""What a site must pass: the limits of ``landing.ground``, ``landing.min_safe_probability``, the
range of the remaining energy (Eq. 18), ground classification."""


@parameters
class SelectorParams:
    """A selector: the terms that add up to the score of a site, and the gates that it must pass.
    What a list does not name is off. The defaults are those of ``landing.risk``."""

    terms: tuple[TermName, ...] = (
        "probability", "distance", "clearance", "slope", "traffic", "plants", "ground",
    )  # fmt: skip
    """terms that are added"""
    gates: tuple[GateName, ...] = ("probability", "reach", "class")
    """gates that are checked"""
    clusters: Literal["probability", "score"] = "probability"
    """what Quick Shift clusters (Eq. 19): ``score``, where the candidate of a cluster is its mode,
    of the cells that pass the gates the densest; or the probability, where it is the cell of
    highest score, room included"""
    distance_zero: Literal["nearest", "farthest"] = "nearest"
    """site for which the term distance is 0: the farthest one within reach, to which the nearest is
    preferred by the weight (Eq. 13), or the nearest, from which it takes away"""
    weight_probability: NotNegative = 1.0
    """weight of the probability of a safe touchdown"""
    weight_flatness: NotNegative = 0.5
    """weight of flatness, 0 to 1 (Eqs. 15 to 17); the largest of the paper (section 4.1)"""
    weight_smoothness: NotNegative = 0.3
    """weight of smoothness, 0 to 1 (Eq. 14; section 4.1)"""
    weight_distance: NotNegative = 0.05
    """weight of distance, 0 to 1 (Eq. 18): less than any difference in safety"""
    weight_clearance: NotNegative = 0.1
    """weight of a clearance of ``clearance_full_m`` over none; among the cells of one cluster, of
    ``clearance_enough_m``"""
    weight_slope: NotNegative = 0.2
    """taken away on ground at ``max_slope_deg``, nothing on level ground"""
    weight_traffic: NotNegative = 0.3
    """taken away near a surface on which motion was observed or whose class was refused"""
    weight_plants: NotNegative = 0.15
    """taken away among low plants, whose ground is inferred from few returns: more than the
    difference between two good sites on bare ground, less than ``weight_traffic``"""
    weight_ground: NotNegative = 0.3
    """taken away on ground that is of no allowed class by the semantic map; without the term
    ``ground`` there is no semantic map"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Zou2024SelectorParams(SelectorParams):
    """The selector of Zou, Sun and Kong (2024): Eqs. 13 to 19 and place recognition, nothing else
    but the gate ``geometry``, which the paper has not."""

    terms: tuple[TermName, ...] = ("smoothness", "flatness", "distance")
    gates: tuple[GateName, ...] = ("geometry", "reach", "class")
    clusters: Literal["probability", "score"] = "score"
    distance_zero: Literal["nearest", "farthest"] = "farthest"
    weight_distance: NotNegative = 0.2
    """weight of distance, 0 to 1 (Eq. 18; section 4.1)"""


@parameters
class GroundParams:
    """Limits of the geometric check and of what is taken for low plants."""

    footprint_m: Positive = 1.0
    """radius around the touchdown point that must be free of defects: that of the vehicle, 0.53 m,
    and the drift of the last metres"""
    tall_m: Positive = 0.25
    """greatest height within ``clear_radius_m``: below the rotors of a vehicle on its legs"""
    step_half_width_m: ClassVar[float] = 0.2
    """half the window that a step is looked for in: a cell to each side"""
    peak_allowance_m: ClassVar[float] = 0.05
    """added to ``max_step_m`` for the highest of many returns: 2.5 deviations of the LIDAR's
    noise"""
    rough_std_m: ClassVar[float] = 0.05
    """largest standard deviation of the returns of a cell: above the LIDAR's noise of 2 cm and the
    slope within a cell"""
    moving_std_m: Positive = 0.15
    """standard deviation of the returns of a cell from which motion is looked for: a vehicle's
    roof over the road"""
    moving_fraction: ClassVar[float] = 0.4
    """largest height of the mean above the lowest return, as a fraction of the spread, of a cell
    that something drove over: most returns come from the ground, other than in a tree's crown"""
    moving_width_m: ClassVar[float] = 1.0
    """least width of a region with motion; the edges of static objects are narrower"""
    moving_margin_m: ClassVar[float] = 3.0
    """distance kept from where motion was observed: the width of a lane"""
    water_window_m: ClassVar[float] = 1.0
    """side of the window that missing pulses are counted in"""
    water_min_missing: ClassVar[float] = 3.0
    """fewer missing pulses in the window are chance"""
    plants_spread_m: ClassVar[float] = 0.14
    """distance between the lowest and the highest return of a cell, from which it holds more than
    noise"""
    plants_clump: ClassVar[tuple[float, float, float]] = (0.3, 0.33, 0.12)
    """a clump of plants, m: side of the least square that they fill; greatest spread of a cell, its
    height of 0.23 and noise of 0.1; greatest height of the mean over the lowest return, noise of
    0.05 included: most pulses reach the ground"""
    plants_stand: ClassVar[tuple[float, float, float]] = (1.0, 0.42, 0.19)
    """a wide stand of plants, 0.32 m high: the three lengths of ``plants_clump``"""
    plants_level_m: ClassVar[float] = 0.06
    """distance between the lowest returns of a gap in a clump and of the cells around it: bare
    ground, no solid top"""
    plants_edge_cells: ClassVar[int] = 2
    """width of the ragged edge of a clump"""
    plants_ground_std_m: ClassVar[float] = 0.03
    """largest deviation of the ground's height under plants, a third of ``max_step_m``"""


@parameters
class SemanticMapParams:
    """The semantic map of the ground, and how much each view of it counts."""

    squares: CountOrZero = 2
    """number of squares of ground that are classified every tenth of a second of the flight; 0: no
    semantic map"""
    max_views: ClassVar[float] = 1.5
    """independent views that all views of a place count as at most: views of one network over one
    ground share its errors"""
    full_pixel_m: ClassVar[float] = 0.12
    """width of a pixel on the ground up to which a view is fully reliable: that of the camera from
    60 m, up to which the weight of least loss is 0.88 to 1.05 (``touchdown evaluate``)"""
    half_slant: ClassVar[float] = 0.5
    """tangent of the viewing angle at which a view is half as reliable as from above"""
    dim: ClassVar[float] = 0.5
    """reliability of a view in dim light"""
    unfamiliar: ClassVar[float] = 0.2
    """reliability of a view that looks like no known ground"""
    apart: ClassVar[float] = 0.15
    """distance between two cameras, relative to their height, from which their views differ"""
    close: ClassVar[float] = 2.0
    """weight of a sharp view from the height of the recheck"""


@parameters
class LandingParams:
    lander: str = "site"
    """what flies the mission: ``site``, or MODULE:FUNCTION of an external lander"""
    watch: str = "standard"
    """what watches the landing place during the descent: ``standard``, ``off``, or MODULE:FUNCTION
    of an external watch"""
    people_network: str = ""
    """network with which the standard watch finds people in images: ``shipped``, or the path of one
    of `touchdown people train`; '': it looks at scans alone"""
    selector: str = "risk"
    """what chooses the site: ``risk`` (``landing.risk``), ``zou2024`` (``landing.zou2024``), or
    MODULE:FUNCTION of an external selector"""
    risk: SelectorParams = field(default_factory=SelectorParams)
    zou2024: Zou2024SelectorParams = field(default_factory=Zou2024SelectorParams)
    ground: GroundParams = field(default_factory=GroundParams)
    semantics: SemanticMapParams = field(default_factory=SemanticMapParams)
    min_safe_probability: Fraction = 0.99
    """a site with a lower probability of a safe touchdown does not pass the gate probability"""
    gust_drift_s: NotNegative = 0.02
    """metres by which each m/s of wind reduces the clearance in the probability"""
    clearance_full_m: Positive = 3.0
    """distance to ground that is not allowed from which the value no longer rises: twice
    ``clear_radius_m``"""
    clearance_enough_m: ClassVar[float] = 1.0
    """distance to ground that is not allowed from which cells of one cluster are equal: the radius
    of a footprint"""
    refused_radius_m: NotNegative = 3.0
    """radius around a refused site in which no site is accepted again: twice ``clear_radius_m``, so
    that the two do not overlap"""
    candidate_spacing_m: NotNegative = 3.0
    """least distance between the candidates of a selection: twice ``clear_radius_m``"""
    risk_weights: tuple[
        float, float, float, float, float, float, float, float, float, float, float, float, float,
        float,
    ] = (
        10.75, -0.2, -0.2, -0.2, -0.2, -0.2, -2.0, -0.2, -0.2, -1.13, -1.42, -2.95, -0.2, -3.0,
    )  # fmt: skip
    """log-odds of a safe touchdown: constant; slope, step, object, spread, neighbour, confinement,
    sparsity, age, slope around, tilt, steepness and plants (``landing.selection.probability``); the
    excess of the worst of step, object and neighbour over 1.2. Fitted by ``touchdown bench selector
    --fit``"""
    emergency: Literal["", "battery"] = ""
    """``battery``: land within ``emergency_s`` on the least bad site; empty: no emergency"""
    emergency_s: Positive = 45.0
    """time from the end of the survey to the ground in an emergency"""
    site_xy_m: tuple[float, float] | None = None
    """a commanded site (world frame) instead of a chosen one"""
    check_site: bool = True
    """refuse a commanded site that is unsuitable by the map; off, it is accepted unchecked, for
    methods whose maps are no better than their positions"""
    moving_site: bool = False
    """land on a deck that moves, which scans and images show; set for the scene ``deck``"""
    deck_tag_m: NotNegative = 0.0
    """side of an AprilTag (36h11, number 0) in the middle of the deck, by which it is followed; 0:
    none; that of ``deck.tag_m`` in the scene ``deck``"""
    survey_only: bool = False
    """stop after the survey (the positioning experiment)"""
    return_home: bool = False
    """fly after the survey back to the take-off spot, and down there, without choosing a site"""
    site_recheck: bool = True
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
    flatness_sigma_deg: ClassVar[float] = 5.0
    """sigma of Eq. 16 in the corrected form"""
    normal_half_width_m: ClassVar[float] = 0.5
    """half the window that normals are fitted in"""
    edge_blur_m: ClassVar[float] = 0.3
    """sigma of the blur before Canny"""
    edge_low: ClassVar[float] = 40.0
    """lower hysteresis threshold of Canny on the 8-bit colour map"""
    edge_high: ClassVar[float] = 100.0
    """hysteresis thresholds of Canny on the 8-bit colour map"""
    edge_hole_cells: ClassVar[int] = 4
    """largest hole in the colour map that counts as chance and not as an edge"""
    smoothness_full_m: ClassVar[float] = 8.0
    """distance to an edge from which the smoothness term is 1"""
    slope_margin_deg: NotNegative = 0.5
    """taken off ``max_slope_deg`` for the error of the map"""
    step_margin_m: ClassVar[float] = 0.02
    """taken off ``max_step_m`` for the error of the map"""
    map_margin_m: ClassVar[float] = 0.35
    """margin around the footprint for the error of map and position at survey height"""
    low_margin_m: ClassVar[float] = 0.15
    """margin around the footprint for the error of map and position at 10 m and below"""
    min_returns: NotNegative = 4.0
    """a cell with fewer is refused"""
    max_missing_ratio: Annotated[float, Interval(gt=0.0, le=1.0)] = 0.2
    """fraction of pulses without a return above which the ground counts as water"""
    traffic_smoothing_m: ClassVar[float] = 1.0
    """side of the window that intensity is averaged in"""
    traffic_same_intensity: ClassVar[float] = 0.35
    """relative difference of the mean intensity up to which cells count as one surface: intensity
    falls with the cosine of the incidence angle, to 0.75 at the edge of the field of view"""
    traffic_near_m: ClassVar[float] = 2.0
    """distance to a surface with traffic up to which a site counts as near it"""
    cluster_bandwidth: ClassVar[float] = 1.5
    """bandwidth of the density in Eq. 19, in radii of the vehicle's footprint: about the area of a
    landing"""
    cluster_search: ClassVar[float] = 4.0
    """Quick Shift looks for a higher density within this many bandwidths"""
    max_candidates: Count = 12
    """candidates examined in one selection"""
    search_legs: CountOrZero = 1
    """additional survey legs where no site was found"""
    go_arounds: CountOrZero = 2
    """landings that may be broken off for another site"""
    unhealthy_hold_s: NotNegative = 1.0
    """duration of an unhealthy estimate after which the vehicle holds its position"""
    unhealthy_abort_s: NotNegative = 8.0
    """duration of an unhealthy estimate after which the vehicle comes down"""
    blind_abort_s: NotNegative = 2.0
    """time without a measurement of the position after which the vehicle comes down; in climb and
    survey three times as long"""
    slow_in_wind: bool = False
    """slow the reference down where its motion through the felt wind would need more than the next
    three keys allow, and fly the survey lower where the wind leaves a hover no margin; where it
    does not, the reference keeps its time, to the bit"""
    wind_thrust_fraction: Annotated[float, Interval(gt=0.0, le=1.0)] = 0.94
    """largest mean rotor speed, over the fastest one, that the reference may need"""
    wind_tilt_deg: Annotated[float, Interval(gt=0.0, lt=60.0)] = 31.0
    """largest tilt that the reference may need, below control.max_tilt_deg"""
    wind_gust_fraction: NotNegative = 0.1
    """gusts that the reference leaves room for, over the felt wind"""
    climb_speed_mps: Positive = 3.0
    """vertical speed of the climb"""
    cruise_speed_mps: Positive = 7.0
    """horizontal speed between survey and site"""
    accel_mps2: Positive = 1.5
    """acceleration of straight ways: to the site, its correction and the sweep"""
    descent_speed_mps: Positive = 2.5
    """vertical speed of the descent"""
    obstacle_margin_m: ClassVar[float] = 6.0
    """vertical clearance above the map on the way to the site"""
    look_height_m: Positive = 10.0
    """height above the site of the first recheck"""
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
    drift_growth_m: Positive = 0.03
    """growth of the horizontal standard deviation in the final descent (the root of the variance
    gained) from which on nothing seems to measure the position"""
    drift_speed_mps: Positive = 0.3
    """least vertical speed from then on: less time to drift in"""
    classifier: str = "auto"
    """``auto``: the network that is shipped with the project, if there is one, for the selector
    ``zou2024`` that of the paper; ``off``: sites are checked by geometry alone; else the path of a
    network's file, or MODULE:FUNCTION of an external classifier"""
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
    """threads of the processor for classification"""
    allowed_classes: tuple[LandClass, ...] = ("lawn", "field", "path")
    """classes of ground that the gate ``class`` lets pass"""
    unknown_ground: Literal["refuse", "geometry"] = "refuse"
    """ground that classification knows neither as safe nor as unsafe: ``refuse`` it, or land on it
    by its ``geometry``, where another class has less than ``unknown_unsafe_probability``"""
    unknown_unsafe_probability: Fraction = 0.3
    """probability of all classes but the allowed ones together above which ground is unsafe rather
    than unknown"""
    allow_risky: bool = False
    """accept roads and roofs too; such a landing is judged by geometry"""

    @property
    def chosen_selector(self) -> SelectorParams:
        """That of ``selector``; for an external one ``risk``, whose gate ``class`` its sites pass
        too."""
        return self.zou2024 if self.selector == "zou2024" else self.risk
