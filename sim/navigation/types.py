"""Parameters and messages of the navigation sensors; part of `sim.api`: import them from there."""

from __future__ import annotations

from dataclasses import dataclass, field

from touchdown.sim.typing import Array

FORBID_EXTRA = {"extra": "forbid"}
"""Read by pydantic: an unknown configuration key is an error, not a silent default."""


# ------------------------------------------------------------------------------- parameters


@dataclass(frozen=True, kw_only=True, slots=True)
class GpsParams:
    """A satellite receiver: ``paper``, ``ublox-m8``, ``rtk`` or ``denied`` (no fix ever). Fields
    that are None come from the preset."""

    __pydantic_config__ = FORBID_EXTRA

    preset: str = "paper"
    period_ticks: int = 120
    latency_ticks: int = 72
    antenna_body_m: tuple[float, float, float] = (0.0, 0.0, 0.14)
    """position of the antenna, body frame: on top of the battery"""
    sigma_xy_m: float | None = None
    """stationary standard deviation of the wandering error, each horizontal axis"""
    sigma_z_m: float | None = None
    tau_s: float | None = None
    """correlation time of that error"""
    white_m: float | None = None
    """white noise of a fix, each axis"""
    velocity_sigma_mps: float | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class BarometerParams:
    """Bosch BMP388 (data sheet): noise 1.2 Pa, absolute accuracy 50 Pa, relative 8 Pa; the drift is
    a Gauss-Markov process (weather, temperature). 12 Pa are about 1 m."""

    __pydantic_config__ = FORBID_EXTRA

    period_ticks: int = 24
    latency_ticks: int = 12
    white_sigma_pa: float = 1.2
    drift_sigma_pa: float = 4.0
    drift_tau_s: float = 300.0
    offset_sigma_pa: float = 25.0
    """turn-on"""
    site_elevation_m: float = 50.0
    """of world z = 0 above mean sea level"""


@dataclass(frozen=True, kw_only=True, slots=True)
class MagnetometerParams:
    """Three-axis magnetometer in the field of a location. Defaults: about the field of the
    international reference model at 40 degrees north, 116 degrees east, and the noise of a
    Honeywell HMC5883L (data sheet: 2 milligauss)."""

    __pydantic_config__ = FORBID_EXTRA

    period_ticks: int = 12
    latency_ticks: int = 3
    strength_ut: float = 54.8
    declination_deg: float = -7.2
    """east of true north"""
    inclination_deg: float = 59.3
    """below the horizon"""
    noise_sigma_ut: float = 0.2
    hard_iron_sigma_ut: float = 0.7
    """residual of the calibration, each axis, constant in one flight"""


@dataclass(frozen=True, kw_only=True, slots=True)
class RangefinderParams:
    """A downward single-beam laser altimeter of the class of a LightWare LW20: 100 m on bright
    ground, resolution 1 cm."""

    __pydantic_config__ = FORBID_EXTRA

    period_ticks: int = 12
    latency_ticks: int = 6
    sigma_m: float = 0.03
    resolution_m: float = 0.01
    min_range_m: float = 0.1
    max_range_m: float = 100.0
    """on a surface of 70 % reflectivity; darker and slanted ones are lost sooner"""
    position_body_m: tuple[float, float, float] = (-0.06, 0.0, -0.13)
    """origin of the beam, body frame; it points along body -z"""


@dataclass(frozen=True, kw_only=True, slots=True)
class NavParams:
    """The sensors beside camera, LIDAR and IMU."""

    __pydantic_config__ = FORBID_EXTRA

    gps: GpsParams = field(default_factory=GpsParams)
    barometer: BarometerParams = field(default_factory=BarometerParams)
    magnetometer: MagnetometerParams = field(default_factory=MagnetometerParams)
    rangefinder: RangefinderParams = field(default_factory=RangefinderParams)


# --------------------------------------------------------------------------------- messages


@dataclass(frozen=True, kw_only=True, slots=True)
class GpsFix:
    """Position and velocity of the ANTENNA (``GpsParams.antenna_body_m``) at ``tick``, in the local
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
