"""Reference implementation of ``experiments.benchmarks.selection.stages`` with Open3D, SciPy and
scikit-image.

Speed and result of the selector are compared with it. Needs scikit-image.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import open3d as o3d
from numpy.typing import NDArray
from scipy import ndimage
from skimage.feature import canny
from skimage.segmentation import quickshift

from touchdown.estimator.api import GridMap
from touchdown.experiments.benchmarks.selection.stages import Staged, StageTimer
from touchdown.landing.api import LandingParams
from touchdown.landing.selection.clustering import bandwidths

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]


def reference_selection(
    grid: GridMap, position_odom: Array, params: LandingParams, footprint_radius_m: float
) -> Staged:
    """Computes ``experiments.benchmarks.selection.stages.staged_selection`` with the corrected form
    of flatness."""
    cell = grid.cell_m
    timer = StageTimer()
    cloud, origin, shape, cells = _down_sampled(grid)
    timer.lap("down_sampling")
    flat = _flatness(cloud, cells, shape, cell, params)
    timer.lap("flatness")
    smooth = _smoothness(np.asarray(cloud.colors), cells, shape, cell, params)
    timer.lap("smoothness")
    near = _distance(np.asarray(cloud.points), position_odom, cells, shape)
    timer.lap("distance")
    weights = params.zou2024
    total = weights.weight_smoothness * smooth + weights.weight_flatness * flat
    total += weights.weight_distance * near
    modes = _modes(total, *bandwidths(footprint_radius_m / cell, params))
    timer.lap("clustering")
    return Staged(
        origin_xy_m=origin,
        cell_m=cell,
        total=total.astype(np.float32),
        modes=modes,
        seconds=timer.seconds,
    )


class _DownSampled(NamedTuple):
    """Points of a map and the raster around them."""

    cloud: o3d.geometry.PointCloud
    origin: Array
    """(2,) corner of the raster"""
    shape: tuple[int, int]
    """rows and columns of the raster"""
    cells: tuple[Array, Array]
    """row and column of each point"""


def _down_sampled(grid: GridMap) -> _DownSampled:
    """Returns one point for each voxel of one cell; a colour of -1 stands for none."""
    seen = (grid.count > 0.0) | (grid.missing > 0.0)
    known = np.isfinite(grid.height_m)
    rows, cols = np.nonzero(known)
    points = np.column_stack([
        grid.origin_xy_m[0] + (cols + 0.5) * grid.cell_m,
        grid.origin_xy_m[1] + (rows + 0.5) * grid.cell_m,
        grid.height_m[known],
    ])  # fmt: skip
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    colours = np.nan_to_num(grid.rgb[known].astype(np.float64), nan=-1.0)
    cloud.colors = o3d.utility.Vector3dVector(colours)
    cloud = cloud.voxel_down_sample(grid.cell_m)
    box = [np.flatnonzero(seen.any(axis=axis)) for axis in (1, 0)]
    first = np.array([box[1][0], box[0][0]])
    origin = grid.origin_xy_m + first * grid.cell_m
    shape = (int(box[0][-1] - box[0][0] + 1), int(box[1][-1] - box[1][0] + 1))
    col, row = np.floor((np.asarray(cloud.points)[:, :2] - origin) / grid.cell_m).astype(int).T
    return _DownSampled(cloud, origin, shape, (row, col))


def _flatness(
    cloud: o3d.geometry.PointCloud,
    spot: tuple[Array, Array],
    shape: tuple[int, int],
    cell_m: float,
    params: LandingParams,
) -> Array:
    """Eqs. 15 to 17: principal components of the neighbours, Gaussian kernel, mean of the disc."""
    reach = params.normal_half_width_m + 0.5 * cell_m
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamRadius(reach))
    angle = np.arccos(np.minimum(np.abs(np.asarray(cloud.normals)[:, 2]), 1.0))
    kernel = np.full(shape, np.nan)
    kernel[spot] = np.exp(-0.5 * (angle / np.deg2rad(params.flatness_sigma_deg)) ** 2)
    reach_cells = int(params.clear_radius_m / cell_m)
    offset = np.arange(-reach_cells, reach_cells + 1)
    disc = np.hypot(offset[:, None], offset[None, :]) <= params.clear_radius_m / cell_m
    mean = ndimage.convolve(np.nan_to_num(kernel), disc / disc.sum(), mode="constant")
    return np.where(np.isfinite(kernel), mean, np.nan)


def _smoothness(
    colours: Array,
    spot: tuple[Array, Array],
    shape: tuple[int, int],
    cell_m: float,
    params: LandingParams,
) -> Array:
    """Eq. 14: scikit-image's Canny on the orthographic image of the coloured points, and SciPy's
    distance transform."""
    grey = np.zeros(shape)
    coloured = np.zeros(shape, np.bool_)
    grey[spot] = colours @ [0.299, 0.587, 0.114]
    coloured[spot] = colours[:, 0] >= 0.0
    grey[~coloured] = 0.0
    blur = params.edge_blur_m / cell_m
    weight = ndimage.gaussian_filter(coloured.astype(float), blur, mode="mirror")
    smooth = ndimage.gaussian_filter(grey, blur, mode="mirror") / np.maximum(weight, 1e-3)
    edges = canny(
        np.clip(np.rint(smooth), 0.0, 255.0),
        sigma=0.0,
        low_threshold=params.edge_low,
        high_threshold=params.edge_high,
    )
    holes, _ = ndimage.label(~coloured)
    large = np.bincount(holes.ravel()) > 4
    large[0] = False
    edges |= large[holes]
    radius = ndimage.distance_transform_edt(~edges) * cell_m
    return np.where(coloured, np.minimum(radius / params.smoothness_full_m, 1.0), np.nan)


def _distance(
    points: Array, position: Array, spot: tuple[Array, Array], shape: tuple[int, int]
) -> Array:
    """Eq. 18."""
    metres = np.linalg.norm(points - position, axis=1)
    near = np.full(shape, np.nan)
    near[spot] = 1.0 - (metres - metres.min()) / np.ptp(metres)
    return near


def _modes(total: Array, bandwidth: float, radius: float) -> NDArray[np.int32]:
    """Eq. 19 by scikit-image: the cell of highest cost in each of its segments. Its density is
    that of the costs themselves, so its segments are not those of
    ``landing.selection.clustering``."""
    picture = np.nan_to_num(total)[..., None].repeat(3, axis=2)
    labels = quickshift(picture, kernel_size=bandwidth, max_dist=radius, convert2lab=False, rng=0)
    inside = np.isfinite(total)
    cells = np.flatnonzero(inside)
    order = cells[np.lexsort((cells, -total.ravel()[cells]))]
    _, first = np.unique(labels.ravel()[order], return_index=True)
    best = order[np.sort(first)]
    return np.column_stack(np.divmod(best, total.shape[1])).astype(np.int32)
