"""Speed of site selection on the map of a whole survey.

The steps of the paper's Table 7, timed one by one: those of ``landing.selection.selector`` before
the check of single sites, and the same by Open3D, SciPy and scikit-image.
"""

import json
import time
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import open3d as o3d
from numpy.typing import NDArray
from scipy import ndimage

from touchdown.estimator.api import Estimate, GridMap
from touchdown.experiments.benchmarks.posed_survey import SCAN_PERIOD_S, Surveyed, posed_survey
from touchdown.experiments.config.loading import load_config
from touchdown.experiments.errors import UsageError
from touchdown.experiments.flight.wiring import build_classifier
from touchdown.landing.api import GroundClassifier, LandingParams
from touchdown.landing.classification.site_check import SiteClassCheck
from touchdown.landing.selection.clustering import bandwidths, quick_shift
from touchdown.landing.selection.costmap import c_sum, distance, flatness_of, smoothness_of
from touchdown.landing.selection.ground.elevation_raster import observed_raster
from touchdown.landing.selection.ground.landable import ground_planes
from touchdown.sim.api import Observation, SensorRig
from touchdown.sim.typing import Array, Float32

PATCHES, PATCH_PX = 10, 128
"""number and side of the images that the time of classification is measured with"""
STAGES = ("down_sampling", "flatness", "smoothness", "distance", "clustering")


def bench_landing(
    *,
    scene: str = "crossroad",
    seed: int = 0,
    rounds: int = 9,
    reference: bool = True,
    network: Path | None = None,
    threads: int = 2,
) -> dict[str, Any]:
    """Maps a scene with every scan of the survey and measures the time of the selection, one
    thread.

    ``stage_ms``: the steps of the paper's Table 7 and their ``sum``; ``selection``: the whole
    decision of the lander, geometric check included; ``reference_ms``: the same steps by Open3D,
    SciPy and scikit-image; ``ratio.reference``: its sum over ours. Medians over ``rounds``, after
    one to warm up; the reference runs once warm. ``classifier_ms``: see `_classifier_figures`,
    where ``network`` is given or comes with the project; it works on ``threads``. Raises UsageError
    and ValueError as `load_config`, `build_classifier` and `build_scene`."""
    if reference and find_spec("skimage") is None:
        raise UsageError("the comparison needs scikit-image: install it, or give --no-reference")
    overrides = ["sim.threads=1", f"landing.classifier_threads={threads}"]
    if network is not None:
        overrides.append(f"landing.classifier={json.dumps(str(network))}")
    config = load_config(
        None, overrides, profile_default="ideal",
        scene=scene, seed=seed, estimator="oracle", record=False,
    )  # fmt: skip
    classifier = build_classifier(config)
    checks: list[SiteClassCheck] = []

    def remember(rig: SensorRig, obs: Observation, estimate: Estimate) -> None:
        assert classifier is not None
        if not checks:
            checks.append(SiteClassCheck(classifier, rig, config.landing))
        checks[0].images.update(obs, estimate)

    watch = None if classifier is None else remember
    surveyed = posed_survey(config, period_s=SCAN_PERIOD_S, watch=watch)
    view, estimate = surveyed.map_view, surveyed.estimate
    position = estimate.odom_from_body.translation
    radius_m = surveyed.survey.rig.vehicle.footprint_radius_m
    laps: dict[str, list[float]] = {}
    for number in range(rounds + 1):
        ours = staged_selection(view.coarse, position, config.landing, radius_m)
        started = time.perf_counter()
        selection = surveyed.survey.select(view, estimate)
        spent = ours.seconds | {
            "sum": sum(ours.seconds.values()),
            "selection": time.perf_counter() - started,
        }
        if number > 0:
            for name, seconds in spent.items():
                laps.setdefault(name, []).append(seconds)
    stage_ms = {name: 1e3 * float(np.median(walls)) for name, walls in laps.items()}
    figures: dict[str, Any] = {
        "scene": scene,
        "seed": seed,
        "cells": list(ours.total.shape),
        "clusters": len(ours.modes),
        "candidates": len(selection.candidates),
        "stage_ms": stage_ms,
    }
    if classifier is not None:
        figures |= _classifier_figures(classifier, checks[0], surveyed, rounds)
        figures["classifier_threads"] = threads
    if reference:
        for _ in range(2):
            other = reference_selection(view.coarse, position, config.landing, radius_m)
        sums = other.seconds | {"sum": sum(other.seconds.values())}
        figures["reference_ms"] = {name: 1e3 * seconds for name, seconds in sums.items()}
        figures["ratio"] = {"reference": figures["reference_ms"]["sum"] / stage_ms["sum"]}
    return figures


def _classifier_figures(
    classifier: GroundClassifier, check: SiteClassCheck, surveyed: Surveyed, rounds: int
) -> dict[str, Any]:
    """Returns ``classifier_ms.ten_patches``: milliseconds to classify ten images of 128 x 128,
    scaling included; ``classifier_ms.selection``: of a whole decision, in which sites are
    classified best first until one is safe; ``classified_sites``: their number."""
    rng = np.random.default_rng(0)
    patches = rng.integers(0, 256, (PATCHES, PATCH_PX, PATCH_PX, 3), dtype=np.uint8)
    size = (classifier.image_size, classifier.image_size)
    walls: dict[str, list[float]] = {"ten_patches": [], "selection": []}
    for _ in range(rounds + 1):
        started = time.perf_counter()
        scaled = [cv2.resize(patch, size, interpolation=cv2.INTER_AREA) for patch in patches]
        classifier.classify(np.stack(scaled))
        walls["ten_patches"].append(time.perf_counter() - started)
        started = time.perf_counter()
        selection = surveyed.survey.select(surveyed.map_view, surveyed.estimate)
        judged = check.judge(selection.candidates, surveyed.map_view, selection=selection)
        walls["selection"].append(time.perf_counter() - started)
    asked = sum(
        after is not before for before, after in zip(selection.candidates, judged, strict=True)
    )
    medians = {name: 1e3 * float(np.median(taken[1:])) for name, taken in walls.items()}
    return {"classifier_ms": medians, "classified_sites": asked}


@dataclass(frozen=True, kw_only=True, slots=True)
class Staged:
    """Costs and clusters of the observed part of a map, with the time of each step."""

    total: Float32
    """C_sum (Eq. 13), (rows, cols), NaN unknown"""
    modes: NDArray[np.int32]
    """(K, 2) row, col"""
    seconds: dict[str, float]
    """by step of ``STAGES``"""


class StageTimer:
    """Measures the seconds from one ``lap`` to the next."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        """Stores the time since the last call as that of the step ``name``."""
        now = time.perf_counter()
        self.seconds[name] = now - self._last
        self._last = now


def staged_selection(
    grid: GridMap, position_odom: Array, params: LandingParams, footprint_radius_m: float
) -> Staged:
    """Computes costs and modes for a vehicle at ``position_odom`` (3,). Raises ValueError for an
    empty map."""
    timer = StageTimer()
    raster = observed_raster(grid)
    if raster is None:
        raise ValueError("the map is empty: there is nothing to select from")
    timer.lap("down_sampling")
    planes = ground_planes(raster, params)
    flat = flatness_of(raster, planes, params)
    timer.lap("flatness")
    smooth = smoothness_of(raster, params)
    timer.lap("smoothness")
    near = distance(raster, position_odom, np.inf)
    timer.lap("distance")
    total = c_sum(smooth, flat, near, params)
    bandwidth, radius = bandwidths(footprint_radius_m / raster.cell_m, params)
    clusters = quick_shift(total, bandwidth_cells=bandwidth, radius_cells=radius)
    timer.lap("clustering")
    return Staged(
        total=total,
        modes=clusters.modes,
        seconds=timer.seconds,
    )


def reference_selection(
    grid: GridMap, position_odom: Array, params: LandingParams, footprint_radius_m: float
) -> Staged:
    """Computes `staged_selection` with the corrected form of flatness by Open3D, SciPy and
    scikit-image, which must be installed."""
    cell = grid.cell_m
    timer = StageTimer()
    cloud, shape, cells = _down_sampled(grid)
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
        total=total.astype(np.float32),
        modes=modes,
        seconds=timer.seconds,
    )


class _DownSampled(NamedTuple):
    """Points of a map and the raster around them."""

    cloud: o3d.geometry.PointCloud
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
    return _DownSampled(cloud, shape, (row, col))


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
    from skimage.feature import canny

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
    from skimage.segmentation import quickshift

    picture = np.nan_to_num(total)[..., None].repeat(3, axis=2)
    labels = quickshift(picture, kernel_size=bandwidth, max_dist=radius, convert2lab=False, rng=0)
    inside = np.isfinite(total)
    cells = np.flatnonzero(inside)
    order = cells[np.lexsort((cells, -total.ravel()[cells]))]
    _, first = np.unique(labels.ravel()[order], return_index=True)
    best = order[np.sort(first)]
    return np.column_stack(np.divmod(best, total.shape[1])).astype(np.int32)
