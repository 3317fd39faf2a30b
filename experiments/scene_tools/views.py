"""Renderings, true maps and sensor views of a scene, as (H, W, 3) RGB arrays."""

from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.config.schema import Config
from touchdown.experiments.drawing.map_images import survey_marks
from touchdown.experiments.drawing.style import framed_map
from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.run_directory import whole_file
from touchdown.experiments.scene_tools.posed_views import HoverView, hover_view
from touchdown.scenes.api import (
    CLASS_RGB,
    LAND_CLASSES,
    OTHER_CLASS_ID,
    Array,
    Image,
    Scene,
    TruthMaps,
)
from touchdown.scenes.render import render_scene
from touchdown.scenes.truth.maps import truth_maps as scene_truth_maps

HOVER_HEIGHT_M = 30.0
LIDAR_SECONDS = 1.0
_MAP_PIXELS = 1000
_FINEST_CELL_M, _COARSEST_CELL_M = 0.1, 0.25
_STEEPEST_DEG = 20.0
_BRIGHTEST = 100.0
"""LIDAR intensity of a white surface: reflectivity in percent"""
_SUN = np.array([-0.5, 0.5, 0.7]) / np.linalg.norm([-0.5, 0.5, 0.7])
_RELIEF_GAIN = 2.0
_STRIP_PIXELS = 46
_INK, _PAPER = (235, 235, 235), 24
ABOVE_HALF_SPANS = 0.51
"""Half the width of level ground at height 0 in the image from above, in spans of the scene"""
_LIDAR_ASIDE_M, _LIDAR_AHEAD_M = 28.0, 10.0
"""Half the area that is drawn: the view of a Livox Horizon 30 m above level ground, with a margin
"""
_LIDAR_PIXELS_PER_M = 28.0
_DOT_PIXELS = 4


class SceneViews:
    """All views of one scene. Data that several of them share are computed once, on demand."""

    def __init__(self, scene: Scene, config: Config) -> None:
        self._scene, self._config = scene, config

    def draw(self, view: str) -> Image:
        """(H, W, 3) RGB of a view named in `VIEWS`."""
        return VIEWS[view](self)

    def framed(self, view: str, image: Image) -> Image:
        """An image of `draw`; a map with ticks in metres around it, the take-off spot and the
        rectangle of the survey's legs."""
        if view not in MAP_VIEWS:
            return image
        drawn, key = image, None
        if view == "above":
            low, high = self._scene.bounds_xy_m
            half = ABOVE_HALF_SPANS * float((high - low).max())
            west, south = (0.5 * (low + high) - half).tolist()
            across_m = 2.0 * half
        else:
            drawn, key = image[:-_STRIP_PIXELS], image[-_STRIP_PIXELS:]
            west, south = self.truth.origin_xy_m.tolist()
            across_m = self.truth.cell_m * self.truth.class_id.shape[1]
        extent = (west, west + across_m, south, south + across_m * drawn.shape[0] / drawn.shape[1])
        scene = self._scene
        marks = survey_marks(scene.takeoff_xy_m, scene.takeoff_yaw, self._config.survey)
        done = framed_map(drawn, extent, marks, MAP_WORDS)
        if key is None:
            return done
        wide = np.full((key.shape[0], done.shape[1], 3), _PAPER, np.uint8)
        wide[:, : key.shape[1]] = key[:, : done.shape[1]]
        return np.vstack([done, wide])

    @cached_property
    def truth(self) -> TruthMaps:
        """The true maps, in cells that give a readable image."""
        span = float(np.ptp(self._scene.bounds_xy_m, axis=0).max())
        cell = float(np.clip(span / 800.0, _FINEST_CELL_M, _COARSEST_CELL_M))
        return scene_truth_maps(self._scene, cell)

    def above(self) -> Image:
        return render_scene(self._scene, "above")

    def oblique(self) -> Image:
        return render_scene(self._scene, "oblique")

    def camera(self) -> Image:
        return self._hover.rgb

    def depth(self) -> Image:
        """Near is red, far is blue, between the extremes of this image."""
        depth = self._hover.depth_m
        seen = depth[np.isfinite(depth)]
        low, high = _span(seen, 0.1, 99.9)
        image = _coloured((high - depth) / (high - low), cv2.COLORMAP_TURBO)
        image[~np.isfinite(depth)] = 0
        return _with_scale(image, cv2.COLORMAP_TURBO, f"{high:.1f} m deep", f"{low:.1f} m")

    def lidar(self) -> Image:
        """Returns of one second from above, the vehicle's heading up, on black."""
        points, intensity = self._hover.points_world, self._hover.intensity
        c, s = np.cos(self._scene.takeoff_yaw), np.sin(self._scene.takeoff_yaw)
        order = np.argsort(points[:, 2], kind="stable")  # what is higher hides what is lower
        offset = points[order, :2] - self._scene.takeoff_xy_m
        right, ahead = offset @ [s, -c], offset @ [c, s]
        col = np.floor((right + _LIDAR_ASIDE_M) * _LIDAR_PIXELS_PER_M).astype(int)
        row = np.floor((_LIDAR_AHEAD_M - ahead) * _LIDAR_PIXELS_PER_M).astype(int)
        height = int(2.0 * _LIDAR_AHEAD_M * _LIDAR_PIXELS_PER_M)
        width = int(2.0 * _LIDAR_ASIDE_M * _LIDAR_PIXELS_PER_M)
        image = np.zeros((height, width, 3), np.uint8)
        colours = _coloured(intensity[order, None] / _BRIGHTEST, cv2.COLORMAP_TURBO)[:, 0]
        dot = np.arange(_DOT_PIXELS) - _DOT_PIXELS // 2
        for down, across in np.stack(np.meshgrid(dot, dot), axis=-1).reshape(-1, 2):
            y, x = row + down, col + across
            inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
            image[y[inside], x[inside]] = colours[inside]
        return _with_scale(image, cv2.COLORMAP_TURBO, "intensity 0", f"{_BRIGHTEST:.0f}")

    def height(self) -> Image:
        """Heights in colour, shaded by a low sun in the north-west."""
        heights = self.truth.height_m
        low, high = _span(heights[np.isfinite(heights)], 0.5, 99.0)
        tint = _coloured((heights - low) / (high - low), cv2.COLORMAP_PARULA).astype(float)
        image = (tint * self._shade[:, :, None]).clip(0, 255).astype(np.uint8)
        image[~np.isfinite(heights)] = 0
        return _with_scale(
            _north_up(image), cv2.COLORMAP_PARULA, f"height {low:.1f} m", f"{high:.1f} m"
        )

    def slope(self) -> Image:
        slope = self.truth.slope_deg
        image = _coloured(slope / _STEEPEST_DEG, cv2.COLORMAP_INFERNO)
        image[~np.isfinite(slope)] = 0
        return _with_scale(
            _north_up(image), cv2.COLORMAP_INFERNO, "slope 0 deg", f"{_STEEPEST_DEG:.0f} deg"
        )

    def land_class(self) -> Image:
        table = np.zeros((256, 3), np.uint8)
        table[:] = CLASS_RGB["other"]
        for index, name in enumerate(LAND_CLASSES):
            table[index] = CLASS_RGB[name]
        ids = self.truth.class_id
        colours = table[ids] * (0.45 + 0.55 * self._shade.clip(0, 1.2)[:, :, None])
        present = [name for i, name in enumerate(LAND_CLASSES) if (ids == i).any()]
        present += ["other"] if (ids == OTHER_CLASS_ID).any() else []
        key = [(name, CLASS_RGB[name]) for name in present]
        return _with_key(_north_up(colours.clip(0, 255).astype(np.uint8)), key)

    def safe(self) -> Image:
        """Green: a touchdown here is safe; yellow: level and clear, but of no safe class."""
        truth = self.truth
        grey = (150.0 * self._shade.clip(0, 1.3))[:, :, None]
        key = {"safe": (70, 200, 90), "level and clear only": (225, 190, 60)}
        image = np.repeat(grey, 3, axis=2)
        only = truth.safe_geometry & ~truth.safe
        for mask, colour in ((truth.safe, key["safe"]), (only, key["level and clear only"])):
            image[mask] = 0.35 * image[mask] + 0.65 * np.array(colour)
        rest = ("not safe", (105, 105, 105))
        return _with_key(_north_up(image.clip(0, 255).astype(np.uint8)), [*key.items(), rest])

    @cached_property
    def _hover(self) -> HoverView:
        return hover_view(self._config, self._scene, HOVER_HEIGHT_M, LIDAR_SECONDS)

    @cached_property
    def _shade(self) -> Array:
        """(rows, cols) brightness about 1 of the relief under `_SUN`."""
        heights = np.nan_to_num(self.truth.height_m.astype(np.float64))
        dy, dx = np.gradient(heights, self.truth.cell_m)
        normal = np.stack([-_RELIEF_GAIN * dx, -_RELIEF_GAIN * dy, np.ones_like(dx)], axis=-1)
        light = (normal @ _SUN) / np.linalg.norm(normal, axis=-1)
        return 0.35 + 0.65 * np.clip(light, 0.0, 1.0) / _SUN[2]


VIEWS: Mapping[str, Callable[[SceneViews], Image]] = {
    "above": SceneViews.above,
    "oblique": SceneViews.oblique,
    "camera": SceneViews.camera,
    "depth": SceneViews.depth,
    "lidar": SceneViews.lidar,
    "height": SceneViews.height,
    "slope": SceneViews.slope,
    "class": SceneViews.land_class,
    "safe": SceneViews.safe,
}
"""In the order of the contact sheet."""

MAP_VIEWS = ("above", "height", "slope", "class", "safe")
MAP_WORDS = "x east, y north (m); circle: take-off and heading; dashed: the survey's legs"


def write_image(path: Path, image: Image) -> None:
    """Writes RGB to a .png or .jpg file. Raises UsageError where writing fails."""
    done, data = cv2.imencode(path.suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    if not done:
        raise UsageError(f"--out: '{path}' cannot be written as {path.suffix}")
    try:
        with whole_file(path) as partial:
            partial.write_bytes(data.tobytes())
    except OSError as error:
        raise UsageError(f"--out: '{path}' cannot be written: {error.strerror}") from error


def _span(values: NDArray[np.floating], low: float, high: float) -> tuple[float, float]:
    """Two percentiles, at least half a metre apart: level ground is of the middle colour."""
    if not values.size:
        return -0.25, 0.25
    ends = np.percentile(values, [low, high])
    half = max(0.5 * float(ends[1] - ends[0]), 0.25)
    return float(ends.mean()) - half, float(ends.mean()) + half


def _coloured(fraction: NDArray[np.floating], colormap: int) -> Image:
    """(..., 3) RGB of (H, W) values in [0, 1]; NaN as 0."""
    scaled = np.nan_to_num(255.0 * np.clip(fraction, 0.0, 1.0)).astype(np.uint8)
    return np.ascontiguousarray(cv2.applyColorMap(scaled, colormap)[..., ::-1])


def _north_up(image: Image) -> Image:
    """Rows of a raster run northwards; enlarged without blending to a common size."""
    upright = np.ascontiguousarray(image[::-1])
    zoom = _MAP_PIXELS / max(upright.shape[:2])
    size = (round(upright.shape[1] * zoom), round(upright.shape[0] * zoom))
    return np.asarray(cv2.resize(upright, size, interpolation=cv2.INTER_NEAREST), np.uint8)


def _with_scale(image: Image, colormap: int, low: str, high: str) -> Image:
    """A strip below with the colour scale from ``low`` to ``high``."""
    strip = np.full((_STRIP_PIXELS, image.shape[1], 3), _PAPER, np.uint8)
    left = 20 + _text(strip, low, 12)
    right = min(left + 360, image.shape[1] - 130)
    strip[12:34, left:right] = _coloured(np.linspace(0.0, 1.0, right - left)[None], colormap)
    _text(strip, high, right + 12)
    return np.vstack([image, strip])


def _with_key(image: Image, key: list[tuple[str, tuple[int, int, int]]]) -> Image:
    """A strip below with a coloured square and a name for each entry."""
    strip = np.full((_STRIP_PIXELS, image.shape[1], 3), _PAPER, np.uint8)
    at = 12
    for name, colour in key:
        strip[12:34, at : at + 22] = colour
        at = _text(strip, name, at + 30) + 18
    return np.vstack([image, strip])


def _text(strip: Image, text: str, left: int) -> int:
    """Writes into a strip in place and returns the column where the text ends."""
    font, size, line = cv2.FONT_HERSHEY_SIMPLEX, 0.55, 1
    cv2.putText(strip, text, (left, 29), font, size, _INK, line, cv2.LINE_AA)
    return left + int(cv2.getTextSize(text, font, size, line)[0][0])
