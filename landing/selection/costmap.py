"""The costmaps of Zou, Sun and Kong (2024), Eqs. 13 to 18: smoothness, flatness and distance.

Flatness has two forms: ``literal`` follows Eqs. 16 and 17 (kernel centred on the mean angle, sum
over the disc), which rewards the average slope and the point density; ``corrected`` centres the
kernel on level ground and takes the mean per cell.
"""

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from touchdown.landing.api import LandingParams
from touchdown.landing.selection.ground.elevation_raster import (
    ElevationRaster,
    PlaneField,
    disc_widths,
)
from touchdown.sim.typing import Array, Float32, Mask


def c_sum(smooth: Float32, flat: Float32, near: Float32, params: LandingParams) -> Float32:
    """Eq. 13 with the weights of ``landing.zou2024``; NaN where any term is NaN."""
    weights = params.zou2024
    return (
        weights.weight_smoothness * smooth
        + weights.weight_flatness * flat
        + weights.weight_distance * near
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
    holes = (~coloured).astype(np.uint8)
    _, hole, stats, _ = cv2.connectedComponentsWithStats(holes, connectivity=4)
    edges[~coloured & (stats[hole, cv2.CC_STAT_AREA] > hole_cells)] = 1
    return edges, coloured


def smoothness(edges: NDArray[np.uint8], coloured: Mask, cell_m: float, full_m: float) -> Float32:
    """Eq. 14: radius of the largest circle around a cell without an edge, by the exact Euclidean
    distance transform; 1 from ``full_m`` on. NaN where uncoloured."""
    if edges.any():
        free = (edges == 0).astype(np.uint8)
        pixels = cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        pixels = np.sqrt(np.rint(pixels * pixels))  # squares of distances are whole numbers
    else:
        pixels = np.full(edges.shape, np.inf, np.float32)
    radius = pixels * np.float32(cell_m)
    cost = np.minimum(radius / np.float32(full_m), np.float32(1.0))
    return np.where(coloured, cost, np.float32(np.nan))


def flatness_of(raster: ElevationRaster, planes: PlaneField, params: LandingParams) -> Float32:
    """Returns Eqs. 15 to 17 of a raster; Eq. 15 is the angle of the ``planes`` of its cells."""
    angles = np.where(raster.known, planes.angle_rad, np.float32(np.nan))
    form = params.flatness_form
    kernel = flatness_kernel(angles, form=form, sigma_rad=np.deg2rad(params.flatness_sigma_deg))
    return flatness(
        kernel, raster.count, form=form, radius_m=params.clear_radius_m, cell_m=raster.cell_m
    )


def flatness_kernel(angles: Float32, *, form: str, sigma_rad: float) -> Float32:
    """Eq. 16: Gaussian of the angle. ``literal``: with mean and standard deviation of all cells;
    ``corrected``: centred on level ground with ``sigma_rad``. Raises ValueError for another
    form."""
    if form == "literal":
        centre, sigma = float(np.nanmean(angles)), max(float(np.nanstd(angles)), 1e-6)
    elif form == "corrected":
        centre, sigma = 0.0, sigma_rad
    else:
        raise ValueError(f"flatness_form is {form!r}: use 'corrected' or 'literal'")
    return np.exp((angles - np.float32(centre)) ** 2 * np.float32(-0.5 / sigma**2))


def flatness(
    kernel: Float32, count: Float32, *, form: str, radius_m: float, cell_m: float
) -> Float32:
    """Eq. 17: the kernel accumulated over the disc of ``radius_m``.

    ``literal``: sum over all returns of the disc, divided by the largest sum; ``corrected``: mean
    over the cells of the disc, unknown ones as 0. NaN where the cell is unknown.
    """
    widths = disc_widths(radius_m / cell_m)
    known = np.isfinite(kernel)
    values = np.where(known, kernel, np.float32(0.0))
    if form == "literal":
        values = values * count
    total, column = np.zeros_like(values), np.empty(values.shape[1] + widths.size - 1, np.float32)
    _disc_sums(values, widths, column, total)
    scale = float(total.max()) if form == "literal" else float((2 * widths + 1).sum())
    cost = np.clip(total / np.float32(max(scale, 1e-9)), np.float32(0.0), np.float32(1.0))
    return np.where(known, cost, np.float32(np.nan))


@numba.njit(cache=True)
def _disc_sums(values: Float32, widths: NDArray[np.int64], column: Float32, sums: Float32) -> None:
    """Adds the values in the disc whose rows reach ``widths`` to each side: of the columns that lie
    ``wide`` from the middle, as high as the rows that are at least as wide."""
    rows, cols = values.shape
    reach = widths.size // 2
    for row in range(rows):
        for col in range(column.size):
            column[col] = 0.0
        middle, out = column[reach:], sums[row]
        for wide in range(reach, -1, -1):
            for k in range(widths.size):
                if widths[k] == wide and 0 <= row + k - reach < rows:
                    source = values[row + k - reach]
                    for col in range(cols):
                        middle[col] += source[col]
            left, right = column[reach - wide :], column[reach + wide :]
            fraction = np.float32(1.0 if wide else 0.0)
            for col in range(cols):
                out[col] += left[col] + fraction * right[col]


def distance(raster: ElevationRaster, position_odom: Array, reach_m: float) -> Float32:
    """Eq. 18: straight-line distance from the vehicle as a proxy for energy, 1 at the nearest cell
    and 0 at the farthest; NaN beyond ``reach_m``, the range of the remaining energy."""
    x, y = (axis.astype(np.float32) for axis in raster.offsets_from(position_odom[:2]))
    reach = np.float32(min(reach_m, 1e9))
    up = raster.height - np.float32(position_odom[2])
    level = (x**2)[None, :] + (y**2)[:, None]
    metres = np.where(level <= reach * reach, np.sqrt(level + up * up), np.float32(np.nan))
    near, far = np.nanmin(metres, initial=np.inf), np.nanmax(metres, initial=-np.inf)
    return np.float32(1.0) - (metres - near) / max(far - near, np.float32(1e-6))
