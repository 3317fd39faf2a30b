"""Facts that decide if a survey can be flown over a scene: take-off spot, ground, obstacles,
classes, safe area in view; and the difference between two seeds of a scene."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from touchdown.scenes.api import LAND_CLASSES, Array, Scene
from touchdown.scenes.truth.maps import truth_maps
from touchdown.scenes.truth.static_surface import cast_down, class_ids

CELL_M = 0.5
_AROUND_M = (4.0, 12.0)
"""distances from the take-off spot between which the surrounding ground is sampled"""
_CLEAR_OF_LEGS_M = 3.0
"""objects this near to the legs' rectangle count as obstacles"""


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneFacts:
    """Facts of one scene for one survey."""

    takeoff_xy_m: tuple[float, float]
    takeoff_yaw_deg: float
    origin_m: tuple[float, float, float]
    """of the world's origin in the coordinates of the scene's file"""
    takeoff_geom: str
    """geom below the vehicle"""
    takeoff_class: str
    """its land class, or ``other``"""
    takeoff_above_m: float
    """height above the surrounding ground (median)"""
    legs_fraction: float
    """fraction of the legs' rectangle with ground below"""
    seen_fraction: float
    """the same for the area in view of the sensors"""
    highest_m: float
    """the highest object within `_CLEAR_OF_LEGS_M` of that rectangle, above the take-off spot"""
    without_class: tuple[str, ...]
    """names of geoms that count as ``other``"""
    untouchable: tuple[str, ...]
    """names of geoms below the legs, water and trees aside, that are seen from above and do not
    collide: a vehicle sinks through them"""
    guessed: tuple[tuple[str, str, str], ...]
    """name, class and reason of geoms whose class is guessed"""
    dressed: tuple[str, ...]
    """names of geoms of featureless ground that were given texture and relief"""


@dataclass(frozen=True, kw_only=True, slots=True)
class SurveyGround:
    """Ground around a take-off spot, in its axes."""

    local: Array
    """(rows, cols, 2) metres along and to the left of the take-off heading"""
    height_m: Array
    """(rows, cols) above the take-off spot; NaN where there is none"""

    def fraction(self, length_m: float, width_m: float) -> float:
        """Fraction of the legs' rectangle with ground below."""
        inside = _distance_from_box(self.local, length_m, width_m) == 0.0
        return float(np.isfinite(self.height_m[inside]).mean())

    def turns_fraction(self, length_m: float, legs: int, spacing_m: float, room_m: float) -> float:
        """Fraction of the turns with ground below: half circles, ``room_m`` wider than they are
        flown, at the far end of the first leg, at the near end of the second, and so on."""
        along, left = np.moveaxis(self.local, -1, 0)
        inside = np.zeros(along.shape, bool)
        for turn in range(legs - 1):
            beyond = -along if turn % 2 else along - length_m
            aside = left - (turn + 0.5) * spacing_m
            inside |= (beyond > 0.0) & (np.hypot(beyond, aside) <= 0.5 * spacing_m + room_m)
        return float(np.isfinite(self.height_m[inside]).mean()) if inside.any() else 1.0

    def highest_m(self, length_m: float, width_m: float) -> float:
        """The highest object within 3 m of that rectangle, above the take-off spot."""
        near = _distance_from_box(self.local, length_m, width_m) <= _CLEAR_OF_LEGS_M
        return float(np.nanmax(self.height_m[near]))


def survey_ground(scene: Scene, length_m: float, width_m: float) -> SurveyGround:
    """Samples the ground below legs of up to ``length_m`` that cover up to ``width_m``."""
    local, heights, _ = _around_the_legs(scene, np.array([length_m, width_m]), _AROUND_M[1])
    start = np.argmin(np.hypot(*np.moveaxis(local, -1, 0)))
    return SurveyGround(local=local, height_m=heights - float(heights.flat[start]))


def scene_facts(
    scene: Scene, length_m: float, width_m: float, reach_ahead_m: float, reach_aside_m: float
) -> SceneFacts:
    """Samples a scene around legs of ``length_m`` along the take-off heading that start at the
    take-off spot and cover ``width_m`` to the left of it, with a sensor that reaches
    ``reach_ahead_m`` fore and aft and ``reach_aside_m`` to both sides."""
    local, heights, geoms = _around_the_legs(
        scene, np.array([length_m, width_m]), max(reach_ahead_m, reach_aside_m, _AROUND_M[1])
    )
    far = _distance_from_box(local, length_m, width_m)
    ground = np.isfinite(heights)
    seen = (np.abs(local[..., 0] - 0.5 * length_m) <= 0.5 * length_m + reach_ahead_m) & (
        np.abs(local[..., 1] - 0.5 * width_m) <= 0.5 * width_m + reach_aside_m
    )
    start = np.argmin(np.hypot(*np.moveaxis(local, -1, 0)))
    level = float(heights.flat[start])
    distance = np.hypot(local[..., 0], local[..., 1])
    around = ground & (distance >= _AROUND_M[0]) & (distance <= _AROUND_M[1])
    name = scene.model.geom(int(geoms.flat[start])).name
    x, y = scene.takeoff_xy_m.tolist()
    return SceneFacts(
        takeoff_xy_m=(x, y),
        takeoff_yaw_deg=float(np.rad2deg(scene.takeoff_yaw)),
        origin_m=(*scene.origin_m.tolist(),),
        takeoff_geom=name,
        takeoff_class=scene.surfaces[name].land_class if name in scene.surfaces else "other",
        takeoff_above_m=level - float(np.median(heights[around])) if around.any() else 0.0,
        legs_fraction=float(ground[far == 0.0].mean()),
        seen_fraction=float(ground[seen].mean()),
        highest_m=float(heights[ground & (far <= _CLEAR_OF_LEGS_M)].max()) - level,
        untouchable=_untouchable(scene, geoms[ground & (far == 0.0)]),
        without_class=tuple(
            geom for geom, surface in scene.surfaces.items()
            if surface.land_class not in LAND_CLASSES
        ),
        guessed=tuple((geom, *found) for geom, found in scene.inferred.items()),
        dressed=scene.textured,
    )  # fmt: skip


def _untouchable(scene: Scene, geoms: NDArray[np.int32]) -> tuple[str, ...]:
    model = scene.model
    seen = [g for g in np.unique(geoms).tolist() if not model.geom_contype[g]]
    names = [model.geom(geom).name for geom in seen]
    return tuple(
        name
        for name in names
        if name not in scene.surfaces or scene.surfaces[name].land_class not in ("water", "trees")
    )


def _around_the_legs(
    scene: Scene, size_m: Array, margin_m: float
) -> tuple[Array, Array, NDArray[np.int32]]:
    """Cells around the legs' rectangle, one with its centre on the take-off spot: (rows, cols, 2)
    coordinates along and to the left of the take-off heading, heights and geoms."""
    c, s = np.cos(scene.takeoff_yaw), np.sin(scene.takeoff_yaw)
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]) * size_m
    world = corners @ np.array([[c, s], [-s, c]])
    before = np.ceil((margin_m - world.min(axis=0)) / CELL_M).astype(int)
    after = np.ceil((margin_m + world.max(axis=0)) / CELL_M).astype(int)
    cols, rows = before + after + 1
    origin = scene.takeoff_xy_m - (before + 0.5) * CELL_M
    heights, geoms = cast_down(scene, origin, CELL_M, (int(rows), int(cols)))
    row, col = np.indices(heights.shape)
    offset = np.stack([col - before[0], row - before[1]], axis=-1) * CELL_M
    return np.stack([offset @ [c, s], offset @ [-s, c]], axis=-1), heights, geoms


def _distance_from_box(local: Array, length_m: float, width_m: float) -> Array:
    """(rows, cols) metres from the rectangle of the legs, 0 inside."""
    beyond = np.maximum(-local, local - [length_m, width_m]).max(axis=-1)
    return np.maximum(beyond, 0.0)


TRUTH_CELL_M = 0.2
LAYOUT_CELL_M = 0.5
LAYOUT_PIXELS = 192


@dataclass(frozen=True, kw_only=True, slots=True)
class SurveyFacts:
    """Safe area of one seed of a scene."""

    seen_m2: float
    """area that the survey sees, inside the scene"""
    safe_fraction: float
    """of that area, touchdown points that are safe"""
    safe_geometry_fraction: float
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
    class_fraction: float
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
        safe_fraction=float(safe.sum() / seen.sum()),
        safe_geometry_fraction=float((maps.safe_geometry & seen).sum() / seen.sum()),
        safe_sites=int(ndimage.label(safe)[1]),
        takeoff_safe=bool(maps.safe[start[1], start[0]]),
    )


def layout_rasters(scene: Scene) -> LayoutRasters:
    """Samples a scene at the resolution of the comparison."""
    from touchdown.scenes.render import render_scene  # a landing needs none

    low, high = scene.bounds_xy_m
    cells = np.round((high - low) / LAYOUT_CELL_M).astype(int)
    heights, geoms = cast_down(scene, low, LAYOUT_CELL_M, (int(cells[1]), int(cells[0])))
    image = render_scene(scene, "above", LAYOUT_PIXELS)
    return LayoutRasters(
        height_m=heights.astype(np.float32),
        class_id=class_ids(scene, low, LAYOUT_CELL_M, heights, geoms),
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
        class_fraction=float((a.class_id != b.class_id).mean()),
        grey=float(np.abs(a.grey - b.grey).mean()),
    )
