"""What the rest of the project may know of experiments: outcomes and their parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Any

from annotated_types import Interval

from touchdown.sim.api import FORBID_EXTRA, NotNegative, Positive


class Outcome(StrEnum):
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
    """When a flight is over, whatever the vehicle believes."""

    __pydantic_config__ = FORBID_EXTRA

    timeout_s: Positive = 300.0
    """simulated time after which the flight ends as TIMEOUT"""
    divergence_m: Positive = 20.0
    """position error at which the estimate counts as lost"""
    tip_tilt_deg: Annotated[float, Interval(gt=0.0, lt=180.0)] = 60.0
    """tilt on the ground from which on the vehicle counts as tipped over"""


@dataclass(frozen=True, kw_only=True, slots=True)
class BiasParams:
    """An offset ramped into the estimate after take-off. It proves that the loop is closed: the
    vehicle must end up displaced by minus the bias."""

    __pydantic_config__ = FORBID_EXTRA

    xy_m: tuple[float, float] = (0.0, 0.0)
    """offset east and north"""
    ramp_s: Positive = 5.0
    """time over which the offset grows to its full size"""


@dataclass(frozen=True, kw_only=True, slots=True)
class CalibrationErrorParams:
    """What is wrong with the calibration that estimators are told, drawn from the seed; not used
    where a flight names a calibration file."""

    __pydantic_config__ = FORBID_EXTRA

    rotation_sigma_deg: NotNegative = 0.03
    """of camera_from_lidar, about each axis"""
    translation_sigma_m: NotNegative = 0.003
    """of camera_from_lidar, along each axis"""
    focal_sigma: NotNegative = 5e-4
    """relative, of each focal length"""
    center_sigma_px: NotNegative = 0.0
    """of either coordinate of the principal point"""


def is_good(result: dict[str, Any]) -> bool:
    """Landed on safe ground, of a safe class where places were recognised; for a survey alone:
    flown to its end."""
    if result["outcome"] == "COMPLETED":
        return True
    return result["outcome"] == "LANDED" and bool(ground_was_safe(result["landing"] or {}))


def ground_was_safe(landing: Mapping[str, Any]) -> bool | None:
    """By what the flight is judged on; None where the result does not say."""
    by_class = landing.get("judged_on") == "geometry and class"
    found = landing.get("safe" if by_class else "safe_geometry")
    return found if isinstance(found, bool) else None
