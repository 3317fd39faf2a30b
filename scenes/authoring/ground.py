"""Ground texture: a canvas of materials, markings and stains, shaded texel by texel."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import (
    DETAILS,
    LAND_CLASSES,
    NO_DETAIL_ID,
    Array,
    Bytes,
    Float32,
    GroundRaster,
    Surface,
)
from touchdown.scenes.authoring.noise import fractal_noise, tileable_noise
from touchdown.scenes.authoring.plane import unit
from touchdown.scenes.authoring.shading import ragged_texels, shade
from touchdown.scenes.authoring.variation import Variation, present_variation, varied

TEXELS = 5120
RASTER_STRIDE = 4
"""Texels per cell of the class raster."""
_TILE = 1024
_BITS = 4
_WATERS = np.array([[118, 100, 70], [44, 66, 48], [24, 58, 96], [70, 175, 195]], np.float64)
"""bodies full of silt and of algae, deep, and shallow over a pale bed"""
_CLARITY = (-1.6, -0.3)
"""logarithm of the metres of water that dim green light to 1/e: 0.2 to 0.74 m. Of clearer water by
a shore an image shows the bed alone."""


class Ground(IntEnum):
    """Materials of the terrain."""

    LAWN = 0
    MEADOW = 1
    SOIL = 2
    PAVEMENT = 3
    SIDE_PAVEMENT = 4
    ASPHALT = 5
    NEW_ASPHALT = 6
    GRAVEL = 7
    PAVERS = 8
    MULCH = 9
    CAR_PARK = 10
    WORN = 11
    LITTER = 12
    FERN = 13
    SAND = 14
    FAIRWAY = 15
    GREEN = 16
    ROUGH = 17
    PUDDLE = 18
    DECK = 19
    PLANKS = 20
    PITCH = 21
    CLAY = 22
    LANE = 23
    COBBLES = 24
    RUBBER = 25
    CROPS = 26
    BEACH = 27
    MUD = 28
    ROOF_DECK = 29
    SNOW = 30
    PACKED_SNOW = 31
    ICE = 32
    DUNE = 33
    SAND_FLAT = 34
    RUTTED_SAND = 35
    DRY_GRASS = 36
    BEDROCK = 37


@contextlib.contextmanager
def varied_materials(rng: np.random.Generator) -> Iterator[None]:
    """Gives all scenes made inside the context other ground and water: each material becomes a
    random one of its class, brick where gravel lay, clay for soil, and water may be clear, blue or
    full of silt."""
    table = np.arange(len(Ground), dtype=np.uint8)
    for name in LAND_CLASSES:
        same = np.array([int(m) for m in Ground if _TABLE[m].land_class == name], np.uint8)
        if len(same):
            table[same] = rng.choice(same, len(same))
    red, green, blue = (rng.dirichlet(np.full(len(_WATERS), 0.7)) @ _WATERS).tolist()
    clear = float(np.exp(rng.uniform(*_CLARITY)))
    clarity = (0.6 * clear, clear, clear * rng.uniform(0.7, 1.3))
    water = (red, green, blue), clarity, rng.uniform(0.1, 0.7)
    with varied(Variation(table, *water)):
        yield


class _Row(NamedTuple):
    """Appearance and class of a material."""

    land_class: str
    reflectivity: float
    """at 905 nm"""
    rgb: tuple[int, int, int]
    gains: tuple[float, ...]
    """of fine noise, coarse noise, grain, large patches"""
    hue_drift: tuple[int, ...]
    """RGB, over large patches"""
    ragged: int
    """1 where the edge to a neighbour of the same kind is ragged"""


_TABLE: dict[Ground, _Row] = {
    Ground.LAWN: _Row("lawn", 0.46, (94, 114, 60), (0.17, 0.11, 0.09, 0.06), (5, 2, 1), 1),
    Ground.MEADOW: _Row("lawn", 0.44, (114, 119, 70), (0.20, 0.17, 0.10, 0.06), (6, 2, 1), 1),
    Ground.SOIL: _Row("field", 0.25, (126, 98, 72), (0.17, 0.11, 0.08, 0.08), (6, 5, 5), 1),
    Ground.PAVEMENT: _Row("path", 0.34, (170, 165, 154), (0.04, 0.04, 0.035, 0.03), (2, 1, -2), 0),
    Ground.SIDE_PAVEMENT: _Row("path", 0.34, (166, 161, 151), (0.04, 0.04, 0.035, 0.03),
                               (2, 1, -2), 0),
    Ground.ASPHALT: _Row("road", 0.14, (97, 97, 99), (0.08, 0.04, 0.085, 0.05), (2, 1, -1), 0),
    Ground.NEW_ASPHALT: _Row("road", 0.10, (72, 72, 75), (0.07, 0.03, 0.075, 0.03), (0, 0, 1), 0),
    Ground.GRAVEL: _Row("path", 0.33, (176, 163, 138), (0.13, 0.06, 0.13, 0.04), (4, 3, 0), 1),
    Ground.PAVERS: _Row("path", 0.30, (160, 122, 102), (0.04, 0.05, 0.04, 0.04), (3, 1, 0), 0),
    Ground.MULCH: _Row("field", 0.22, (88, 66, 50), (0.22, 0.08, 0.14, 0.04), (4, 2, 0), 1),
    Ground.CAR_PARK: _Row("road", 0.15, (110, 109, 108), (0.08, 0.05, 0.09, 0.05), (2, 2, 1), 0),
    Ground.WORN: _Row("lawn", 0.38, (128, 113, 78), (0.16, 0.12, 0.09, 0.07), (8, 5, 0), 1),
    Ground.LITTER: _Row("field", 0.34, (98, 82, 60), (0.24, 0.15, 0.14, 0.08), (7, 5, 2), 1),
    Ground.FERN: _Row("trees", 0.40, (78, 92, 48), (0.26, 0.18, 0.14, 0.06), (7, 4, 1), 1),
    Ground.SAND: _Row("field", 0.48, (214, 196, 156), (0.05, 0.04, 0.05, 0.03), (3, 2, 0), 0),
    Ground.FAIRWAY: _Row("lawn", 0.47, (92, 120, 58), (0.11, 0.09, 0.08, 0.05), (5, 2, 1), 0),
    Ground.GREEN: _Row("lawn", 0.48, (110, 140, 72), (0.05, 0.05, 0.05, 0.04), (3, 2, 1), 0),
    Ground.ROUGH: _Row("lawn", 0.43, (92, 104, 56), (0.23, 0.17, 0.11, 0.06), (8, 3, 1), 1),
    Ground.PUDDLE: _Row("water", 0.05, (74, 80, 78), (0.02, 0.02, 0.01, 0.03), (1, 1, 2), 0),
    Ground.DECK: _Row("path", 0.42, (206, 196, 176), (0.03, 0.04, 0.03, 0.03), (3, 2, 0), 0),
    Ground.PLANKS: _Row("path", 0.36, (158, 122, 88), (0.06, 0.05, 0.05, 0.04), (3, 2, 1), 0),
    Ground.PITCH: _Row("lawn", 0.46, (88, 122, 58), (0.12, 0.08, 0.08, 0.05), (5, 2, 1), 0),
    Ground.CLAY: _Row("field", 0.30, (176, 98, 68), (0.06, 0.06, 0.07, 0.05), (5, 3, 2), 0),
    Ground.LANE: _Row("road", 0.19, (134, 127, 117), (0.13, 0.07, 0.12, 0.05), (4, 3, 1), 1),
    Ground.COBBLES: _Row("path", 0.28, (142, 134, 124), (0.06, 0.07, 0.05, 0.05), (4, 2, 0), 0),
    Ground.RUBBER: _Row("field", 0.22, (150, 78, 66), (0.03, 0.03, 0.06, 0.03), (2, 1, 0), 0),
    Ground.CROPS: _Row("field", 0.36, (108, 92, 62), (0.17, 0.12, 0.10, 0.06), (6, 5, 4), 1),
    Ground.BEACH: _Row("field", 0.42, (198, 182, 146), (0.07, 0.06, 0.08, 0.04), (4, 3, 1), 1),
    Ground.MUD: _Row("field", 0.16, (96, 84, 66), (0.14, 0.16, 0.06, 0.07), (3, 3, 1), 1),
    Ground.ROOF_DECK: _Row("path", 0.21, (134, 133, 130), (0.05, 0.05, 0.06, 0.06), (3, 2, -1), 0),
    Ground.SNOW: _Row("field", 0.87, (206, 210, 217), (0.012, 0.010, 0.020, 0.016), (0, 0, -1), 0),
    Ground.PACKED_SNOW: _Row("field", 0.78, (190, 196, 206), (0.022, 0.02, 0.03, 0.02),
                             (2, 1, 0), 0),
    Ground.ICE: _Row("water", 0.06, (118, 142, 156), (0.02, 0.05, 0.012, 0.08), (-6, 1, 5), 0),
    Ground.DUNE: _Row("field", 0.44, (202, 168, 120), (0.015, 0.015, 0.035, 0.025), (3, 1, -1), 0),
    Ground.SAND_FLAT: _Row("field", 0.38, (192, 162, 120), (0.05, 0.05, 0.07, 0.03),
                           (3, 2, 0), 1),
    Ground.RUTTED_SAND: _Row("field", 0.40, (192, 160, 114), (0.05, 0.05, 0.06, 0.03),
                             (4, 2, 0), 0),
    Ground.DRY_GRASS: _Row("lawn", 0.42, (176, 154, 106), (0.18, 0.10, 0.14, 0.05), (4, 3, 1), 1),
    Ground.BEDROCK: _Row("field", 0.34, (150, 124, 98), (0.13, 0.13, 0.09, 0.08), (4, 3, 2), 0),
}  # fmt: skip
_DETAIL = {"grass": (Ground.LAWN, Ground.FAIRWAY, Ground.GREEN, Ground.PITCH, Ground.WORN),
           "meadow": (Ground.MEADOW, Ground.ROUGH, Ground.FERN, Ground.CROPS, Ground.DRY_GRASS),
           "soil": (Ground.SOIL, Ground.MUD, Ground.CLAY, Ground.RUBBER), "litter": (Ground.MULCH,
           Ground.LITTER), "asphalt": (Ground.ASPHALT, Ground.NEW_ASPHALT, Ground.CAR_PARK,
           Ground.ROOF_DECK), "gravel": (Ground.GRAVEL, Ground.LANE), "concrete": (Ground.PAVEMENT,
           Ground.SIDE_PAVEMENT, Ground.PAVERS, Ground.DECK, Ground.COBBLES, Ground.PLANKS),
           "sand": (Ground.SAND, Ground.BEACH, Ground.SAND_FLAT, Ground.RUTTED_SAND),
           "dune": (Ground.DUNE,), "snow": (Ground.SNOW, Ground.PACKED_SNOW),
           "rock": (Ground.BEDROCK,)}  # fmt: skip
"""Materials by the photograph of their grain; water has none."""
_DETAIL_OF = {material: name for name, group in _DETAIL.items() for material in group}
PAINT_REFLECTIVITY = 0.60


@dataclass(kw_only=True, slots=True)
class Canvas:
    """Rasters over the square of +-half_m, row 0 at y_min: material ids, marking paint and dark
    stains (0..255 coverage)."""

    half_m: float
    material: Bytes = field(default_factory=lambda: np.zeros((TEXELS, TEXELS), np.uint8))
    paint: Bytes = field(default_factory=lambda: np.zeros((TEXELS, TEXELS), np.uint8))
    stain: Bytes = field(default_factory=lambda: np.zeros((TEXELS, TEXELS), np.uint8))

    @staticmethod
    def of_size(half_m: float, texels: int) -> Canvas:
        """Returns a canvas of (texels, texels) rather than `TEXELS`, a multiple of
        `RASTER_STRIDE`."""
        blank = np.zeros((3, texels, texels), np.uint8)
        return Canvas(half_m=half_m, material=blank[0], paint=blank[1], stain=blank[2])

    @property
    def texel_m(self) -> float:
        """Side of a texel in metres."""
        return 2.0 * self.half_m / len(self.material)

    def texels(self, xy_m: Array) -> NDArray[np.int32]:
        """Converts (N, 2) world metres to cv2's fixed-point column and row."""
        grid = (np.asarray(xy_m) + self.half_m) / self.texel_m - 0.5
        return np.round(grid * 2**_BITS).astype(np.int32)

    def fill(self, outline_m: Array, material: Ground) -> None:
        """Sets the material of a polygon, (N, 2) world metres."""
        cv2.fillPoly(self.material, [self.texels(outline_m)], int(material), cv2.LINE_8, _BITS)

    def mark(self, outline_m: Array, cover: int = 255) -> None:
        """Paints a polygon white."""
        cv2.fillPoly(self.paint, [self.texels(outline_m)], cover, cv2.LINE_AA, _BITS)

    def soil(self, outline_m: Array, cover: int) -> None:
        """Darkens a polygon."""
        cv2.fillPoly(self.stain, [self.texels(outline_m)], cover, cv2.LINE_AA, _BITS)

    def trace(self, line_m: Array, width_m: float, cover: int) -> None:
        """Draws a dark line (a crack, a tar seam, a joint)."""
        width = max(1, round(width_m / self.texel_m))
        points = [self.texels(line_m)]
        cv2.polylines(self.stain, points, False, cover, width, cv2.LINE_AA, _BITS)

    def track(self, line_m: Array, width_m: float, material: Ground) -> None:
        """Fills a band along a polyline with a material."""
        width = max(1, round(width_m / self.texel_m))
        cv2.polylines(self.material, [self.texels(line_m)], False, int(material), width, 8, _BITS)

    def raster(self, geom_name: str) -> GroundRaster:
        """Returns classes and reflectivities, sampled at cell centres."""
        ids = [LAND_CLASSES.index(_TABLE[material].land_class) for material in Ground]
        shine = np.array([_TABLE[material].reflectivity for material in Ground], np.float32)
        grain = [DETAILS.index(_DETAIL_OF[m]) if m in _DETAIL_OF else NO_DETAIL_ID for m in Ground]
        middle = slice(RASTER_STRIDE // 2, None, RASTER_STRIDE)
        material = self.material[middle, middle]
        cover = self.paint[middle, middle].astype(np.float32) / 255.0
        plain = shine[material]
        kinds = np.where(cover > 0.5, len(Ground), material).astype(np.uint8)
        return GroundRaster(
            geom_name=geom_name,
            origin_xy_m=np.array([-self.half_m, -self.half_m]),
            cell_m=self.texel_m * RASTER_STRIDE,
            class_id=np.array(ids, np.uint8)[material],
            reflectivity=plain + cover * (PAINT_REFLECTIVITY - plain),
            material=kinds,
            materials=_materials(),
            detail_id=np.array(grain, np.uint8)[material],
        )


def _materials() -> tuple[Surface, ...]:
    """Returns the surface of each material, by its number, and of marking paint at last."""
    surfaces = [
        Surface(
            land_class=_TABLE[material].land_class,
            reflectivity=_TABLE[material].reflectivity,
            **vegetation_of(material.name)._asdict(),
        )
        for material in Ground
    ]
    paint = Surface(land_class="road", reflectivity=PAINT_REFLECTIVITY, **PAINT._asdict())
    return (*surfaces, paint)


def shade_ground(
    rng: np.random.Generator,
    canvas: Canvas,
    light: Float32,
    pattern_angles: dict[Ground, float],
    slopes: Bytes | None = None,
) -> Bytes:
    """Returns the texture, (rows, cols, 3) uint8 as the canvas is, top row = y_max.

    light: (n, n) share of full light, row 0 at y_min (see `light.bake_light`). pattern_angles:
    radians by which slabs, mowing stripes and furrows of a material are turned. slopes: as the
    canvas, tones of a relief finer than the terrain's (see `scenes.authoring.micro_relief`)."""
    image = np.empty((*canvas.material.shape, 3), np.uint8)
    ground_shader(rng, canvas, light, pattern_angles, slopes)(image)
    return image


def ground_shader(
    rng: np.random.Generator,
    canvas: Canvas,
    light: Float32,
    pattern_angles: dict[Ground, float],
    slopes: Bytes | None = None,
) -> Callable[[Bytes], None]:
    """Returns what fills an image with the texture of `shade_ground`. All random numbers are drawn
    here, and the canvas is given the materials of `varied_materials`."""
    variation = present_variation()
    if variation is not None:
        canvas.material[:] = variation.materials[canvas.material]
    count = len(Ground)
    base = np.array([_TABLE[m].rgb for m in Ground], np.float32)
    gains = np.array([_TABLE[m].gains for m in Ground], np.float32)
    hues = np.array([_TABLE[m].hue_drift for m in Ground], np.float32)
    ragged = np.array([_TABLE[m].ragged for m in Ground], np.uint8)
    angles = np.array([pattern_angles.get(m, 0.0) for m in Ground])
    frames = unit(angles).reshape(count, 2)
    fine = tileable_noise(rng, _TILE, 0.55, 10.0)
    coarse = tileable_noise(rng, _TILE, 1.25, 5.0)
    patches = fractal_noise(rng, (512, 512), 56.0, 4, 0.6)
    hue = fractal_noise(rng, (512, 512), 40.0, 3, 0.6)
    size = canvas.material.shape
    glow = np.multiply(
        light, np.float32(255.0), out=np.empty_like(light, np.uint8), casting="unsafe"
    )
    bright = np.asarray(cv2.resize(glow, size, interpolation=cv2.INTER_LINEAR), np.uint8)
    level = np.zeros((0, 0), np.uint8) if slopes is None else slopes
    side, salt = ragged_texels(fine, coarse), int(rng.integers(1, 2**31))

    def fill(image: Bytes) -> None:
        shade(image, canvas.material, canvas.paint, canvas.stain, bright, level, fine,
              coarse.ravel(), patches, hue, base, gains, hues, ragged, frames, canvas.texel_m, side,
              salt)  # fmt: skip

    return fill


class Vegetation(NamedTuple):
    """As the fields of `scenes.api.Surface`."""

    spread: float = 0.1
    canopy_m: float = 0.0
    leaf_area: float = 0.0
    dust: float = 0.0


_GRASS, _CROP = 1.7, 3.6
"""leaf area index of grassland and of crops, global means (Asner, Scurlock and Hicke 2003)"""

VEGETATION: dict[str, Vegetation] = {
    "LAWN": Vegetation(0.08, 0.045, _GRASS),
    "MEADOW": Vegetation(0.12, 0.25, _GRASS),
    "SOIL": Vegetation(0.14, dust=1.0),
    "PAVEMENT": Vegetation(0.08),
    "SIDE_PAVEMENT": Vegetation(0.08),
    "ASPHALT": Vegetation(0.15),
    "NEW_ASPHALT": Vegetation(0.10),
    "GRAVEL": Vegetation(0.15, dust=0.2),
    "PAVERS": Vegetation(0.10),
    "MULCH": Vegetation(0.20),
    "CAR_PARK": Vegetation(0.15),
    "WORN": Vegetation(0.15, 0.02, 0.7, dust=0.2),
    "LITTER": Vegetation(0.20),
    "FERN": Vegetation(0.20, 0.35, _CROP),
    "SAND": Vegetation(0.06, dust=0.6),
    "FAIRWAY": Vegetation(0.07, 0.015, _GRASS),
    "GREEN": Vegetation(0.05),
    "ROUGH": Vegetation(0.12, 0.10, _GRASS),
    "PUDDLE": Vegetation(0.0),
    "DECK": Vegetation(0.06),
    "PLANKS": Vegetation(0.12),
    "PITCH": Vegetation(0.08, 0.03, _GRASS),
    "CLAY": Vegetation(0.10, dust=0.8),
    "LANE": Vegetation(0.15, dust=0.4),
    "COBBLES": Vegetation(0.12),
    "RUBBER": Vegetation(0.08),
    "CROPS": Vegetation(0.16, 0.30, _CROP),
    "BEACH": Vegetation(0.06, dust=0.4),
    "MUD": Vegetation(0.14),
    "ROOF_DECK": Vegetation(0.15),
    "SNOW": Vegetation(0.04),
    "PACKED_SNOW": Vegetation(0.06),
    "ICE": Vegetation(0.0),
    "DUNE": Vegetation(0.06, dust=1.0),
    "SAND_FLAT": Vegetation(0.06, dust=1.0),
    "RUTTED_SAND": Vegetation(0.06, dust=1.0),
    "DRY_GRASS": Vegetation(0.12, 0.20, 0.8, dust=0.2),
    "BEDROCK": Vegetation(0.15),
}
PAINT = Vegetation(0.15)
"""marking paint and its wear"""


def vegetation_of(material: str) -> Vegetation:
    """Returns the cover of a material by its name; a material that is not listed is bare."""
    return VEGETATION.get(material, Vegetation())
