"""The term ground: the probability of ground of an allowed class, by the semantic map."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.landing.api import LandingParams, SemanticView, TermLayer
from touchdown.landing.selection.ground.elevation_raster import ElevationRaster
from touchdown.landing.selection.terms.inputs import Inputs
from touchdown.scenes.api import LAND_CLASSES

Float32 = NDArray[np.float32]


def term(site: Inputs) -> TermLayer:
    """Returns the penalty of ground that may be of no allowed class."""
    value = np.float32(site.selector.weight_ground) * (site.ground - np.float32(1.0))
    return TermLayer(name="ground", value=value, quantity=site.ground)


def allowed_ground(
    semantics: SemanticView | None, raster: ElevationRaster, params: LandingParams
) -> Float32:
    """Returns the probability (rows, cols) of the allowed classes in every cell, between the nodes
    of the map linearly; where nothing was seen, that of a class drawn at random; 1 without a
    map."""
    wanted = np.array([name in params.allowed_classes for name in LAND_CLASSES])
    blind = np.float32(wanted.mean())
    if semantics is None:
        return np.ones(raster.shape, np.float32)
    nodes = semantics.probabilities[..., wanted].sum(axis=-1, dtype=np.float32)
    centres = (
        raster.origin_xy_m[axis] + (np.arange(raster.shape[1 - axis]) + 0.5) * raster.cell_m
        for axis in (0, 1)
    )
    at = [
        ((centre - semantics.origin_xy_m[axis]) / semantics.spacing_m).astype(np.float32)
        for axis, centre in enumerate(centres)
    ]
    cols, rows = np.meshgrid(*at)
    found = cv2.remap(
        nodes,
        cols,
        rows,
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=float(blind),
    )
    return np.asarray(found, np.float32)
