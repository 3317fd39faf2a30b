"""Ground in colours that no scene gives it: red asphalt, pale paving, dark roofs.

What is learnt from few scenes leans on their palette. Drawing colours at random teaches texture and
shape instead (domain randomisation: Tobin et al., IROS 2017).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import LAND_CLASSES, OTHER_CLASS_ID, Scene

if TYPE_CHECKING:
    from touchdown.experiments.classification.image_types import Image, Int32

_MADE, _GROWN, _WATER = (0.35, 0.28, 0.07), (0.15, 0.08, 0.03), (0.2, 0.1, 0.05)
"""deviation of the logarithms of brightness, red over blue, and green: of what is built or dug, of
what grows, of water"""
_SPREAD = dict.fromkeys(LAND_CLASSES, _MADE) | dict.fromkeys(("lawn", "trees"), _GROWN)
_SPREAD |= {"water": _WATER}


def material_image(scene: Scene, geom_id: Int32, classes: Int32) -> Int32:
    """(H, W) number of the material that each pixel shows, times the number of classes, plus its
    class: of a ground that is one geom, the class tells kinds of ground apart.

    ``geom_id`` (H, W), -1 for nothing; ``classes`` (H, W) land class ids, others below 0 or above.
    """
    material = np.append(scene.model.geom_matid, -1)[geom_id] + 1
    known = np.clip(classes, -1, OTHER_CLASS_ID) + 1
    return np.asarray(material * (OTHER_CLASS_ID + 2) + known, np.int32)


def recoloured(rgb: Image, materials: Int32, rng: np.random.Generator) -> Image:
    """(H, W, 3) with another colour for each of the ``materials`` (H/2, W/2), in linear light."""
    kinds, where = np.unique(materials, return_inverse=True)
    gains = np.stack([_gain(int(kind) % (OTHER_CLASS_ID + 2) - 1, rng) for kind in kinds])
    by_pixel = gains[where.reshape(materials.shape)]
    full = by_pixel.repeat(2, axis=0).repeat(2, axis=1)[: rgb.shape[0], : rgb.shape[1]]
    linear = (rgb.astype(np.float32) / 255.0) ** 2.2 * full
    return np.asarray(np.round(255.0 * np.minimum(linear, 1.0) ** (1.0 / 2.2)), np.uint8)


def _gain(land_class: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """(3,) of linear red, green and blue."""
    name = LAND_CLASSES[land_class] if 0 <= land_class < len(LAND_CLASSES) else "building"
    light, warm, green = rng.normal(0.0, _SPREAD[name])
    return np.exp(np.array([light + warm, light + green, light - warm])).astype(np.float32)
