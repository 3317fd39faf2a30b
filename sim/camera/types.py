"""Parameters of the camera and of the landing lamp."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge, Interval

from touchdown.sim.ranges import FORBID_EXTRA, Count, CountOrZero, NotNegative, Positive


@dataclass(frozen=True, kw_only=True, slots=True)
class CameraParams:
    """RealSense D435 colour camera."""

    __pydantic_config__ = FORBID_EXTRA

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
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2, k3 of OpenCV's lens model"""
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


@dataclass(frozen=True, kw_only=True, slots=True)
class LampParams:
    """A landing lamp beside the camera, along its axis."""

    __pydantic_config__ = FORBID_EXTRA

    below_m: NotNegative = 0.0
    """the lamp is on while the ground below is nearer than this; 0: no lamp"""
    flux_lm: Positive = 3000.0
    """luminous flux"""
    beam_deg: Annotated[float, Interval(gt=1.0, lt=170.0)] = 60.0
    """full angle between the directions of half the intensity"""
