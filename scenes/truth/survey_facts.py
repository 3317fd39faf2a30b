"""Safe area in view of a survey, and the difference between two seeds of a scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from touchdown.scenes.api import Scene
from touchdown.scenes.render import render_scene
from touchdown.scenes.truth.maps import truth_maps
from touchdown.scenes.truth.raycast import cast_down, class_ids

TRUTH_CELL_M = 0.2
LAYOUT_CELL_M = 0.5
LAYOUT_PIXELS = 192


@dataclass(frozen=True, kw_only=True, slots=True)
class SurveyFacts:
    """Safe area of one seed of a scene."""

    seen_m2: float
    """area that the survey sees, inside the scene"""
    safe_share: float
    """of that area, touchdown points that are safe"""
    safe_geometry_share: float
    """the same by geometry alone, whatever the class"""
    safe_sites: int
    """connected safe areas in it"""
    takeoff_safe: bool
    """the take-off spot itself is a safe touchdown point"""


@dataclass(frozen=True, kw_only=True, slots=True)
class LayoutRasters:
    """Coarse rasters of a scene, compared between seeds, world frame, row = y."""

    height_m: NDArray[np.float32]
    """(rows, cols) of the top surface, NaN where there is none"""
    class_id: NDArray[np.uint8]
    """(rows, cols)"""
    grey: NDArray[np.float32]
    """(pixels, pixels) 0..255, image from above"""


@dataclass(frozen=True, kw_only=True, slots=True)
class LayoutDifference:
    """Difference between two layouts."""

    height_m: float
    """mean absolute difference of the top surface"""
    class_share: float
    """of the cells, those whose class differs"""
    grey: float
    """mean absolute difference of the images from above, 0..255"""


def survey_facts(
    scene: Scene, length_m: float, width_m: float, reach_ahead_m: float, reach_aside_m: float
) -> SurveyFacts:
    """Judges the area in view from legs of ``length_m`` along the take-off heading that start at
    the take-off spot and cover ``width_m`` to the left of it, with a sensor that reaches
    ``reach_ahead_m`` fore and aft and ``reach_aside_m`` to both sides."""
    corners = np.array(
        [
            [x, y]
            for x in (-reach_ahead_m, length_m + reach_ahead_m)
            for y in (-reach_aside_m, width_m + reach_aside_m)
        ]
    )
    c, s = np.cos(scene.takeoff_yaw), np.sin(scene.takeoff_yaw)
    world = corners @ np.array([[c, s], [-s, c]]) + scene.takeoff_xy_m
    region = np.array([world.min(axis=0), world.max(axis=0)])
    region = np.clip(region, *scene.bounds_xy_m)
    maps = truth_maps(scene, TRUTH_CELL_M, region)
    rows, cols = np.indices(maps.safe.shape)
    centres = maps.origin_xy_m + (np.stack([cols, rows], axis=-1) + 0.5) * maps.cell_m
    offset = centres - scene.takeoff_xy_m
    local = np.stack([offset @ [c, s], offset @ [-s, c]], axis=-1)
    seen = ((local >= corners.min(axis=0)) & (local <= corners.max(axis=0))).all(axis=-1)
    safe = maps.safe & seen
    start = np.floor((scene.takeoff_xy_m - maps.origin_xy_m) / maps.cell_m).astype(int)
    return SurveyFacts(
        seen_m2=float(seen.sum()) * maps.cell_m**2,
        safe_share=float(safe.sum() / seen.sum()),
        safe_geometry_share=float((maps.safe_geometry & seen).sum() / seen.sum()),
        safe_sites=int(ndimage.label(safe)[1]),
        takeoff_safe=bool(maps.safe[start[1], start[0]]),
    )


def layout_rasters(scene: Scene) -> LayoutRasters:
    """Samples a scene at the resolution of the comparison."""
    low, high = scene.bounds_xy_m
    cells = np.round((high - low) / LAYOUT_CELL_M).astype(int)
    heights, geoms = cast_down(scene, low, LAYOUT_CELL_M, (int(cells[1]), int(cells[0])))
    image = render_scene(scene, "above", LAYOUT_PIXELS)
    return LayoutRasters(
        height_m=heights.astype(np.float32),
        class_id=class_ids(scene, low, LAYOUT_CELL_M, geoms),
        grey=image.mean(axis=2, dtype=np.float32),
    )


def layout_difference(a: LayoutRasters, b: LayoutRasters) -> LayoutDifference:
    """Compares two seeds of a scene. Raises ValueError if their extents differ."""
    if a.height_m.shape != b.height_m.shape:
        raise ValueError(
            f"two seeds differ in extent: {a.height_m.shape} and {b.height_m.shape} cells"
        )
    step = np.abs(a.height_m - b.height_m)
    known = np.isfinite(step)
    return LayoutDifference(
        height_m=float(step[known].mean()) if known.any() else 0.0,
        class_share=float((a.class_id != b.class_id).mean()),
        grey=float(np.abs(a.grey - b.grey).mean()),
    )
