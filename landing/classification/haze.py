"""Haze estimation from the brightening of the darkest ground with height, and haze removal.

Through haze the light of a pixel at the distance d is L exp(-e d) + A (1 - exp(-e d)), with the
extinction e and the airlight A (Koschmieder, 1924). Nearly every image of open ground contains
pixels that are dark in some colour, such as shadows, leaves or wet soil; their light is mostly
airlight (He, Sun and Tang, "Single image haze removal using dark channel prior", CVPR 2009). One
image cannot separate bright ground from haze. Images from different heights, as of a climb, can:
the veil grows with height as e and A predict, the ground does not (Nayar and Narasimhan, "Vision in
bad weather", ICCV 1999, take depth from haze; here depth is known).
"""

from dataclasses import dataclass

import numpy as np

from touchdown.sim.typing import Array, Image

_GAMMA = 2.2
"""exponent from grey level to linear light"""
_LIGHT = (np.arange(256) / 255.0) ** _GAMMA
_STRIDE = 4
_DARKEST = 0.005
"""quantile of an image's pixels"""
_RING = 1.25
"""ratio of the heights that are grouped together"""
_MIN_RINGS = 4
"""fewer groups do not determine the fit"""
_MIN_RISE = 0.05
"""least gain of linear light of the darkest ground from the lowest height to the highest; below it
the air counts as clear, so that ground that is bright from every height is not taken for haze"""
_COVERED, _COVERED_FRACTION = 0.6, 0.9
"""fraction of the veil that images from high up must reach, and the fraction of the images that
must reach it. Trees and roofs lie nearer than the ground, so some images do not; many mean clear
air."""
_MIN_CLEAR = 0.1
"""least fraction of the ground's light; below it haze removal would only amplify noise"""
_SCALE = 0.02
"""linear light; scale of the robust loss"""


@dataclass(frozen=True, slots=True)
class Haze:
    """Extinction in 1/m and airlight in linear light (1 is white); clear air has extinction 0."""

    extinction: float = 0.0
    airlight: float = 0.0

    def veil(self, distances_m: Array) -> Array:
        """Returns the linear light that the air adds over distances of any shape."""
        return np.asarray(self.airlight * (1.0 - np.exp(-self.extinction * distances_m)))

    def removed(self, rgb: Image, distances_m: Array) -> Image:
        """Returns the image (H, W, 3) in clear air, given the distance of each pixel (H, W)."""
        clear = np.maximum(np.exp(-self.extinction * distances_m), _MIN_CLEAR)[..., None]
        light = (_LIGHT[rgb] - self.veil(distances_m)[..., None]) / clear
        return np.asarray(np.rint(255.0 * np.clip(light, 0.0, 1.0) ** (1.0 / _GAMMA)), np.uint8)


def darkest_light(rgb: Image) -> float:
    """Returns the linear light of the darkest pixels of an image (H, W, 3): a low quantile of the
    darkest colour of each pixel."""
    dark = rgb[::_STRIDE, ::_STRIDE].min(axis=2)
    return float(_LIGHT[int(np.quantile(dark, _DARKEST))])


def estimate_haze(heights_m: Array, darkest: Array) -> Haze:
    """Fits extinction, airlight and the light of the darkest ground, robustly.

    ``heights_m`` (N,): heights above ground of the images; ``darkest`` (N,): their
    ``darkest_light``. Returns clear air where the images do not determine haze or show none.
    """
    rings = np.rint(np.log(heights_m) / np.log(_RING))
    # most images are from survey height: every group of heights has the same weight
    members = [rings == ring for ring in np.unique(rings)]
    if len(members) < _MIN_RINGS:
        return Haze()
    heights = np.array([np.median(heights_m[one]) for one in members])
    lights = np.array([np.median(darkest[one]) for one in members])
    top = float(heights.max())

    from scipy.optimize import least_squares  # takes a while to load

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
    if rise < _MIN_RISE or covered.mean() < _COVERED_FRACTION:
        return Haze()
    return haze
