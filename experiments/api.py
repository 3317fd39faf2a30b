"""Outcomes of flights, and parameters of referee, bias and calibration error."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated

from annotated_types import Interval

from touchdown.sim.api import FORBID_EXTRA, NotNegative, Positive


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

    timeout_s: Positive = 300.0
    """simulated time after which the flight ends as TIMEOUT"""
    divergence_m: Positive = 20.0
    """position error at which the estimate counts as lost"""
    tip_tilt_deg: Annotated[float, Interval(gt=0.0, lt=180.0)] = 60.0
    """tilt on the ground from which on the vehicle counts as tipped over"""


@dataclass(frozen=True, kw_only=True, slots=True)
class BiasParams:
    """An offset ramped into the estimate after take-off. In a closed loop it displaces the vehicle
    by minus the bias."""

    __pydantic_config__ = FORBID_EXTRA

    xy_m: tuple[float, float] = (0.0, 0.0)
    """offset east and north"""
    ramp_s: Positive = 5.0
    """time over which the offset grows to its full size"""


@dataclass(frozen=True, kw_only=True, slots=True)
class CalibrationErrorParams:
    """Standard deviations of the calibration error of the believed rig, drawn from the seed; unused
    in flights with a calibration file."""

    __pydantic_config__ = FORBID_EXTRA

    rotation_sigma_deg: NotNegative = 0.03
    """of camera_from_lidar, about each axis"""
    translation_sigma_m: NotNegative = 0.003
    """of camera_from_lidar, along each axis"""
    focal_sigma: NotNegative = 5e-4
    """relative, of each focal length"""
    center_sigma_px: NotNegative = 0.0
    """of either coordinate of the principal point"""
