"""Parameters of the LIDAR; part of `sim.api`: import them from there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from touchdown.sim.ranges import FORBID_EXTRA, Fraction, NotNegative, Positive

LidarPreset = Literal["horizon", "avia", "mid360"]


@dataclass(frozen=True, kw_only=True, slots=True)
class LidarSheet:
    """What a data sheet says of a Livox-like scanning LIDAR. Defaults: Livox Horizon
    (manufacturer's data sheet)."""

    __pydantic_config__ = FORBID_EXTRA

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
    """A Livox-like scanning LIDAR, and what it meets in the world. Defaults: Livox Horizon
    (manufacturer's data sheet)."""

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
    """share of the range noise's variance, at 20 m on 80 %, that grows as an echo gets weaker (with
    the range squared, over reflectivity times cosine). 0: ``range_sigma_m`` everywhere"""
    texture: NotNegative = 0.0
    """how much the reflectivity varies within a surface, over the measured spreads of materials: 1
    as measured, 0 not at all"""
    vegetation: NotNegative = 0.0
    """height of grass and crops that pulses partly enter, over the usual one of each material: 1
    as usual, 0 none"""
    sway: NotNegative = 0.0
    """how far crowns sway in the wind, over the displacement of a typical tree: 1 as typical, 0 not
    at all"""
