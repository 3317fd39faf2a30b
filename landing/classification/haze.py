"""How hazy the air is, from how the darkest ground brightens with height, and pictures without it.

Through haze the light of a pixel at the distance d is L exp(-e d) + A (1 - exp(-e d)), with the
extinction e and the airlight A (Koschmieder, 1924). Nearly every picture of open ground shows
something dark in some colour, such as shadows, leaves, wet soil: what its darkest pixels have is
mostly airlight (He, Sun and Tang, "Single image haze removal using dark channel prior", CVPR 2009).
One picture does not tell bright ground from haze. Many do, from heights that differ, as a climb
gives them: the veil grows with height in the way that e and A say, and the ground does not (Nayar
and Narasimhan, "Vision in bad weather", ICCV 1999, take depth from haze; here depth is known).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

_GAMMA = 2.2
"""light is the grey level to this power"""
_LIGHT = (np.arange(256) / 255.0) ** _GAMMA
_STRIDE = 4
_DARKEST = 0.005
"""share of a picture's pixels"""
_RING = 1.25
"""highest over lowest of the heights that are taken together"""
_LEAST_RINGS = 4
"""fewer tell nothing"""
_LEAST_RISE = 0.05
"""linear light that the darkest ground gains from the least height to the greatest; less is left as
it is, and ground that is bright from everywhere is no haze"""
_COVERED, _COVERED_SHARE = 0.6, 0.9
"""of the veil, which so many of the pictures from high up must not be darker than: trees and roofs
lie nearer than the ground, but where a picture shows hardly any veil there is none"""
_LEAST_CLEAR = 0.1
"""share of the ground's light; where less comes through, noise is all that would be brought out"""
_SCALE = 0.02
"""linear light; what lies further from the fit counts less"""


@dataclass(frozen=True, slots=True)
class Haze:
    """Extinction, 1/m, and airlight in linear light, 1 for white; extinction 0: clear air."""

    extinction: float = 0.0
    airlight: float = 0.0

    def veil(self, distances_m: Array) -> Array:
        """Linear light that the air adds over distances of any shape."""
        return np.asarray(self.airlight * (1.0 - np.exp(-self.extinction * distances_m)))

    def removed(self, rgb: Image, distances_m: Array) -> Image:
        """(H, W, 3) as it would be in clear air, from how far each pixel (H, W) looks."""
        clear = np.maximum(np.exp(-self.extinction * distances_m), _LEAST_CLEAR)[..., None]
        light = (_LIGHT[rgb] - self.veil(distances_m)[..., None]) / clear
        return np.asarray(np.rint(255.0 * np.clip(light, 0.0, 1.0) ** (1.0 / _GAMMA)), np.uint8)


def darkest_light(rgb: Image) -> float:
    """Linear light, in its darkest colour, of the darkest pixels of (H, W, 3): their quantile."""
    dark = rgb[::_STRIDE, ::_STRIDE].min(axis=2)
    return float(_LIGHT[int(np.quantile(dark, _DARKEST))])


def estimate_haze(heights_m: Array, darkest: Array) -> Haze:
    """From (N,) heights above ground that pictures were taken at and their ``darkest_light`` (N,).

    Fits extinction, airlight and the light of the darkest ground, robustly; clear air where the
    pictures tell nothing or show none.
    """
    rings = np.rint(np.log(heights_m) / np.log(_RING))
    # most pictures are from survey height: every ring of heights counts the same
    members = [rings == ring for ring in np.unique(rings)]
    if len(members) < _LEAST_RINGS:
        return Haze()
    heights = np.array([np.median(heights_m[one]) for one in members])
    lights = np.array([np.median(darkest[one]) for one in members])
    top = float(heights.max())

    def residuals(guess: Array) -> Array:
        depth, airlight, ground = guess
        clear = np.exp(-depth * heights / top)
        return airlight * (1.0 - clear) + ground * clear - lights

    fit = least_squares(
        residuals,
        x0=[0.5, 0.5, float(lights.min())],
        bounds=([1e-3, 0.0, 0.0], [10.0, 1.0, 1.0]),
        loss="soft_l1",
        f_scale=_SCALE,
    )
    depth, airlight, ground = fit.x
    haze = Haze(float(depth) / top, float(airlight))
    rise = (airlight - ground) * (np.exp(-depth * heights.min() / top) - np.exp(-depth))
    high = heights_m > 0.5 * top
    covered = darkest[high] >= _COVERED * haze.veil(heights_m[high])
    if rise < _LEAST_RISE or covered.mean() < _COVERED_SHARE:
        return Haze()
    return haze
