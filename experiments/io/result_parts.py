"""The parts of a result: what a flight measured, chose and missed."""

import math
from typing import Annotated, Any

from pydantic import AliasChoices, BaseModel, BeforeValidator, ConfigDict, Field

JUDGED_BY_CLASS, JUDGED_BY_GEOMETRY = "geometry and class", "geometry"


def _finite(value: Any) -> Any:
    """None for NaN and infinities, which JSON has no number for."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


Figure = Annotated[float | None, BeforeValidator(_finite)]
"""A measured number; None where the run has none."""

PointXY = Annotated[tuple[float, float] | None, Field(strict=False)]
"""World x and y in metres; None where the run has no such point."""

PointXYZ = Annotated[tuple[float, float, float] | None, Field(strict=False)]
"""x, y and z in metres; None where the run has no such point."""


class Part(BaseModel):
    """Part of a result. Keys of other versions and of other tools are kept as they are."""

    model_config = ConfigDict(extra="allow", frozen=True, strict=True)


def ground_safe(
    judged_on: str | None, *, safe: bool | None, safe_geometry: bool | None
) -> bool | None:
    """True if the ground at the touchdown is safe by what the flight is judged on: geometry, or
    geometry and class. None where the result has no such verdict."""
    return safe if judged_on == JUDGED_BY_CLASS else safe_geometry


class PositionError(Part):
    """Distance of the estimate from the truth between lift-off and the end of the survey, in
    metres; x, y, z and yaw are mean absolute errors."""

    mean: Figure = None
    rmse: Figure = None
    max: Figure = None
    x: Figure = None
    y: Figure = None
    z: Figure = None
    yaw_deg: Figure = None


class Nees(Part):
    """Normalised estimation error squared of the position over ``samples`` instants."""

    median: Figure = None
    mean: Figure = None
    below_14_2: Figure = None
    """fraction of samples"""
    samples: int = 0
    sigma_m: Figure = None
    """geometric mean of the standard deviation (3-D) that the estimate states of its position"""
    sigma_z_m: Figure = None
    """the same of its height"""


class Landing(Part):
    """The touchdown, measured on the truth."""

    commanded_xy_m: PointXY = None
    site_xy_m: PointXY = None
    """the site as committed at 4 m"""
    touchdown_xy_m: PointXY = None
    touchdown_time_s: Figure = None
    target_offset_m: Figure = None
    estimate_error_at_commit_m: Figure = None
    """distance of the estimate from the truth when the descent to the site is committed, 4 m up"""
    estimate_error_at_contact_m: Figure = None
    """the same at the first contact"""
    slope_deg: Figure = None
    roughness_m: Figure = None
    vertical_speed_mps: Figure = None
    horizontal_speed_mps: Figure = None
    vertical_accel_mps2: Figure = None
    impact_peak_mps2: Figure = None
    bounce_m: Figure = None
    tilt_deg: Figure = None
    obstacle_distance_m: Figure = None
    nearest_person_m: Figure = None
    """to a person, rider or animal at the first contact; none where there is nobody"""
    nearest_person_10s_m: Figure = None
    """the least of the ten seconds before it"""
    class_predicted: str | None = None
    class_probability: Figure = None
    class_true: str | None = None
    height_gap_m: Figure = None
    """of the legs' contact points over the truth map; None also where the map has no ground"""
    height_agrees: bool | None = None
    """False: the landing counts as not safe, as the truth map lacks what the vehicle stands on"""
    safe_geometry: bool | None = None
    safe_class: bool | None = None
    safe: bool | None = None
    judged_on: str | None = None
    landed_on: str | None = None
    """over a deck that moves: ``deck``, or the class of what is beside it; speeds, tilt and bounce
    are relative to the deck"""

    @property
    def ground_safe(self) -> bool | None:
        """See `ground_safe`."""
        return ground_safe(self.judged_on, safe=self.safe, safe_geometry=self.safe_geometry)


WATCH_RULE = "site_not_clear"
"""the rule that interrupts a descent, as events name it"""


class Intrusion(Part):
    """What became of the first intruder; times since the start of the flight."""

    in_view_s: Figure = None
    """when he was first in view of a descent below 15 m, less than 8 m aside; None: never"""
    in_view_height_m: Figure = None
    """of the legs above where he stood"""
    stopping_m: Figure = None
    """way in which the vehicle could have stopped sinking then"""
    avoidable: bool | None = None
    """whether it could have stopped above 2 m then, 0.3 s later; false for who was never in view"""
    answered_s: Figure = None
    """begin of the interruption that he was first seen in, else of the next; None: never"""
    reaction_s: Figure = None
    """from the first to the second; 0 where the descent was interrupted already"""


class LevelnessError(Part):
    """Angle between the normals of map and true ground, in degrees, over ``places`` discs."""

    mean: Figure = None
    max: Figure = None
    places: int | None = None


class MapFigures(Part):
    """The map at the end of the survey."""

    duration_s: Figure = None
    density_per_m2: Figure = None
    levelness_error_deg: LevelnessError | None = None


class StageTimes(Part):
    """Milliseconds of wall time per 0.1 s of simulated time; in the order of names."""

    controller: Figure = None
    estimator: Figure = None
    lander: Figure = None
    mapper: Figure = None
    recorder: Figure = None
    referee: Figure = None
    world: Figure = None


class Timing(Part):
    """Wall time of the loop, simulated time, and their ratio."""

    wall_s: Figure = None
    sim_s: Figure = None
    real_time_factor: Figure = None
    stage_ms: StageTimes | None = None


class Event(Part):
    """A message of estimator or lander."""

    time_s: float
    text: str


class PhaseStart(Part):
    """The beginning of a phase of the flight."""

    time_s: float
    phase: str


class PartNames(Part):
    """A text for each part of a flight beside the estimator."""

    selector: str | None = None
    lander: str | None = None
    controller: str | None = None
    mapper: str | None = None
    classifier: str | None = None
    watch: str | None = None


class Measured(Part):
    """Conditions of the flight, measured; None where nothing measures them."""

    wind_mps: Figure = None
    """mean horizontal wind at the vehicle, 3 m and more above the take-off spot"""
    wind_at_6m_mps: Figure = None
    """the same, brought to 6.1 m by the logarithmic profile"""
    gust_mps: Figure = None
    """largest speed of the air there"""
    vibration_mps2: Figure = None
    """root mean square of the change of specific force from one IMU sample to the next, over the
    square root of 2, in the air"""
    image_grey: Figure = None
    """mean grey level of the delivered images, 0 to 255"""
    light_lux: Figure = None
    """mean light (illuminance times reflectivity) of images without the lamp"""
    lamp_fraction: Figure = None
    """fraction of images under the lamp"""
    exposure_ms: Figure = None
    gain: Figure = None
    exposure_error_stops: Figure = None
    """mean factor, in powers of two, by which images are over- or underexposed"""
    scan_latency_ms: Figure = None
    scan_latency_sigma_ms: Figure = None
    stamp_error_ms: Figure = None
    """mean error of the images' time stamps"""
    readout_shear_px: Figure = None
    """mean shift between first and last row of an image by the vehicle's rotation"""
    mount_error_deg: Figure = None
    lens_error_px: Figure = None
    mass_fraction: Figure = None
    center_of_mass_m: Figure = None
    rotor_fraction: Figure = None
    imu_scale: Figure = None
    imu_misalignment_deg: Figure = None
    range_error_m: Figure = None
    """mean systematic error of a range"""
    plants_fraction: Figure = None
    """fraction of returns that come from plants instead of the ground"""
    sway_m: Figure = None
    """mean displacement of returns from crowns, over scans that have some"""
    wakes_mps: Figure = None
    air_rotation_degps: Figure = None
    dust_scans: Figure = None
    """scans that dust changed"""
    dust_images: Figure = None
    dust_returns_fraction: Figure = None
    """of the returns of scans in dust"""


class SiteTerm(Part):
    """A term of a site's value; see `landing.api.ScoreTerm`."""

    name: str
    value: Figure = None
    quantity: Figure = None
    unit: str = ""


class CandidateSite(Part):
    """A candidate site; see `landing.api.Candidate`."""

    rank: int
    position_m: PointXYZ = None
    """world frame, by the estimate of the decision's moment; None where its height is unknown"""
    accepted: bool
    rule: str
    reason: str
    value: Figure = None
    terms: list[SiteTerm] = []
    cluster_bonus: Figure = None
    c_sum: Figure = None
    slope_deg: Figure = None
    roughness_m: Figure = None
    step_m: Figure = None
    clearance_m: Figure = None
    safe_probability: Figure = None
    class_predicted: str | None = None
    class_probability: Figure = None


class EarlierDecision(Part):
    """A decision that led to no landing."""

    time_s: float
    candidates: int
    rules: dict[str, int] = {}
    """number of candidates that each rule refused"""
    why: str = ""
    given_up: str = ""
    """reason why its site was given up; empty where it had none"""


class RefusingRule(Part):
    """A rule that refused candidates of a flight."""

    rule: str
    candidates: int
    safe: int
    """of these, by the truth"""
    key: str | None = None
    """of the configuration, that decides what the rule refuses"""


class GivenUpSite(Part):
    """A site that a closer look refused."""

    time_s: float
    reason: str
    safe: bool
    """by the truth"""


class MissedGround(Part):
    """What a flight that found no site, or gave one up, refused."""

    safe_m2: Figure = None
    """area that the survey mapped and that is safe by the truth, class included"""
    rules: list[RefusingRule] = []
    """of all decisions, most candidates first"""
    given_up: list[GivenUpSite] = []

    def sentence(self) -> str:
        """Such as ``120 m2 of mapped ground were safe; refused: 9 uncertain ground (7 safe,
        landing.unknown_ground); given up: a safe site, at 10 m: ...``."""
        rules = [
            f"{one.candidates} {one.rule.replace('_', ' ')} ({one.safe} safe"
            + (f", {one.key})" if one.key else ")")
            for one in self.rules
        ]
        looks = [f"{'a safe' if one.safe else 'an unsafe'} site, {one.reason}"
                 for one in self.given_up]  # fmt: skip
        parts = [f"{self.safe_m2 or 0.0:.0f} m2 of mapped ground were safe"]
        parts += [f"refused: {', '.join(rules)}"] if rules else []
        parts += [f"given up: {'; '.join(looks)}"] if looks else []
        return "; ".join(parts)


class Choice(Part):
    """The last decision of a flight, and those before it."""

    time_s: float
    selector: str = Field(validation_alias=AliasChoices("selector", "scorer"))
    """``scorer`` in results of earlier versions"""
    why: str
    """why the first candidate won, or why there was none"""
    given_up: str = ""
    """reason why the site was given up from closer; empty where it was not"""
    candidates: list[CandidateSite] = []
    """in the order of rank"""
    earlier: list[EarlierDecision] = []
    missed: MissedGround | None = None
    """of a flight without a site, or that gave one up"""

    @property
    def go_arounds(self) -> int:
        """Number of sites that were given up from closer."""
        return bool(self.given_up) + sum(bool(decision.given_up) for decision in self.earlier)
