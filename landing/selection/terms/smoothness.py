"""The term smoothness (Zou, Sun, Kong 2024, Eq. 14): distance to edges in the colour map."""

from __future__ import annotations

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from touchdown.landing.api import LandingParams, TermLayer
from touchdown.landing.selection.ground.elevation_raster import ElevationRaster, distance_up_to
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
    large = np.zeros(coloured.shape, np.bool_)
    _find_large_holes(coloured, np.empty((hole_cells + 1, 2), np.int64), large)
    edges[large] = 1
    return edges, coloured


def smoothness(edges: NDArray[np.uint8], coloured: Mask, cell_m: float, full_m: float) -> Float32:
    """Eq. 14: radius of the largest circle around a cell without an edge, by the exact Euclidean
    distance transform; 1 from ``full_m`` on. NaN where uncoloured."""
    radius = distance_up_to(edges > 0, cell_m, full_m)
    cost = np.minimum(radius / np.float32(full_m), np.float32(1.0))
    return np.where(coloured, cost, np.float32(np.nan))


@numba.njit(cache=True)
def _find_large_holes(coloured: Mask, found: NDArray[np.int64], large: Mask) -> None:
    """Marks the uncoloured cells that are connected to as many others as ``found`` has rows."""
    rows, cols = coloured.shape
    for row in range(rows):
        for col in range(cols):
            if coloured[row, col]:
                continue
            if (row and large[row - 1, col]) or (col and large[row, col - 1]):
                large[row, col] = True
                continue
            found[0, 0], found[0, 1] = row, col
            count, at = 1, 0
            while at < count < found.shape[0]:
                for side in range(4):
                    r = found[at, 0] + (side == 0) - (side == 1)
                    c = found[at, 1] + (side == 2) - (side == 3)
                    new = 0 <= r < rows and 0 <= c < cols and not coloured[r, c]
                    for k in range(count):
                        new = new and (found[k, 0] != r or found[k, 1] != c)
                    if new and count < found.shape[0]:
                        found[count, 0], found[count, 1] = r, c
                        count += 1
                at += 1
            large[row, col] = count == found.shape[0]
