"""Measured conditions of a flight, as a part of its result."""

from __future__ import annotations

import math
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict


def _finite(value: Any) -> Any:
    """None for NaN and infinities, which JSON has no number for."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


Figure = Annotated[float | None, BeforeValidator(_finite)]
"""A measured number; None where the run has none."""


class Measured(BaseModel):
    """Conditions of the flight, measured; None where nothing measures them."""

    model_config = ConfigDict(extra="allow", frozen=True, strict=True)

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
    lamp_share: Figure = None
    """share of images under the lamp"""
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
    mass_share: Figure = None
    center_of_mass_m: Figure = None
    rotor_share: Figure = None
    imu_scale: Figure = None
    imu_misalignment_deg: Figure = None
    range_error_m: Figure = None
    """mean systematic error of a range"""
    plants_share: Figure = None
    """share of returns that come from plants instead of the ground"""
    sway_m: Figure = None
    """mean displacement of returns from crowns, over scans that have some"""
    wakes_mps: Figure = None
    air_rotation_degps: Figure = None
    dust_scans: Figure = None
    """scans that dust changed"""
    dust_images: Figure = None
    dust_returns_share: Figure = None
    """of the returns of scans in dust"""
