"""The cost energy map of Zou, Sun, Kong 2024, section 4.1, one function for each equation.

Every term is normalised to [0, 1], higher is better; NaN is unknown. Flatness has two forms:
``literal`` follows Eqs. 16 and 17 (kernel centred on the mean angle, sum over the disc), which
rewards the average slope and the point density; ``corrected`` centres the kernel on level ground
and takes the mean per cell."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.landing.api import CostmapView, LandingParams
from touchdown.landing.selection.elevation_raster import ElevationRaster, PlaneField, distance_to

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

_SMALL_HOLE_CELLS = 4


def colour_edges(
    rgb: Float32, *, blur_cells: float, low: float, high: float
) -> tuple[NDArray[np.uint8], Mask]:
    """Canny(x) of Eq. 14 on the orthographic colour map after a Gaussian filter.

    ``rgb`` (rows, cols, 3), 0..255, NaN uncoloured. Returns the binary edges (1 = edge) and the
    mask of coloured cells. The filter averages coloured cells only, so small holes cause no edges;
    larger holes count as edges, since their content is unknown.
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
    large = stats[:, cv2.CC_STAT_AREA] > _SMALL_HOLE_CELLS
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


def normal_angles(planes: PlaneField) -> Float32:
    """Eq. 15: angle in radians between the surface normal and the vertical."""
    return planes.angle_rad


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
    reach = int(radius_m / cell_m)
    offset = np.arange(-reach, reach + 1)
    disc = (offset[:, None] ** 2 + offset[None, :] ** 2 <= (radius_m / cell_m) ** 2).astype(float)
    values = np.where(np.isfinite(kernel), kernel, np.float32(0.0))
    if form == "literal":
        values = values * count
    total = cv2.filter2D(values.astype(np.float32), cv2.CV_32F, disc.astype(np.float32),
                         borderType=cv2.BORDER_CONSTANT)  # fmt: skip
    scale = float(total.max()) if form == "literal" else float(disc.sum())
    cost = np.clip(total / max(scale, 1e-9), 0.0, 1.0)
    return np.where(np.isfinite(kernel), cost, np.nan).astype(np.float32)


def distance(raster: ElevationRaster, position_odom: Array, reach_m: float) -> Float32:
    """Eq. 18: straight-line distance from the vehicle as a proxy for energy, 1 at the nearest cell
    and 0 at the farthest; NaN beyond ``reach_m``, the range of the remaining energy."""
    x, y = (axis.astype(np.float32) for axis in raster.offsets_from(position_odom[:2]))
    z = raster.height - np.float32(position_odom[2])
    horizontal = (x**2)[None, :] + (y**2)[:, None]
    metres = np.sqrt(horizontal + z**2)
    allowed = np.isfinite(metres) & (horizontal <= np.float32(min(reach_m, 1e9)) ** 2)
    if not allowed.any():
        return np.full(raster.shape, np.nan, np.float32)
    near, far = float(metres[allowed].min()), float(metres[allowed].max())
    cost = 1.0 - (metres - near) / max(far - near, 1e-6)
    return np.where(allowed, cost, np.nan).astype(np.float32)


def weighted_sum(smooth: Float32, flat: Float32, near: Float32, params: LandingParams) -> Float32:
    """Eq. 13, with the largest weight on flatness; NaN where any term is NaN."""
    first, second, third = weighted_terms(smooth, flat, near, params)
    return (first + second + third).astype(np.float32)


def weighted_terms(
    smooth: Float32, flat: Float32, near: Float32, params: LandingParams
) -> tuple[Float32, Float32, Float32]:
    """Returns the terms of Eq. 13 in the order of the arguments."""
    return (
        params.weight_smoothness * smooth,
        params.weight_flatness * flat,
        params.weight_distance * near,
    )


def smoothness_term(raster: ElevationRaster, params: LandingParams) -> tuple[Float32, Mask]:
    """Returns Eq. 14 of a raster and the mask of its coloured cells."""
    edges, coloured = colour_edges(
        raster.rgb,
        blur_cells=params.edge_blur_m / raster.cell_m,
        low=params.edge_low,
        high=params.edge_high,
    )
    return smoothness(edges, coloured, raster.cell_m, params.smoothness_full_m), coloured


def flatness_term(raster: ElevationRaster, planes: PlaneField, params: LandingParams) -> Float32:
    """Returns Eqs. 15 to 17 of a raster with the planes of its cells."""
    angles = np.where(raster.known, normal_angles(planes), np.float32(np.nan))
    form = params.flatness_form
    kernel = flatness_kernel(angles, form=form, sigma_rad=np.deg2rad(params.flatness_sigma_deg))
    return flatness(
        kernel, raster.count, form=form, radius_m=params.clear_radius_m, cell_m=raster.cell_m
    )


def compute_costmap(
    raster: ElevationRaster,
    planes: PlaneField,
    position_odom: Array,
    reach_m: float,
    params: LandingParams,
) -> CostmapView:
    """Returns all terms of ``raster`` with the planes of its cells, for a vehicle at
    ``position_odom`` (3,). ``value`` and ``allowed`` are those of C_sum by itself."""
    smooth, coloured = smoothness_term(raster, params)
    flat = flatness_term(raster, planes, params)
    near = distance(raster, position_odom, reach_m)
    total = weighted_sum(smooth, flat, near, params)
    return CostmapView(
        origin_xy_m=raster.origin_xy_m,
        cell_m=raster.cell_m,
        total=total,
        flatness=flat,
        smoothness=smooth,
        distance=near,
        rgb=np.where(coloured[..., None], raster.rgb, np.float32(0.0)).astype(np.uint8),
        value=total,
        allowed=np.isfinite(total),
    )
