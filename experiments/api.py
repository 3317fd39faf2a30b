"""What the rest of the project may know of experiments: outcomes and their parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from touchdown.sim.api import FORBID_EXTRA


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

    timeout_s: float = 300.0
    divergence_m: float = 20.0
    """position error at which the estimate counts as lost"""
    tip_tilt_deg: float = 60.0


@dataclass(frozen=True, kw_only=True, slots=True)
class BiasParams:
    """An offset ramped into the estimate after take-off. It proves that the loop is closed: the
    vehicle must end up displaced by minus the bias."""

    __pydantic_config__ = FORBID_EXTRA

    xy_m: tuple[float, float] = (0.0, 0.0)
    ramp_s: float = 5.0


@dataclass(frozen=True, kw_only=True, slots=True)
class CalibrationErrorParams:
    """What is wrong with the calibration that estimators are told, drawn from the seed; not used
    where a flight names a calibration file."""

    __pydantic_config__ = FORBID_EXTRA

    rotation_sigma_deg: float = 0.03
    """of camera_from_lidar, about each axis"""
    translation_sigma_m: float = 0.003
    """of camera_from_lidar, along each axis"""
    focal_sigma: float = 5e-4
    """relative, of each focal length"""
    center_sigma_px: float = 0.0
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
