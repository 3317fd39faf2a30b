"""Outcomes of flights, and parameters of referee, bias and calibration error."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from touchdown.sim.api import FORBID_EXTRA


class Outcome(StrEnum):
    """The way a flight ended."""

    LANDED = "LANDED"
    TIPPED = "TIPPED"
    COLLIDED = "COLLIDED"
    TIMEOUT = "TIMEOUT"
    DIVERGED = "DIVERGED"
    NO_SITE = "NO_SITE"
    ABORTED = "ABORTED"
    GROUNDED = "GROUNDED"
    """the survey was over and the vehicle had not left the ground"""
    COMPLETED = "COMPLETED"
    """``fly``: the survey was flown to its end"""


@dataclass(frozen=True, kw_only=True, slots=True)
class RefereeParams:
    """Limits at which the referee ends a flight."""

    __pydantic_config__ = FORBID_EXTRA

    timeout_s: float = 300.0
    divergence_m: float = 20.0
    """position error at which the estimate counts as lost"""
    tip_tilt_deg: float = 60.0


@dataclass(frozen=True, kw_only=True, slots=True)
class BiasParams:
    """An offset ramped into the estimate after take-off. In a closed loop it displaces the vehicle
    by minus the bias."""

    __pydantic_config__ = FORBID_EXTRA

    xy_m: tuple[float, float] = (0.0, 0.0)
    ramp_s: float = 5.0


@dataclass(frozen=True, kw_only=True, slots=True)
class CalibrationErrorParams:
    """Standard deviations of the calibration error of the believed rig, drawn from the seed; unused
    in flights with a calibration file."""

    __pydantic_config__ = FORBID_EXTRA

    rotation_sigma_deg: float = 0.03
    """of camera_from_lidar, about each axis"""
    translation_sigma_m: float = 0.003
    """of camera_from_lidar, along each axis"""
    focal_sigma: float = 5e-4
    """relative, of each focal length"""
    center_sigma_px: float = 0.0
    """of either coordinate of the principal point"""
