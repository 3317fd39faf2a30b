"""The term smoothness (Zou, Sun, Kong 2024, Eq. 14): distance to edges in the colour map."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.landing.api import LandingParams, TermLayer
from touchdown.landing.selection.ground.elevation_raster import ElevationRaster, distance_to
from touchdown.landing.selection.terms.inputs import Inputs

Float32 = NDArray[np.float32]
Mask = NDArray[np.bool_]


def term(site: Inputs) -> TermLayer:
    """Returns the reward of smooth ground."""
    share = site.smoothness
    return TermLayer(
        name="smoothness", value=site.selector.weight_smoothness * share, quantity=share
    )


def smoothness_of(raster: ElevationRaster, params: LandingParams) -> Float32:
    """Returns Eq. 14 of a raster."""
    edges, coloured = colour_edges(
        raster.rgb,
        blur_cells=params.edge_blur_m / raster.cell_m,
        low=params.edge_low,
        high=params.edge_high,
        hole_cells=params.edge_hole_cells,
    )
    return smoothness(edges, coloured, raster.cell_m, params.smoothness_full_m)


def colour_edges(
    rgb: Float32, *, blur_cells: float, low: float, high: float, hole_cells: int
) -> tuple[NDArray[np.uint8], Mask]:
    """Canny(x) of Eq. 14 on the orthographic colour map after a Gaussian filter.

    ``rgb`` (rows, cols, 3), 0..255, NaN uncoloured. Returns the binary edges (1 = edge) and the
    mask of coloured cells. The filter averages coloured cells only, so holes of up to
    ``hole_cells`` cause no edges; larger ones count as edges, since their content is unknown.
    """
    coloured = np.isfinite(rgb[..., 0])
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    grey[~coloured] = 0.0
    weight = cv2.GaussianBlur(coloured.astype(np.float32), (0, 0), blur_cells)
    smooth = cv2.GaussianBlur(grey, (0, 0), blur_cells)
    image = cv2.divide(smooth, np.maximum(weight, 1e-3), dtype=cv2.CV_8U)
    edges = (cv2.Canny(image, low, high, L2gradient=True) > 0).astype(np.uint8)
    number, labels, stats, _ = cv2.connectedComponentsWithStats(
        (~coloured).astype(np.uint8), connectivity=4
    )
    large = stats[:, cv2.CC_STAT_AREA] > hole_cells
    large[0] = False
    holes = large[labels] if number > 1 else np.zeros_like(coloured)
    edges[holes] = 1
    return edges, coloured


def smoothness(edges: NDArray[np.uint8], coloured: Mask, cell_m: float, full_m: float) -> Float32:
    """Eq. 14: radius of the largest circle around a cell without an edge, by the exact Euclidean
    distance transform; 1 from ``full_m`` on. NaN where uncoloured."""
    radius = distance_to(edges > 0, cell_m)
    cost = np.minimum(radius / np.float32(full_m), 1.0)
    return np.where(coloured, cost, np.nan).astype(np.float32)
