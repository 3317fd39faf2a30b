"""Parameters of vehicle, camera, lamp, IMU and LIDAR, with the ranges that they may take; part of
`sim.api`: import them from there.

The ranges are metadata of annotated-types. The dataclasses do not check them; pydantic does when
`experiments.config.loading` reads a configuration.
"""

from dataclasses import dataclass
from typing import Annotated, Literal, TypeVar, dataclass_transform

from annotated_types import Ge, Gt, Interval

Positive = Annotated[float, Gt(0)]
NotNegative = Annotated[float, Ge(0)]
Fraction = Annotated[float, Interval(ge=0, le=1)]
Count = Annotated[int, Gt(0)]
LensModel = Literal["pinhole", "fisheye"]
CountOrZero = Annotated[int, Ge(0)]
Heading = Annotated[float, Interval(ge=-360, le=360)]
"""degrees"""


_Kind = TypeVar("_Kind")


@dataclass_transform(frozen_default=True, kw_only_default=True)
def parameters(kind: type[_Kind]) -> type[_Kind]:
    """A frozen dataclass whose fields are configuration keys; pydantic refuses unknown ones."""
    kind.__pydantic_config__ = {"extra": "forbid"}  # type: ignore[attr-defined]
    return dataclass(frozen=True, kw_only=True, slots=True)(kind)


@parameters
class VehicleErrorParams:
    """Bounds of the true vehicle's deviations from the model that controller and estimators know;
    each is drawn once a flight, uniformly between minus and plus the bound. Errors of the
    telemetry."""

    mass_fraction: Fraction = 0.0
    """of the mass, and of the moments of inertia with it; relative"""
    center_of_mass_m: NotNegative = 0.0
    """of each coordinate of the centre of mass"""
    thrust_fraction: Fraction = 0.0
    """of the thrust coefficient of all rotors; relative"""
    torque_fraction: Fraction = 0.0
    """of the torque coefficient of all rotors; relative"""
    drag_fraction: Fraction = 0.0
    """of the drag of the rotors in their plane; relative"""
    rotor_fraction: Fraction = 0.0
    """of thrust and torque of each rotor by itself; relative"""
    telemetry_sigma_radps: NotNegative = 0.0
    """noise of the rotor speeds that the speed controllers report, standard deviation"""
    telemetry_step_radps: NotNegative = 0.0
    """step of the reported rotor speeds; 0: continuous"""


@parameters
class CameraParams:
    """RealSense D435 colour camera."""

    mount_deg: "Turn" = (0.0, 0.0, 0.0)
    """roll, pitch and yaw by which the cameras are turned from their mount on the vehicle; pitch
    -20 turns their view ahead"""
    width: Count = 848
    """pixels"""
    height: Count = 480
    """pixels"""
    fov_x_deg: Annotated[float, Interval(gt=0.0, lt=180.0)] = 69.0
    """horizontal field of view"""
    fov_y_deg: Annotated[float, Interval(gt=0.0, lt=180.0)] = 42.0
    """vertical field of view"""
    noise_sigma: NotNegative = 1.5
    """Standard deviation of the grey-level noise (of 255), where ``exposure`` makes none."""
    samples: CountOrZero = 0
    """Multisampling samples a pixel; 4 smooths silhouettes and nearly doubles the drawing time."""
    lens: LensModel = "pinhole"
    """``pinhole``, or ``fisheye``: angles from the axis are mapped to radii in proportion
    (equidistant)"""
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2, k3 of OpenCV's lens model; of a fisheye k1, k2, k3, k4 and 0"""
    gain: Positive = 1.0
    """exposure relative to the scene's own, linear in light; what it clips is lost. With
    ``exposure``: relative to what its control chooses"""
    auto_exposure: bool = False
    """choose the gain for every image, within 1/4 to 4, so that its mean is a middle grey; without
    effect under ``exposure``"""
    detail: bool = False
    """detail texture of the ground below 10 m, from photographs of grass, soil, asphalt, sand,
    snow ...: a scene's own texture has a texel of 2.5 cm"""
    readout_s: NotNegative = 0.0
    """rolling shutter: time from the exposure of the first row to that of the last; 0: all rows at
    once"""
    phase_s: NotNegative = 0.0
    """the camera's own clock: its pulses come later than the LIDAR's by a time up to this, drawn
    from the seed, in whole ticks; less than one period of the clock. 0: a shared trigger"""
    stamp_delay_s: Annotated[float, Interval(ge=-1.0, le=1.0)] = 0.0
    """stamps of images are late by this"""
    stamp_jitter_s: NotNegative = 0.0
    """standard deviation of the stamps"""
    exposure: bool = False
    """exposure time and gain that follow the light, with motion blur, photon and read noise; False:
    every image is exposed alike in an instant, unless it is dusk or night"""
    exposure_lag_s: NotNegative = 0.0
    """time constant of the exposure control"""
    exposure_min_s: Positive = 1e-4
    """shortest exposure"""
    exposure_max_s: Positive = 0.033
    """longest exposure; beyond it the gain rises"""
    gain_max: Annotated[float, Ge(1.0)] = 16.0
    """largest gain"""
    full_well_e: Positive = 25e3
    """electrons at which a pixel of the image saturates at gain 1"""
    read_noise_e: NotNegative = 6.0
    """read noise of a pixel of the image, electrons"""
    electrons_per_lux_s: Positive = 1100.0
    """electrons a second in each pixel that shows a white surface under one lux"""


@parameters
class LampParams:
    """A landing lamp beside the camera, along its axis."""

    below_m: NotNegative = 0.0
    """the lamp is on while the ground below is nearer than this; 0: no lamp"""
    flux_lm: Positive = 3000.0
    """luminous flux"""
    beam_deg: Annotated[float, Interval(gt=1.0, lt=170.0)] = 60.0
    """full angle between the directions of half the intensity"""


@parameters
class ImuSheet:
    """What data sheet and calibration say of an IMU: noise densities, in-run bias walk, spread of
    the turn-on errors, ranges. Defaults: Bosch BMI088 (data sheet)."""

    gyro_density: NotNegative = 2.44e-4
    """rad/s/sqrt(Hz)"""
    accel_density: NotNegative = 1.72e-3
    """m/s^2/sqrt(Hz)"""
    gyro_bias_walk: NotNegative = 1.0e-5
    """rad/s^2/sqrt(Hz)"""
    accel_bias_walk: NotNegative = 1.0e-4
    """m/s^3/sqrt(Hz)"""
    gyro_bias_sigma: NotNegative = 3.0e-3
    """rad/s, turn-on"""
    accel_bias_sigma: NotNegative = 3.0e-2
    """m/s^2, turn-on"""
    scale_sigma: NotNegative = 0.0
    """relative error of scale of each axis of gyroscope and accelerometer, standard deviation"""
    misalignment_sigma_deg: NotNegative = 0.0
    """standard deviation of the angle of every sensing axis towards each of the two others"""
    gyro_g_sensitivity: NotNegative = 0.0
    """rad/s per m/s^2: response of each gyroscope axis to each axis of specific force, standard
    deviation"""
    gyro_range: NotNegative = 0.0
    """rad/s at which a gyroscope sample saturates; 0: never"""
    accel_range: NotNegative = 0.0
    """m/s^2 at which an accelerometer sample saturates; 0: never"""


@dataclass(frozen=True, kw_only=True, slots=True)
class ImuParams(ImuSheet):
    """Bosch BMI088 (data sheet), its place on the body and the propellers' vibration there. Turn-on
    errors are drawn once a flight."""

    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """distance from the MJCF's site ``imu`` to the sensor, body axes (forward, left, up);
    estimators know it"""
    vibration_gyro_density: NotNegative = 0.0
    """rad/s/sqrt(Hz) that the propellers shake into the sensor in hover, broad band; grows with the
    square of the rotor speed. 0: a perfectly isolated mount; 4e-3 is the median of unisolated
    sensors on a DJI Phantom 4 (flights of Hurwitz and Klein 2023), a damped mount a tenth of it"""
    vibration_accel_density: NotNegative = 0.0
    """m/s^2/sqrt(Hz), likewise; 0.12 on the same flights (three times that along the rotor axes)"""
    vibration_harmonics: NotNegative = 0.0
    """lines at one and two times each rotor's speed; 1: as strong as on the airframe of a DJI
    Phantom 4 (same flights), 0: none"""
    vibration_broadband: NotNegative = 0.0
    """resonances of the airframe that the propellers excite, likewise"""
    vibration_isolation: Fraction = 1.0
    """fraction of harmonics and resonances that a damped mount passes above its corner of 40 Hz"""
    warm_up_k: NotNegative = 0.0
    """temperature that the sensor gains after it is switched on, with a time constant of a minute;
    its biases drift by the data sheet's temperature coefficients"""


LidarPreset = Literal["horizon", "avia", "mid360", "os1_16", "xt16"]
Turn = tuple[float, float, float]
"""roll, pitch and yaw in degrees, about the body's forward, left and up axes in this order"""


@parameters
class LidarSheet:
    """What a data sheet says of a scanning LIDAR. Defaults: Livox Horizon (manufacturer's data
    sheet)."""

    preset: LidarPreset = "horizon"
    """pattern, point rate, range limits and beam"""
    range_sigma_m: NotNegative = 0.02
    """standard deviation of the range noise"""
    angle_sigma_deg: NotNegative = 0.05
    """standard deviation of the beam direction, each axis"""
    min_range_m: NotNegative = 0.5
    """nearest range that is reported"""
    max_range_m: Positive = 260.0
    """farthest range that is reported; reflectivity limits it further"""


@dataclass(frozen=True, kw_only=True, slots=True)
class LidarParams(LidarSheet):
    """A scanning LIDAR, and what it meets in the world. Defaults: Livox Horizon (manufacturer's
    data sheet)."""

    mount_deg: Turn = (0.0, 0.0, 0.0)
    """roll, pitch and yaw by which the sensor is turned from its mount on the vehicle; pitch -30
    turns the view of one that looks down ahead, pitch -90 lays one that looks all round on its side
    """
    second_mount_deg: Turn | None = None
    """a second LIDAR of the same kind, turned so from the mount ``lidar_1``, or ``lidar_0`` where
    the vehicle has no other; its scans are merged into those of the first. None: only that of a
    vehicle with a mount ``lidar_1``"""
    pair_rotation_sigma_deg: NotNegative = 0.0
    """error of what is known of the second LIDAR against the first: rotation about each axis,
    standard deviation"""
    pair_translation_sigma_m: NotNegative = 0.0
    """likewise, along each axis"""
    divergence: bool = True
    """True: beams have a width and split into several echoes at edges. False: rays without width.
    """
    return_mode: Literal["first", "strongest"] = "first"
    """Which echo of a split beam is reported."""
    pulse_length_m: NotNegative = 1.0
    """Surfaces nearer to one another than this merge into one echo at their mean range."""
    range_bias_m: NotNegative = 0.0
    """bound of the systematic range error: a constant by seed, time walk of weak echoes, and
    incidence. 0: none"""
    range_noise_growth: Fraction = 0.0
    """fraction of the range noise's variance, at 20 m on 80 %, that grows as an echo gets weaker
    (with the range squared, over reflectivity times cosine). 0: ``range_sigma_m`` everywhere"""
    prism_error_deg: Annotated[float, Interval(ge=0.0, le=1.0)] = 0.0
    """systematic pointing error of every beam, which turns with the first prism; estimators do not
    know it. Of patterns with prisms alone"""
    texture: NotNegative = 0.0
    """how much the reflectivity varies within a surface, over the measured spreads of materials: 1
    as measured, 0 not at all"""
    vegetation: NotNegative = 0.0
    """height of grass and crops that pulses partly enter, over the usual one of each material: 1
    as usual, 0 none"""
    sway: NotNegative = 0.0
    """how far crowns sway in the wind, over the displacement of a typical tree: 1 as typical, 0 not
    at all"""
