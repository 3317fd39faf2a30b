"""Parameters and messages of the small sensors; part of `sim.api`: import them from there."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from annotated_types import Interval
from numpy.typing import NDArray

from touchdown.sim.params import Count, CountOrZero, NotNegative, Positive, parameters

Array = NDArray[np.float64]


GpsPreset = Literal["zou2024", "ublox-m8", "rtk", "denied"]


@parameters
class GpsSheet:
    """Mount and rate of a satellite receiver; each fix states its own standard deviations."""

    period_ticks: Count = 120
    """ticks between two fixes (5 Hz)"""
    latency_ticks: CountOrZero = 72
    """ticks from measurement to arrival (120 ms)"""
    antenna_body_m: tuple[float, float, float] = (0.0, 0.0, 0.14)
    """position of the antenna, body frame: on top of the battery"""


@dataclass(frozen=True, kw_only=True, slots=True)
class GpsParams(GpsSheet):
    """A satellite receiver; ``denied``: no fix ever. Fields that are None come from the preset."""

    preset: GpsPreset = "zou2024"
    """receiver model"""
    sigma_xy_m: NotNegative | None = None
    """stationary standard deviation of the wandering error, each horizontal axis"""
    sigma_z_m: NotNegative | None = None
    """the same of the vertical axis"""
    tau_s: Positive | None = None
    """correlation time of that error"""
    white_m: NotNegative | None = None
    """white noise of a fix, each axis"""
    velocity_sigma_mps: NotNegative | None = None
    """standard deviation of the velocity, each axis"""


@parameters
class BarometerSheet:
    """What a data sheet says of a barometer, and the elevation of the site on a map. Defaults:
    Bosch BMP388 (data sheet): noise 1.2 Pa, absolute accuracy 50 Pa. 12 Pa are about 1 m."""

    period_ticks: Count = 24
    """ticks between two readings (25 Hz)"""
    latency_ticks: CountOrZero = 12
    """ticks from measurement to arrival"""
    white_sigma_pa: NotNegative = 1.2
    """standard deviation of the white noise"""
    offset_sigma_pa: NotNegative = 25.0
    """turn-on"""
    site_elevation_m: Annotated[float, Interval(ge=-500.0, le=9000.0)] = 50.0
    """of world z = 0 above mean sea level"""


@dataclass(frozen=True, kw_only=True, slots=True)
class BarometerParams(BarometerSheet):
    """Bosch BMP388 (data sheet), with a drift: a Gauss-Markov process (weather, temperature)."""

    drift_sigma_pa: NotNegative = 4.0
    """stationary standard deviation of the drift"""
    drift_tau_s: Positive = 300.0
    """correlation time of the drift"""


@parameters
class MagnetometerParams:
    """Three-axis magnetometer in the field of a location. Defaults: about the field of the
    international reference model at 40 degrees north, 116 degrees east, and the noise of a
    Honeywell HMC5883L (data sheet: 2 milligauss)."""

    period_ticks: Count = 12
    """ticks between two readings (50 Hz)"""
    latency_ticks: CountOrZero = 3
    """ticks from measurement to arrival"""
    strength_ut: Annotated[float, Interval(ge=20.0, le=70.0)] = 54.8
    """magnitude of the field"""
    declination_deg: Annotated[float, Interval(ge=-180.0, le=180.0)] = -7.2
    """east of true north"""
    inclination_deg: Annotated[float, Interval(ge=-90.0, le=90.0)] = 59.3
    """below the horizon"""
    noise_sigma_ut: NotNegative = 0.2
    """standard deviation of the white noise, each axis"""
    hard_iron_sigma_ut: NotNegative = 0.7
    """residual of the calibration, each axis, constant in one flight"""


@parameters
class RangefinderParams:
    """A downward single-beam laser altimeter of the class of a LightWare LW20: 100 m on bright
    ground, resolution 1 cm."""

    period_ticks: Count = 12
    """ticks between two readings (50 Hz)"""
    latency_ticks: CountOrZero = 6
    """ticks from measurement to arrival"""
    sigma_m: NotNegative = 0.03
    """standard deviation of the range noise"""
    resolution_m: Positive = 0.01
    """step that readings are rounded to"""
    min_range_m: NotNegative = 0.1
    """nearest range that is reported"""
    max_range_m: Positive = 100.0
    """on a surface of 70 % reflectivity; darker and slanted ones are lost sooner"""
    position_body_m: tuple[float, float, float] = (-0.06, 0.0, -0.13)
    """origin of the beam, body frame; it points along body -z"""


@parameters
class NavParams:
    """The sensors beside camera, LIDAR and IMU."""

    gps: GpsParams = field(default_factory=GpsParams)
    barometer: BarometerParams = field(default_factory=BarometerParams)
    magnetometer: MagnetometerParams = field(default_factory=MagnetometerParams)
    rangefinder: RangefinderParams = field(default_factory=RangefinderParams)


@dataclass(frozen=True, kw_only=True, slots=True)
class NavSheet:
    """What data sheets, calibration and maps say of the sensors beside camera, LIDAR and IMU. All
    of the magnetometer and the rangefinder is such: field of the earth, noise, ranges, mount."""

    gps: GpsSheet = field(default_factory=GpsSheet)
    barometer: BarometerSheet = field(default_factory=BarometerSheet)
    magnetometer: MagnetometerParams = field(default_factory=MagnetometerParams)
    rangefinder: RangefinderParams = field(default_factory=RangefinderParams)


@dataclass(frozen=True, kw_only=True, slots=True)
class GpsFix:
    """Position and velocity of the ANTENNA (``GpsSheet.antenna_body_m``) at ``tick``, in the local
    east-north-up frame, which is the world frame."""

    tick: int
    time_s: float
    position_world: Array
    """(3,) m"""
    velocity_world: Array
    """(3,) m/s"""
    sigma_position_m: Array
    """(3,) standard deviation that the receiver reports, per axis"""
    sigma_velocity_mps: float
    """the same of the velocity, each axis"""


@dataclass(frozen=True, kw_only=True, slots=True)
class BarometerSample:
    tick: int
    time_s: float
    pressure_pa: float
    altitude_m: float
    """height above world z = 0 by the standard atmosphere; drift and offset are in it"""


@dataclass(frozen=True, kw_only=True, slots=True)
class MagnetometerSample:
    tick: int
    time_s: float
    field_body_ut: Array
    """(3,) microtesla, body frame"""


@dataclass(frozen=True, kw_only=True, slots=True)
class RangefinderSample:
    tick: int
    time_s: float
    range_m: float
    """along body -z from ``RangefinderParams.position_body_m``; 0 where there was no return"""
