"""The schema of the configuration, whose defaults files and options override: see `loading`."""

from typing import Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field

from touchdown.controller.api import ControlParams
from touchdown.estimator.api import (
    CalibrationPriors,
    FlownImuParams,
    GpsEstimatorParams,
    HybridFlowParams,
    LivoParams,
    MapperParams,
    OpticalFlowParams,
    StereoParams,
    Zou2024Params,
)
from touchdown.experiments.api import (
    BiasParams,
    CalibrationErrorParams,
    Px4Params,
    RefereeParams,
    StartParams,
)
from touchdown.landing.api import LandingParams, SurveyParams
from touchdown.scenes.api import (
    DEFAULT_VEHICLE,
    DeckParams,
    Dials,
    Light,
    RuggedParams,
    TrafficParams,
    short_name,
)
from touchdown.sim.api import (
    BarometerParams,
    CameraParams,
    CountOrZero,
    DustParams,
    FaultParams,
    GpsParams,
    ImuParams,
    LampParams,
    LidarParams,
    MagnetometerParams,
    NavParams,
    Positive,
    RangefinderParams,
    SimParams,
    VehicleErrorParams,
    WindParams,
    parameters,
)
from touchdown.sim.noise import world_seed


@parameters
class LogParams:
    """Content and rates of the files of a run directory."""

    trajectory_hz: Positive = 50.0
    """rows a second in the .tum files"""
    camera_hz: Positive = 2.0
    """most images a second in the recording"""
    jpeg_quality: ClassVar[int] = 70
    """JPEG quality of recorded images"""
    scan_hz: Positive = 5.0
    """most LIDAR scans a second in the recording"""
    scan_points: ClassVar[int] = 2500
    """most points of a recorded scan"""
    map_period_s: ClassVar[float] = 2.5
    """between two updates of the recorded map"""
    texture_pixels: ClassVar[int] = 1600
    """longer side of the ground texture in the recording"""
    sensors: bool = False
    """write ``sensors.mcap``: every message delivered to the estimator, for replay"""


class Config(BaseModel):
    """Configuration of a flight; written as ``config.json`` beside its results."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    profile: Literal["ideal", "field", "harsh"] = "ideal"
    """how kind the world is: the set of keys that all other sources of a key override; ``ideal`` is
    the defaults of all keys, ``field`` is flown where nothing else is named"""
    harsh_effects: tuple[str, ...] = ()
    """effects at the level of ``harsh`` on top of the profile, such as ``vibration``"""
    preset: Literal["whole", "short", "park"] = "whole"
    """how much is flown: ``short`` is one leg of 12 m at 15 m and a quick descent, by keys that
    override the profile and that all other sources override; ``whole`` sets none"""
    variant: str = ""
    """a name for what else is set, such as an axis of a campaign whose overrides follow it; it
    changes nothing itself"""
    scene: str = "crossroad"
    """name of a scene, path of an MJCF file, or MODULE:FUNCTION that makes one"""
    vehicle: str = DEFAULT_VEHICLE
    """name of a shipped vehicle, or path of its MJCF file; its gains, limits, battery and kind of
    LIDAR override profile and preset (`touchdown vehicles check`)"""
    rig: str = ""
    """cameras and LIDARs other than the vehicle's: name of a shipped rig, or path of a TOML file
    with keys of ``camera``, ``lidar``, ``lamp`` and ``imu``, which override profile, preset and
    vehicle"""
    seed: CountOrZero = 0
    """seed of the scene; with the scene's name, of the wind and all noise"""
    scene_seed: CountOrZero | None = None
    """seed of the scene alone, for flights over one scene in different wind and noise; none:
    ``seed``"""
    scene_as_is: bool = False
    """take the scene of a file as it is: nothing is dressed, guessed or moved"""
    scene_classes: str | None = None
    """path of a file of classes for the scene of a file, a PNG or TOML; none: names and guesses"""
    light: Light = "day"
    """light of the scene: ``day``, ``overcast``, ``dusk`` or ``night``"""
    estimator: str = "livo"
    """name of an estimator, or MODULE:FUNCTION of an external one"""
    external: dict[str, Any] = Field(default_factory=dict)
    """parameters that external parts are built with: any keys, ``external.selector.*`` those of a
    selector and so on; keys of no kind are an estimator's"""
    calibration: str | None = None
    """path of a file of `touchdown calibrate`: the calibration given to estimators; none: the true
    calibration with the errors of ``calibration_error``"""
    record: bool = True
    """write the Rerun recording (trajectories, map and costmap are always written)"""
    rugged: RuggedParams = Field(default_factory=RuggedParams)
    deck: DeckParams = Field(default_factory=DeckParams)
    traffic: TrafficParams = Field(default_factory=TrafficParams)
    sim: SimParams = Field(default_factory=SimParams)
    wind: WindParams = Field(default_factory=WindParams)
    lidar: LidarParams = Field(default_factory=LidarParams)
    camera: CameraParams = Field(default_factory=CameraParams)
    lamp: LampParams = Field(default_factory=LampParams)
    imu: ImuParams = Field(default_factory=ImuParams)
    gps: GpsParams = Field(default_factory=GpsParams)
    barometer: BarometerParams = Field(default_factory=BarometerParams)
    magnetometer: MagnetometerParams = Field(default_factory=MagnetometerParams)
    rangefinder: RangefinderParams = Field(default_factory=RangefinderParams)
    vehicle_error: VehicleErrorParams = Field(default_factory=VehicleErrorParams)
    start: StartParams = Field(default_factory=StartParams)
    faults: FaultParams = Field(default_factory=FaultParams)
    dust: DustParams = Field(default_factory=DustParams)
    mapper: MapperParams = Field(default_factory=MapperParams)
    livo: LivoParams = Field(default_factory=LivoParams)
    flown_imu: FlownImuParams = Field(default_factory=FlownImuParams)
    calibration_prior: CalibrationPriors = Field(default_factory=CalibrationPriors)
    zou2024: Zou2024Params = Field(default_factory=Zou2024Params)
    gps_estimator: GpsEstimatorParams = Field(default_factory=GpsEstimatorParams)
    optical_flow: OpticalFlowParams = Field(default_factory=OpticalFlowParams)
    hybrid_flow: HybridFlowParams = Field(default_factory=HybridFlowParams)
    stereo_vo: StereoParams = Field(default_factory=StereoParams)
    control: ControlParams = Field(default_factory=ControlParams)
    px4: Px4Params = Field(default_factory=Px4Params)
    survey: SurveyParams = Field(default_factory=SurveyParams)
    landing: LandingParams = Field(default_factory=LandingParams)
    referee: RefereeParams = Field(default_factory=RefereeParams)
    bias: BiasParams = Field(default_factory=BiasParams)
    calibration_error: CalibrationErrorParams = Field(default_factory=CalibrationErrorParams)
    log: LogParams = Field(default_factory=LogParams)

    @property
    def dials(self) -> Dials | None:
        """Those of the scene; None for one without."""
        known: dict[str, Dials] = {"rugged": self.rugged, "deck": self.deck}
        return known.get(self.scene)

    @property
    def world_seed(self) -> int:
        """Seed of all random draws but those of the scene: flights over two scenes share none."""
        return world_seed(self.seed, short_name(self.scene))

    @property
    def unit(self) -> str:
        """Flights of one unit share random draws; they count as one independent flight."""
        fixed = self.scene_seed is not None
        number = f"layout {self.scene_seed}" if fixed else f"seed {self.seed}"
        return f"{short_name(self.scene)}, {number}"

    @property
    def nav(self) -> NavParams:
        """Parameters of GPS, barometer, magnetometer and rangefinder in one structure."""
        return NavParams(
            gps=self.gps,
            barometer=self.barometer,
            magnetometer=self.magnetometer,
            rangefinder=self.rangefinder,
        )
