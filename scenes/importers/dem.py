"""Makes a scene of a digital elevation model: heights from a GeoTIFF, colours from an aerial image
or from the relief."""

import warnings
from functools import partial
from pathlib import Path

import cv2
import mujoco
import numpy as np
from scipy import ndimage

from touchdown.scenes.api import LAND_CLASSES, Array, Image
from touchdown.scenes.authoring.builder import fill_texture
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.authoring.relief import HeightField, write_hfield
from touchdown.scenes.export import export_spec
from touchdown.scenes.importers.geotiff import (
    Georeference,
    HeightRaster,
    read_georeference,
    read_heights,
)
from touchdown.scenes.importers.pictures import opened_picture
from touchdown.sim.files.child import run_limited

TEMPLATE = Path(__file__).with_name("dem.xml")
WINDOW_M = 200.0
MIN_WINDOW_M = 30.0
AHEAD_M, LEFT_M, AROUND_M = 70.0, 44.0, 8.0
"""What the survey needs ahead and to the left of the take-off spot, and behind and beside it."""
MAX_HOLES = 0.5
MAX_NODES = 1001
COARSE_M = 2.0
"""Coarser models are interpolated to this cell, smoothly."""
MAX_TEXELS = 4096
RELIEF_TEXEL_M = 0.0625
_FLAT_RADIUS_M = 2.5
_SMALLER = "cut it smaller, or store it without compression (gdal_translate)"
# Heights from low to high, and what is too steep for soil; RGB.
_LOW, _MIDDLE, _HIGH, _ROCK = (90, 98, 66), (118, 112, 78), (142, 132, 112), (116, 110, 104)


def import_dem(
    tif: Path,
    out: Path,
    *,
    ortho: Path | None = None,
    cell_m: float | None = None,
    window_m: float = WINDOW_M,
    centre_m: tuple[float, float] | None = None,
    land_class: str = "field",
) -> Path:
    """Writes the MJCF scene ``out/scene.xml`` with its assets and returns its path.

    tif: single-band GeoTIFF, north up. ortho: an aerial image of the same extent, or a GeoTIFF
    with coordinates of its own; without one the relief is coloured by height and slope. cell_m:
    node spacing of the height field [that of the model, at most 2 m]. window_m: side of the square
    that is cut out [200, or the model's extent]. centre_m: its centre, metres east and north of
    the model's south-west corner [where the fewest holes are, near the middle]. land_class: of
    the whole ground, one of `scenes.api.LAND_CLASSES`.

    Holes are filled from their rims; one warning states their fraction. The site ``takeoff`` is the
    flattest spot from which the survey stays inside; the height there is 0. Heading is east.

    Raises FileNotFoundError, and ValueError for what is not an elevation model or not an image,
    for a model below 30 m, more than half holes, or a folder that is not empty.
    """
    if land_class not in LAND_CLASSES:
        raise ValueError(f"class '{land_class}' is none of {', '.join(LAND_CLASSES)}")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ValueError(f"'{out}' exists already; name a new folder")
    raster = run_limited(lambda: read_heights(tif, centre_m, window_m), tif, "to read it", _SMALLER)
    half, step = _grid(raster, cell_m, window_m, tif)
    middle = _window_centre(raster, half, centre_m, tif)
    heights = _filled(raster, middle, half, tif)
    terrain = _resampled(heights, raster, middle, half, step)
    spot = takeoff_spot(terrain)
    level = terrain.point(*spot)
    terrain = HeightField(heights_m=terrain.heights_m - level, half_m=terrain.half_m)
    if ortho is None:
        colours = relief_texture(terrain)
    else:
        colours = run_limited(
            partial(_cut_ortho, ortho, raster, middle, terrain.half_m),
            ortho,
            "to read it",
            _SMALLER,
        )
    spec = mujoco.MjSpec.from_file(str(TEMPLATE))
    spec.modelname = tif.stem
    spec.comment = f"{tif.name}: level {level:.2f} m of the model is height 0"
    write_hfield(spec, "terrain", "terrain", terrain, base_m=2.0)
    fill_texture(spec.texture("ground"), colours)
    spec.site("takeoff").pos = [*spot, 0.0]
    # The name gives the class (`scenes.importers.mjcf.surface_of_name`).
    spec.geom("terrain").name = f"{land_class}_terrain"
    return export_spec(spec, out)


def _grid(
    raster: HeightRaster, cell_m: float | None, window_m: float, path: Path
) -> tuple[float, float]:
    """Half the window's side and the node spacing, metres."""
    native = float(raster.cell_m.min())
    step = min(native, COARSE_M) if cell_m is None else cell_m
    if not (np.isfinite(step) and step > 0.0 and np.isfinite(window_m)):
        raise ValueError(f"cell {cell_m} and window {window_m} must be lengths above 0 in metres")
    extent = (np.array(raster.heights_m.shape)[::-1] - 1) * raster.cell_m
    side = min(window_m, float(extent.min()))
    if side < MIN_WINDOW_M:
        width, height = np.round(extent, 1).tolist()
        raise ValueError(
            f"{path} covers {width} x {height} m and the window is {window_m} m: the survey needs "
            f"at least {MIN_WINDOW_M:.0f} m each way"
        )
    if cell_m is None:
        step = max(step, side / (MAX_NODES - 1))
    cells = int(0.5 * side / step + 1e-6)
    if not 8 <= cells <= MAX_NODES // 2:
        raise ValueError(
            f"cells of {step:g} m cut {side:g} m into {2 * cells} parts; choose from "
            f"{side / (MAX_NODES - 1):.2g} to {side / 16:.2g} m"
        )
    return cells * step, step


def _window_centre(
    raster: HeightRaster, half: float, centre_m: tuple[float, float] | None, path: Path
) -> Array:
    """(2,) row and column of the window's middle, a cell's centre where the file is finer than the
    scene has to be."""
    rows, cols = raster.heights_m.shape
    reach = half / raster.cell_m[::-1]
    low, high = reach, np.array([rows - 1, cols - 1]) - reach
    if centre_m is not None:
        east, north = centre_m
        south = raster.size_m[1] - north - raster.corner_m[1]
        middle = np.array([south, east - raster.corner_m[0]]) / raster.cell_m[::-1] - 0.5
        if (middle < low - 1e-6).any() or (middle > high + 1e-6).any():
            raise ValueError(
                f"a window of {2 * half:g} m around {centre_m} leaves {path}, which covers "
                f"{raster.size_m[0]:g} x {raster.size_m[1]:g} m"
            )
        # Rounded in the whole file, so that a part is cut at the same cells.
        first = raster.corner_m[::-1] / raster.cell_m[::-1]
        return np.clip(np.round(middle + first) - first, low, high)
    known = np.isfinite(raster.heights_m)
    if not known.any():
        part = raster.corner_m.any()
        where = " around its middle; choose another with --centre" if part else ""
        raise ValueError(f"{path} holds no heights: every cell is a hole{where}")
    size = tuple(2 * np.floor(reach).astype(int) + 1)
    fraction = ndimage.uniform_filter(known.astype(np.float32), size, mode="constant")
    row, col = np.indices(fraction.shape, sparse=True)
    middle = 0.5 * np.array([rows - 1, cols - 1])
    inside = (
        (row >= low[0] - 0.5) & (row <= high[0] + 0.5)
        & (col >= low[1] - 0.5) & (col <= high[1] + 0.5)
    )  # fmt: skip
    aside = np.hypot(row - middle[0], col - middle[1]) / np.hypot(*middle)
    best = np.argmax(np.where(inside, np.round(fraction, 3) - 1e-4 * aside, -np.inf))
    return np.clip(np.array(np.unravel_index(best, fraction.shape), np.float64), low, high)


def _filled(raster: HeightRaster, middle: Array, half: float, path: Path) -> Array:
    """The raster without holes in the window. Holes take the nearest height, then relax to a
    smooth skin over the hole (Laplace's equation)."""
    reach = np.ceil(half / raster.cell_m[::-1]).astype(int) + 1
    first = np.maximum(np.floor(middle).astype(int) - reach, 0)
    last = np.ceil(middle).astype(int) + reach + 1
    window = (slice(first[0], last[0]), slice(first[1], last[1]))
    heights = raster.heights_m.copy()
    part = heights[window]
    hole = np.isnan(part)
    fraction = float(hole.mean())
    if fraction > MAX_HOLES:
        raise ValueError(
            f"{path}: {100 * fraction:.0f} % of the window are holes, more than half; choose "
            "another "
            "centre or a smaller window"
        )
    if fraction > 0.0:
        warnings.warn(
            f"{path}: {100 * fraction:.2g} % of the window are holes; they are filled from their "
            "rims",
            stacklevel=4,
        )
        nearest = ndimage.distance_transform_edt(hole, return_distances=False, return_indices=True)
        part[:] = part[tuple(nearest)]
        kernel = 0.25 * np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
        for _ in range(200):
            part[hole] = ndimage.convolve(part, kernel, mode="nearest")[hole]
    return heights


def _resampled(
    heights: Array, raster: HeightRaster, middle: Array, half: float, step: float
) -> HeightField:
    """Nodes ``step`` apart, row 0 in the south; exact where nodes meet cells, averaged where nodes
    are farther apart than cells, a cubic spline where they are closer."""
    count = 2 * round(half / step) + 1
    offset = np.linspace(-half, half, count)
    rows = middle[0] - offset / raster.cell_m[1]
    cols = middle[1] + offset / raster.cell_m[0]
    known = np.where(np.isnan(heights), np.nanmean(heights), heights)
    average = np.round(step / raster.cell_m[::-1]).astype(int)
    if (average > 1).any():
        known = ndimage.uniform_filter(known, tuple(np.maximum(average, 1)), mode="nearest")
    order = 3 if step < 0.99 * float(raster.cell_m.min()) else 1
    grid = np.stack(np.meshgrid(rows, cols, indexing="ij"))
    nodes = ndimage.map_coordinates(known, grid, order=order, mode="nearest")
    return HeightField(heights_m=np.asarray(nodes, np.float64), half_m=half)


def takeoff_spot(terrain: HeightField) -> Array:
    """Returns (2,) the spot with the least relief within 2.5 m from which a survey to the east and
    north stays inside, near the one that puts the survey in the middle."""
    half = terrain.half_m
    low = np.full(2, -half + AROUND_M)
    high = np.array([half - AHEAD_M, half - LEFT_M])
    wish = np.clip([-25.0, -20.0], low, np.maximum(high, low))
    axis = np.arange(-25.0, 25.01, 0.5)
    offsets = np.stack(np.meshgrid(axis, axis), axis=-1)
    heights = terrain.at(wish + offsets)
    size = 2 * round(_FLAT_RADIUS_M / 0.5) + 1
    relief = ndimage.maximum_filter(heights, size) - ndimage.minimum_filter(heights, size)
    spots = wish + offsets
    inside = ((spots >= low) & (spots <= np.maximum(high, low))).all(axis=-1)
    cost = relief + 0.003 * np.hypot(offsets[..., 0], offsets[..., 1])
    best = np.unravel_index(int(np.argmin(np.where(inside, cost, np.inf))), cost.shape)
    return np.asarray(spots[best], np.float64)


def relief_texture(terrain: HeightField) -> Image:
    """Colours by height and slope under light from the north-west, with grain and tufts as
    visual features for a camera. (P, P, 3) uint8, top row north."""
    rng = np.random.default_rng(len(terrain.heights_m))
    pixels = min(MAX_TEXELS, round(2.0 * terrain.half_m / RELIEF_TEXEL_M))
    heights = terrain.heights_m
    north, east = np.gradient(heights, terrain.cell_m)
    slope = np.hypot(north, east)
    sun = np.array([-0.5, 0.5, 0.72]) / np.linalg.norm([0.5, 0.5, 0.72])
    shade = (sun[2] - sun[0] * east - sun[1] * north) / np.sqrt(1.0 + slope**2)
    light = np.clip(0.35 + 0.65 * shade / sun[2], 0.2, 1.25)
    low, high = np.percentile(heights, [2.0, 98.0])
    level = np.clip((heights - low) / max(high - low, 0.1), 0.0, 1.0)
    tint = np.stack(
        [
            np.interp(level, [0.0, 0.5, 1.0], ramp)
            for ramp in zip(_LOW, _MIDDLE, _HIGH, strict=True)
        ],
        axis=-1,
    )
    bare = np.clip((slope - 0.25) / 0.35, 0.0, 1.0)[..., None]
    tint = (tint + bare * (np.array(_ROCK) - tint)) * light[..., None]
    colours = cv2.resize(tint.astype(np.float32), (pixels, pixels), interpolation=cv2.INTER_LINEAR)
    per_m = pixels / (2.0 * terrain.half_m)
    shape = (pixels, pixels)
    tone = 0.10 * fractal_noise(rng, shape, 9.0 * per_m, 4, 0.7)
    tone += 0.16 * fractal_noise(rng, shape, 0.8 * per_m, 3, 0.8)
    tone += 0.07 * rng.standard_normal(shape, dtype=np.float32)
    colours *= (1.0 + tone)[..., None]
    return np.ascontiguousarray(np.clip(colours, 0.0, 255.0).astype(np.uint8)[::-1])


def _cut_ortho(path: Path, raster: HeightRaster, middle: Array, half: float) -> Image:
    """The window's part of an aerial image, square, at its own resolution up to 4096 texels."""
    with opened_picture(path) as picture:
        size = raster.size_m
        per_m, start = picture.size / size, np.zeros(2)
        own = read_georeference(path) if picture.is_tiff else Georeference(unit_cell=np.ones(2))
        model = raster.georeference
        if own.origin is not None and model.origin is not None:
            metres = raster.metres_per_unit
            per_m = 1.0 / (own.unit_cell * metres)
            start = (own.origin - model.origin) * np.array([1.0, -1.0]) * metres
        elif abs(per_m[0] / per_m[1] - 1.0) > 0.03:
            raise ValueError(
                f"{path} has {picture.size[0]} x {picture.size[1]} pixels, the model covers "
                f"{size[0]:g} x {size[1]:g} m: they must show the same extent"
            )
        centre = (middle[::-1] + 0.5) * raster.cell_m + raster.corner_m
        first = (centre - half - start) * per_m
        span = 2.0 * half * per_m
        if (first < -1.0).any() or (first + span > picture.size + 1.0).any():
            raise ValueError(f"{path} does not cover the window; give an image of the whole model")
        pixels = int(np.clip(np.ceil(span.max()), 64, MAX_TEXELS))
        low = np.maximum(np.floor(first).astype(int), 0)
        high = np.minimum(np.ceil(first + span).astype(int), picture.size)
        part = picture.part(low, high)
    method = cv2.INTER_AREA if span.max() > pixels else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(part, (pixels, pixels), interpolation=method), np.uint8)
