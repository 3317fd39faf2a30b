"""Ground texture: a canvas of materials, markings and stains, shaded texel by texel."""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.scenes import api
from touchdown.scenes.authoring.noise import fractal_noise, tileable_noise
from touchdown.scenes.authoring.plane import unit
from touchdown.scenes.authoring.relief import HALF_M
from touchdown.scenes.authoring.shading import mixed_blocks, ragged_texels, shade
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


_GRASS, _CROP = 1.7, 3.6
"""leaf area index of grassland and of crops, global means (Asner, Scurlock and Hicke 2003)"""


def _surface(
    land_class: str, reflectivity: float, spread: float, canopy_m: float = 0.0,
    leaf_area: float = 0.0, dust: float = 0.0,
) -> api.Surface:  # fmt: skip
    return api.Surface(land_class=land_class, reflectivity=reflectivity, spread=spread,
                   canopy_m=canopy_m, leaf_area=leaf_area, dust=dust)  # fmt: skip


class _Look(NamedTuple):
    """A material as sensors see it."""

    surface: api.Surface
    detail: str
    """the photograph of its grain, one of DETAILS; empty for water, which has none"""
    rgb: tuple[int, int, int]
    gains: tuple[float, ...]
    """of fine noise, coarse noise, grain, large patches"""
    hue_drift: tuple[int, ...]
    """RGB, over large patches"""
    ragged: int
    """1 where the edge to a neighbour of the same kind is ragged"""


class Ground(IntEnum):
    """Materials of the terrain."""

    look: _Look

    def __new__(cls, number: int, look: _Look | None = None) -> "Ground":
        member = int.__new__(cls, number)
        member._value_ = number
        if look is not None:
            member.look = look
        return member

    # fmt: off
    LAWN = 0, _Look(_surface("lawn", 0.46, 0.08, 0.045, _GRASS), "grass",
                  (94, 114, 60), (0.17, 0.11, 0.09, 0.06), (5, 2, 1), 1)
    MEADOW = 1, _Look(_surface("lawn", 0.44, 0.12, 0.25, _GRASS), "meadow",
                    (114, 119, 70), (0.2, 0.17, 0.1, 0.06), (6, 2, 1), 1)
    SOIL = 2, _Look(_surface("field", 0.25, 0.14, dust=1.0), "soil",
                  (126, 98, 72), (0.17, 0.11, 0.08, 0.08), (6, 5, 5), 1)
    PAVEMENT = 3, _Look(_surface("path", 0.34, 0.08), "concrete",
                      (170, 165, 154), (0.04, 0.04, 0.035, 0.03), (2, 1, -2), 0)
    SIDE_PAVEMENT = 4, _Look(_surface("path", 0.34, 0.08), "concrete",
                           (166, 161, 151), (0.04, 0.04, 0.035, 0.03), (2, 1, -2), 0)
    ASPHALT = 5, _Look(_surface("road", 0.14, 0.15), "asphalt",
                     (97, 97, 99), (0.08, 0.04, 0.085, 0.05), (2, 1, -1), 0)
    NEW_ASPHALT = 6, _Look(_surface("road", 0.10, 0.10), "asphalt",
                         (72, 72, 75), (0.07, 0.03, 0.075, 0.03), (0, 0, 1), 0)
    GRAVEL = 7, _Look(_surface("path", 0.33, 0.15, dust=0.2), "gravel",
                    (176, 163, 138), (0.13, 0.06, 0.13, 0.04), (4, 3, 0), 1)
    PAVERS = 8, _Look(_surface("path", 0.30, 0.10), "concrete",
                    (160, 122, 102), (0.04, 0.05, 0.04, 0.04), (3, 1, 0), 0)
    MULCH = 9, _Look(_surface("field", 0.22, 0.20), "litter",
                   (88, 66, 50), (0.22, 0.08, 0.14, 0.04), (4, 2, 0), 1)
    CAR_PARK = 10, _Look(_surface("road", 0.15, 0.15), "asphalt",
                      (110, 109, 108), (0.08, 0.05, 0.09, 0.05), (2, 2, 1), 0)
    WORN = 11, _Look(_surface("lawn", 0.38, 0.15, 0.02, 0.7, dust=0.2), "grass",
                  (128, 113, 78), (0.16, 0.12, 0.09, 0.07), (8, 5, 0), 1)
    LITTER = 12, _Look(_surface("field", 0.34, 0.20), "litter",
                    (98, 82, 60), (0.24, 0.15, 0.14, 0.08), (7, 5, 2), 1)
    FERN = 13, _Look(_surface("trees", 0.40, 0.20, 0.35, _CROP), "meadow",
                  (78, 92, 48), (0.26, 0.18, 0.14, 0.06), (7, 4, 1), 1)
    SAND = 14, _Look(_surface("field", 0.48, 0.06, dust=0.6), "sand",
                  (214, 196, 156), (0.05, 0.04, 0.05, 0.03), (3, 2, 0), 0)
    FAIRWAY = 15, _Look(_surface("lawn", 0.47, 0.07, 0.015, _GRASS), "grass",
                     (92, 120, 58), (0.11, 0.09, 0.08, 0.05), (5, 2, 1), 0)
    GREEN = 16, _Look(_surface("lawn", 0.48, 0.05), "grass",
                   (110, 140, 72), (0.05, 0.05, 0.05, 0.04), (3, 2, 1), 0)
    ROUGH = 17, _Look(_surface("lawn", 0.43, 0.12, 0.1, _GRASS), "meadow",
                   (92, 104, 56), (0.23, 0.17, 0.11, 0.06), (8, 3, 1), 1)
    PUDDLE = 18, _Look(_surface("water", 0.05, 0.00), "",
                    (74, 80, 78), (0.02, 0.02, 0.01, 0.03), (1, 1, 2), 0)
    DECK = 19, _Look(_surface("path", 0.42, 0.06), "concrete",
                  (206, 196, 176), (0.03, 0.04, 0.03, 0.03), (3, 2, 0), 0)
    PLANKS = 20, _Look(_surface("path", 0.36, 0.12), "concrete",
                    (158, 122, 88), (0.06, 0.05, 0.05, 0.04), (3, 2, 1), 0)
    PITCH = 21, _Look(_surface("lawn", 0.46, 0.08, 0.03, _GRASS), "grass",
                   (88, 122, 58), (0.12, 0.08, 0.08, 0.05), (5, 2, 1), 0)
    CLAY = 22, _Look(_surface("field", 0.30, 0.10, dust=0.8), "soil",
                  (176, 98, 68), (0.06, 0.06, 0.07, 0.05), (5, 3, 2), 0)
    LANE = 23, _Look(_surface("road", 0.19, 0.15, dust=0.4), "gravel",
                  (134, 127, 117), (0.13, 0.07, 0.12, 0.05), (4, 3, 1), 1)
    COBBLES = 24, _Look(_surface("path", 0.28, 0.12), "concrete",
                     (142, 134, 124), (0.06, 0.07, 0.05, 0.05), (4, 2, 0), 0)
    RUBBER = 25, _Look(_surface("field", 0.22, 0.08), "soil",
                    (150, 78, 66), (0.03, 0.03, 0.06, 0.03), (2, 1, 0), 0)
    CROPS = 26, _Look(_surface("field", 0.36, 0.16, 0.3, _CROP), "meadow",
                   (108, 92, 62), (0.17, 0.12, 0.1, 0.06), (6, 5, 4), 1)
    BEACH = 27, _Look(_surface("field", 0.42, 0.06, dust=0.4), "sand",
                   (198, 182, 146), (0.07, 0.06, 0.08, 0.04), (4, 3, 1), 1)
    MUD = 28, _Look(_surface("field", 0.16, 0.14), "soil",
                 (96, 84, 66), (0.14, 0.16, 0.06, 0.07), (3, 3, 1), 1)
    ROOF_DECK = 29, _Look(_surface("path", 0.21, 0.15), "asphalt",
                       (134, 133, 130), (0.05, 0.05, 0.06, 0.06), (3, 2, -1), 0)
    SNOW = 30, _Look(_surface("field", 0.87, 0.04), "snow",
                  (206, 210, 217), (0.012, 0.01, 0.02, 0.016), (0, 0, -1), 0)
    PACKED_SNOW = 31, _Look(_surface("field", 0.78, 0.06), "snow",
                         (190, 196, 206), (0.022, 0.02, 0.03, 0.02), (2, 1, 0), 0)
    ICE = 32, _Look(_surface("water", 0.06, 0.00), "",
                 (118, 142, 156), (0.02, 0.05, 0.012, 0.08), (-6, 1, 5), 0)
    DUNE = 33, _Look(_surface("field", 0.44, 0.06, dust=1.0), "dune",
                  (202, 168, 120), (0.015, 0.015, 0.035, 0.025), (3, 1, -1), 0)
    SAND_FLAT = 34, _Look(_surface("field", 0.38, 0.06, dust=1.0), "sand",
                       (192, 162, 120), (0.05, 0.05, 0.07, 0.03), (3, 2, 0), 1)
    RUTTED_SAND = 35, _Look(_surface("field", 0.40, 0.06, dust=1.0), "sand",
                         (192, 160, 114), (0.05, 0.05, 0.06, 0.03), (4, 2, 0), 0)
    DRY_GRASS = 36, _Look(_surface("lawn", 0.42, 0.12, 0.2, 0.8, dust=0.2), "meadow",
                       (176, 154, 106), (0.18, 0.1, 0.14, 0.05), (4, 3, 1), 1)
    BEDROCK = 37, _Look(_surface("field", 0.34, 0.15), "rock",
                     (150, 124, 98), (0.13, 0.13, 0.09, 0.08), (4, 3, 2), 0)
    # Reflectivities of rugged ground are assumed, as of dry surfaces.
    GRANITE = 38, _Look(_surface("field", 0.31, 0.16), "rock",
                     (150, 147, 141), (0.13, 0.12, 0.11, 0.06), (4, 3, 1), 1)
    SCREE = 39, _Look(_surface("field", 0.28, 0.18, dust=0.1), "gravel",
                   (126, 122, 114), (0.17, 0.12, 0.16, 0.05), (4, 3, 1), 1)
    LIMESTONE = 40, _Look(_surface("field", 0.46, 0.12, dust=0.5), "rock",
                       (206, 196, 172), (0.09, 0.08, 0.08, 0.06), (5, 4, 1), 1)
    BASALT = 41, _Look(_surface("field", 0.10, 0.18), "rock",
                    (76, 71, 69), (0.16, 0.15, 0.12, 0.08), (3, 1, 0), 1)
    MOSS = 42, _Look(_surface("lawn", 0.40, 0.15), "grass",
                  (104, 110, 64), (0.16, 0.13, 0.09, 0.08), (6, 4, 0), 1)
    BADLAND = 43, _Look(_surface("field", 0.36, 0.10, dust=0.9), "soil",
                     (190, 158, 122), (0.09, 0.08, 0.08, 0.05), (4, 1, -1), 1)
    BRASH = 44, _Look(_surface("field", 0.32, 0.22), "litter",
                   (124, 104, 80), (0.26, 0.17, 0.18, 0.08), (6, 4, 2), 1)
    HEATHER = 45, _Look(_surface("lawn", 0.38, 0.18, 0.2, _GRASS), "meadow",
                     (106, 84, 70), (0.24, 0.18, 0.12, 0.08), (9, 2, 4), 1)
    # fmt: on


def mown_askew(rng: np.random.Generator, angle: float) -> dict[Ground, float]:
    """Angles of patterns: everything along ``angle`` but oblique mowing stripes."""
    return dict.fromkeys(Ground, angle) | {Ground.LAWN: angle + float(rng.uniform(0.2, 1.3))}


HELD_OUT = (Ground.BASALT, Ground.MOSS, Ground.BADLAND)
"""materials of presets that no classifier is trained on: no other place has them"""


@contextlib.contextmanager
def varied_materials(rng: np.random.Generator) -> Iterator[None]:
    """Gives all scenes made inside the context other ground and water: each material becomes a
    random one of its class, brick where gravel lay, clay for soil, and water may be clear, blue or
    full of silt."""
    table = np.arange(len(Ground), dtype=np.uint8)
    for name in api.LAND_CLASSES:
        known = [m for m in Ground if m not in HELD_OUT and m.look.surface.land_class == name]
        same = np.array(known, np.uint8)
        if len(same):
            table[same] = rng.choice(same, len(same))
    red, green, blue = (rng.dirichlet(np.full(len(_WATERS), 0.7)) @ _WATERS).tolist()
    clear = float(np.exp(rng.uniform(*_CLARITY)))
    clarity = (0.6 * clear, clear, clear * rng.uniform(0.7, 1.3))
    water = (red, green, blue), clarity, rng.uniform(0.1, 0.7)
    with varied(Variation(table, *water)):
        yield


PAINT_REFLECTIVITY = 0.60
_PAINT = _surface("road", PAINT_REFLECTIVITY, 0.15)
"""marking paint and its wear"""


@dataclass(kw_only=True, slots=True)
class Canvas:
    """Rasters over the square of +-half_m, row 0 at y_min: material ids, marking paint and dark
    stains (0..255 coverage)."""

    half_m: float = HALF_M
    material: api.Bytes = field(default_factory=lambda: np.zeros((TEXELS, TEXELS), np.uint8))
    paint: api.Bytes = field(default_factory=lambda: np.zeros((TEXELS, TEXELS), np.uint8))
    stain: api.Bytes = field(default_factory=lambda: np.zeros((TEXELS, TEXELS), np.uint8))

    @staticmethod
    def of_size(half_m: float, texels: int) -> "Canvas":
        """Returns a canvas of (texels, texels) rather than `TEXELS`, a multiple of
        `RASTER_STRIDE`."""
        blank = np.zeros((3, texels, texels), np.uint8)
        return Canvas(half_m=half_m, material=blank[0], paint=blank[1], stain=blank[2])

    @property
    def texel_m(self) -> float:
        """Side of a texel in metres."""
        return 2.0 * self.half_m / len(self.material)

    def texels(self, xy_m: api.Array) -> NDArray[np.int32]:
        """Converts (N, 2) world metres to cv2's fixed-point column and row."""
        grid = (np.asarray(xy_m) + self.half_m) / self.texel_m - 0.5
        return np.round(grid * 2**_BITS).astype(np.int32)

    def fill(self, outline_m: api.Array, material: Ground) -> None:
        """Sets the material of a polygon, (N, 2) world metres."""
        cv2.fillPoly(self.material, [self.texels(outline_m)], int(material), cv2.LINE_8, _BITS)

    def mark(self, outline_m: api.Array, cover: int = 255) -> None:
        """Paints a polygon white."""
        cv2.fillPoly(self.paint, [self.texels(outline_m)], cover, cv2.LINE_AA, _BITS)

    def soil(self, outline_m: api.Array, cover: int) -> None:
        """Darkens a polygon."""
        cv2.fillPoly(self.stain, [self.texels(outline_m)], cover, cv2.LINE_AA, _BITS)

    def trace(self, line_m: api.Array, width_m: float, cover: int) -> None:
        """Draws a dark line (a crack, a tar seam, a joint)."""
        width = max(1, round(width_m / self.texel_m))
        points = [self.texels(line_m)]
        cv2.polylines(self.stain, points, False, cover, width, cv2.LINE_AA, _BITS)

    def track(self, line_m: api.Array, width_m: float, material: Ground) -> None:
        """Fills a band along a polyline with a material."""
        width = max(1, round(width_m / self.texel_m))
        cv2.polylines(self.material, [self.texels(line_m)], False, int(material), width, 8, _BITS)

    def raster(self, geom_name: str) -> api.GroundRaster:
        """Returns classes and reflectivities, sampled at cell centres."""
        ids = [api.LAND_CLASSES.index(material.look.surface.land_class) for material in Ground]
        shine = np.array([material.look.surface.reflectivity for material in Ground], np.float32)
        grain = [
            api.DETAILS.index(m.look.detail) if m.look.detail else api.NO_DETAIL_ID for m in Ground
        ]
        middle = slice(RASTER_STRIDE // 2, None, RASTER_STRIDE)
        material = self.material[middle, middle]
        cover = self.paint[middle, middle].astype(np.float32) / 255.0
        plain = shine[material]
        kinds = np.where(cover > 0.5, len(Ground), material).astype(np.uint8)
        return api.GroundRaster(
            geom_name=geom_name,
            origin_xy_m=np.array([-self.half_m, -self.half_m]),
            cell_m=self.texel_m * RASTER_STRIDE,
            class_id=np.array(ids, np.uint8)[material],
            reflectivity=plain + cover * (PAINT_REFLECTIVITY - plain),
            material=kinds,
            materials=(*(material.look.surface for material in Ground), _PAINT),
            detail_id=np.array(grain, np.uint8)[material],
        )


def shade_ground(
    rng: np.random.Generator,
    canvas: Canvas,
    light: api.Float32,
    pattern_angles: dict[Ground, float],
) -> api.Bytes:
    """Returns the texture, (rows, cols, 3) uint8 as the canvas is, top row = y_max. The arguments
    are those of `ground_shader`."""
    image = np.empty((*canvas.material.shape, 3), np.uint8)
    ground_shader(rng, canvas, light, pattern_angles)(image)
    return image


def ground_shader(
    rng: np.random.Generator,
    canvas: Canvas,
    light: api.Float32,
    pattern_angles: dict[Ground, float],
    slopes: api.Bytes | None = None,
) -> Callable[[api.Bytes], None]:
    """Returns what fills an image, shaped as the canvas with the top row at y_max, with its
    texture. All random numbers are drawn here, and the canvas is given the materials of
    `varied_materials`.

    light: (n, n) fraction of full light, row 0 at y_min (see `light.bake_light`). pattern_angles:
    radians by which slabs, mowing stripes and furrows of a material are turned. slopes: as the
    canvas, tones of a relief finer than the terrain's (see `scenes.authoring.micro_relief`)."""
    variation = present_variation()
    if variation is not None:
        canvas.material[:] = variation.materials[canvas.material]
    count = len(Ground)
    base = np.array([m.look.rgb for m in Ground], np.float32)
    gains = np.array([m.look.gains for m in Ground], np.float32)
    hues = np.array([m.look.hue_drift for m in Ground], np.float32)
    ragged = np.array([m.look.ragged for m in Ground], np.uint8)
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
    mixed = mixed_blocks(canvas.material, side)

    def fill(image: api.Bytes) -> None:
        shade(image, canvas.material, canvas.paint, canvas.stain, bright, level, fine,
              coarse.ravel(), patches, hue, base, gains, hues, ragged, frames, canvas.texel_m,
              mixed, side, salt)  # fmt: skip

    return fill
