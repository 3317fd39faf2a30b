"""Quick Shift on the gridded costmap (Zou, Sun, Kong 2024, Eq. 19; Vedaldi and Soatto 2008)."""

from dataclasses import dataclass

import cv2
import numba
import numpy as np

from touchdown.landing.api import LandingParams
from touchdown.sim.typing import Float32, Int32


@dataclass(frozen=True, kw_only=True, slots=True)
class Clusters:
    """Modes of a density and the cells of each.

    ``label``: (rows, cols) int32, index of the cell's mode, -1 outside; ``modes``: (K, 2)
    int32 row, col, in row-major order; ``density``: (rows, cols) float32, NaN outside."""

    label: Int32
    modes: Int32
    density: Float32


def bandwidths(footprint_cells: float, params: LandingParams) -> tuple[float, float]:
    """Returns the bandwidth of the density and the search radius, in cells, for a vehicle whose
    footprint has the radius ``footprint_cells``."""
    bandwidth = params.cluster_bandwidth * footprint_cells
    return bandwidth, params.cluster_search * bandwidth


def kernel_density(values: Float32, bandwidth_cells: float) -> Float32:
    """Returns P of Eq. 19: the average of ``values`` under a Gaussian kernel. NaN cells have no
    weight and no density."""
    known = np.isfinite(values)
    weight = cv2.GaussianBlur(
        known.astype(np.float32), (0, 0), bandwidth_cells, borderType=cv2.BORDER_CONSTANT
    )
    total = cv2.GaussianBlur(
        np.where(known, values, np.float32(0.0)), (0, 0), bandwidth_cells,
        borderType=cv2.BORDER_CONSTANT,
    )  # fmt: skip
    return np.where(known, total / np.maximum(weight, np.float32(1e-9)), np.float32(np.nan))


def _search_offsets(radius_cells: float) -> Int32:
    """Returns (M, 2) row, col offsets within the radius, nearest first, ties in row-major order."""
    reach = int(radius_cells)
    offset = np.arange(-reach, reach + 1)
    dr, dc = (axis.ravel() for axis in np.meshgrid(offset, offset, indexing="ij"))
    squared = dr**2 + dc**2
    keep = (squared > 0) & (squared <= radius_cells**2)
    order = np.argsort(squared[keep], kind="stable")
    return np.column_stack([dr[keep], dc[keep]])[order].astype(np.int32)


def _nearest_higher(density: Float32, offsets: Int32) -> Int32:
    """Returns the flat index of the nearest cell of higher density, the cell itself where there is
    none within reach, -1 outside. Equal densities are ordered by index: a plateau has one mode."""
    # A border of NaN, which is never higher, makes every offset one step in a flat array.
    reach = int(np.abs(offsets).max(initial=0))
    padded = np.pad(density, reach, constant_values=np.nan)
    parent = np.full(density.shape, -1, np.int32)
    _look_around(padded, offsets, reach, parent)
    return parent.ravel()


@numba.njit(cache=True)
def _look_around(padded: Float32, offsets: Int32, reach: int, parent: Int32) -> None:
    """Fills in ``parent`` of `_nearest_higher` from the densities with ``reach`` more cells on each
    side."""
    rows, cols = parent.shape
    wide = cols + 2 * reach
    flat, steps = padded.reshape(padded.size), np.empty(offsets.shape[0], np.int64)
    for k in range(steps.shape[0]):
        steps[k] = offsets[k, 0] * wide + offsets[k, 1]
    for row in range(rows):
        start = (row + reach) * wide + reach
        for col in range(cols):
            own = flat[start + col]
            if np.isnan(own):
                continue
            index = row * cols + col
            parent[row, col] = index
            for k in range(steps.shape[0]):
                other = flat[start + col + steps[k]]
                if other > own or (other == own and steps[k] < 0):
                    parent[row, col] = index + offsets[k, 0] * cols + offsets[k, 1]
                    break


@numba.njit(cache=True)
def _follow(parent: Int32, label: Int32) -> None:
    """Gives every cell the ``label`` of its root, which has one; the others have -1."""
    for index in range(parent.size):
        top = index
        while parent[top] >= 0 and label[top] < 0:
            top = parent[top]
        walk = index
        while parent[walk] >= 0 and label[walk] < 0:
            label[walk] = label[top]
            walk = parent[walk]


def quick_shift(values: Float32, *, bandwidth_cells: float, radius_cells: float) -> Clusters:
    """Moves every cell to its nearest neighbour of higher density until none is within reach.

    ``values`` (rows, cols): higher is better, NaN cells are left out. The end points are the modes:
    the candidate landing sites.
    """
    density = kernel_density(values, bandwidth_cells)
    parent = _nearest_higher(density, _search_offsets(radius_cells))
    mode_index, cols = np.flatnonzero(parent == np.arange(parent.size)), values.shape[1]
    modes = np.column_stack([mode_index // cols, mode_index % cols]).astype(np.int32)
    label = np.full(parent.size, -1, np.int32)
    label[mode_index] = np.arange(mode_index.size)
    _follow(parent, label)
    return Clusters(label=label.reshape(values.shape), modes=modes, density=density)
