"""Random colours of materials, such as red asphalt, pale paving, dark roofs.

A network that is trained on few scenes relies on their palette. Random colours make it learn
texture and shape instead (domain randomisation: Tobin et al., IROS 2017)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import LAND_CLASSES, OTHER_CLASS_ID, Scene

Image = NDArray[np.uint8]
Int32 = NDArray[np.int32]

_MADE, _GROWN, _WATER = (0.35, 0.28, 0.07), (0.15, 0.08, 0.03), (0.2, 0.1, 0.05)
"""standard deviations of the logarithms of brightness, red over blue, and green: of built or bare
ground, of vegetation, of water"""
_SPREAD = dict.fromkeys(LAND_CLASSES, _MADE) | dict.fromkeys(("lawn", "trees"), _GROWN)
_SPREAD |= {"water": _WATER}


def material_image(scene: Scene, geom_id: Int32, classes: Int32) -> Int32:
    """Returns (H, W) numbers of material and class of each pixel: the material times the number of
    classes plus the class. The class separates the kinds of ground of a single ground geom.

    ``geom_id`` (H, W), -1 for the background; ``classes`` (H, W) land class ids.
    """
    material = np.append(scene.model.geom_matid, -1)[geom_id] + 1
    known = np.clip(classes, -1, OTHER_CLASS_ID) + 1
    return np.asarray(material * (OTHER_CLASS_ID + 2) + known, np.int32)


def recoloured(rgb: Image, materials: Int32, rng: np.random.Generator) -> Image:
    """Returns an image (H, W, 3) with another colour for each of the ``materials`` (H/2, W/2),
    changed in linear light."""
    kinds, where = np.unique(materials, return_inverse=True)
    gains = np.stack([_gain(int(kind) % (OTHER_CLASS_ID + 2) - 1, rng) for kind in kinds])
    by_pixel = gains[where.reshape(materials.shape)]
    full = by_pixel.repeat(2, axis=0).repeat(2, axis=1)[: rgb.shape[0], : rgb.shape[1]]
    linear = (rgb.astype(np.float32) / 255.0) ** 2.2 * full
    return np.asarray(np.round(255.0 * np.minimum(linear, 1.0) ** (1.0 / 2.2)), np.uint8)


def _gain(land_class: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Returns the gains (3,) of linear red, green and blue."""
    name = LAND_CLASSES[land_class] if 0 <= land_class < len(LAND_CLASSES) else "building"
    light, warm, green = rng.normal(0.0, _SPREAD[name])
    if _SPREAD[name] == _MADE:
        warm = abs(warm)  # blue ground is rare, and blue water common
    return np.exp(np.array([light + warm, light + green, light - warm])).astype(np.float32)
