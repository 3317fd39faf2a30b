"""A low islet of sand and grass: relief, texture and plants."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import mujoco
import numpy as np

from touchdown.scenes.api import Array, GroundRaster, Surface
from touchdown.scenes.authoring.builder import GEOM, SceneBuilder, fill_texture
from touchdown.scenes.authoring.ground import Canvas, Ground
from touchdown.scenes.authoring.light import ground_texture
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.authoring.relief import HeightField, level_takeoff, smoothstep, write_hfield
from touchdown.scenes.authoring.water import Float32, flood_raster, upsample
from touchdown.scenes.props.plants import Nursery, add_bush, add_rock, plant_nursery
from touchdown.scenes.props.waterside import add_pile

HALF_M = 16.0
NODES = 97
TEXELS = 1280
_SUNK_M = 0.2
"""The height field ends this far below the water, the bed goes on in the texture alone."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Islet:
    """An islet about the origin."""

    terrain: HeightField
    """sunk to `_SUNK_M` below the water at the rim"""
    shore_m: Array
    """(N, N) metres from the waterline at its nodes, negative in the water"""
    level_m: float


def shape_islet(rng: np.random.Generator) -> Islet:
    """Returns sand that rises out of the water to a grassy hump; the height at the origin is 0."""
    flat = HeightField(heights_m=np.zeros((NODES, NODES)), half_m=HALF_M)
    x, y = flat.node_grid()
    order = np.arange(2, 6)
    amplitude = rng.uniform(0.3, 1.0, 4) * np.array([0.16, 0.08, 0.05, 0.04])
    phase = rng.uniform(0.0, 2.0 * np.pi, 4)
    turn = np.arctan2(y, x)
    outline = rng.uniform(7.0, 8.8) * (
        1.0 + np.cos(np.multiply.outer(turn, order) + phase) @ amplitude
    )
    ragged = 0.3 * fractal_noise(rng, x.shape, 3.0 / flat.cell_m, 3).astype(np.float64)
    shore = outline - np.hypot(x, y) + ragged
    hump = rng.uniform(0.5, 0.75) * smoothstep(0.0, 5.0, shore) + 0.05 * np.maximum(shore, 0.0)
    lumps = 0.05 * fractal_noise(rng, x.shape, 2.0 / flat.cell_m, 2).astype(np.float64)
    land = hump + lumps * smoothstep(1.0, 3.0, shore)
    heights = np.where(shore > 0.0, land, np.maximum(0.16 * shore, -_SUNK_M))
    level = -float(HeightField(heights_m=heights, half_m=HALF_M).point(0.0, 0.0))
    return Islet(terrain=level_takeoff(heights, HALF_M, np.zeros(2)), shore_m=shore, level_m=level)


def bed_depth(islet: Islet, size: int, half_m: float) -> Float32:
    """(size, size) depth of the water over a square of +-half_m about the islet, row 0 at y_min:
    shallows that fall off to 7 m."""
    inner = round(size * HALF_M / half_m)
    shore = np.full((size, size), -40.0, np.float32)
    first = (size - inner) // 2
    shore[first : first + inner, first : first + inner] = upsample(islet.shore_m, inner)
    axis = (np.arange(size) + 0.5) / size * 2.0 * half_m - half_m
    reach = np.hypot(*np.meshgrid(axis, axis)).astype(np.float32)
    out = np.where(shore > -30.0, -shore, reach - 8.0)
    out = np.where(reach > HALF_M - 4.0, np.maximum(out, reach - 8.5), out)
    out = cv2.GaussianBlur(out.astype(np.float32), (0, 0), 1.5)
    far = smoothstep(3.0, 16.0, np.asarray(out, np.float64))
    return np.asarray(0.16 * np.minimum(out, 6.0) + 6.0 * far, np.float32)


def add_islet(builder: SceneBuilder, islet: Islet) -> GroundRaster:
    """Adds the islet with its texture, after all objects that cast a shadow on it."""
    spec, rng = builder.spec, builder.rng
    spec.add_texture(name="islet", type=mujoco.mjtTexture.mjTEXTURE_2D, nchannel=3)
    canvas = Canvas.of_size(HALF_M, TEXELS)
    shore = upsample(islet.shore_m, TEXELS)
    fray = fractal_noise(rng, shore.shape, 60.0, 4, 0.6)
    canvas.material[:] = int(Ground.BEACH)
    canvas.material[shore > 2.1 + 0.35 * fray] = int(Ground.MEADOW)
    canvas.material[(shore > 3.0 + 0.5 * fray) & (fray > -0.5)] = int(Ground.LAWN)
    canvas.material[(shore < 0.7) & (fray > 0.7)] = int(Ground.GRAVEL)
    local = replace(builder, terrain=islet.terrain)
    shade = ground_texture(local, canvas, dict.fromkeys(Ground, float(rng.uniform(0, 3))))
    texture = np.empty((*canvas.material.shape, 3), np.uint8)
    shade(texture)
    # The strand is wet up to a hand's breadth above the water.
    wet = np.clip(1.0 - shore / 0.6, 0.0, 1.0)[::-1, :, None]
    texture[:] = (texture * (1.0 - 0.34 * wet)).astype(np.uint8)
    fill_texture(spec.texture("islet"), texture)
    depth = upsample(islet.level_m - islet.terrain.heights_m, TEXELS)
    return flood_raster(canvas.raster("islet"), depth)


def place_islet(builder: SceneBuilder, islet: Islet) -> None:
    """Adds the height field and, around a clear middle, bushes, rocks and a beacon."""
    spec, rng = builder.spec, builder.rng
    material = spec.add_material(name="islet", specular=0.0, shininess=0.0)
    textures = list(material.textures)
    textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = "islet"
    material.textures = textures
    spec.add_hfield(name="islet", nrow=NODES, ncol=NODES, size=[HALF_M, HALF_M, 1.0, 1.0])
    surface = Surface(land_class="field", reflectivity=0.42)
    builder.surfaces["islet"] = surface
    spec.worldbody.add_geom(
        name="islet", type=GEOM.mjGEOM_HFIELD, hfieldname="islet", material="islet"
    )
    write_hfield(spec, "islet", "islet", islet.terrain, base_m=0.3)
    builder.claim(np.zeros(2), 3.2)
    nursery: Nursery = plant_nursery(builder)
    shore = HeightField(heights_m=islet.shore_m, half_m=HALF_M)
    wanted = {"bush": int(rng.integers(2, 5)), "rock": int(rng.integers(7, 12)), "beacon": 1}
    ranges = {"bush": (1.6, 4.5), "rock": (-1.2, 1.2), "beacon": (1.0, 3.5)}
    for what, count in wanted.items():
        for _ in range(60 * count):
            spot = rng.uniform(-11.0, 11.0, 2)
            low, high = ranges[what]
            if count and low < float(shore.at(spot)) < high and builder.is_free(spot, 0.9):
                count -= 1
                if what == "bush":
                    add_bush(builder, nursery, spot)
                elif what == "rock":
                    add_rock(builder, spot, rng.uniform(0.25, 0.7))
                else:
                    add_beacon(builder, spot)


def add_beacon(builder: SceneBuilder, xy_m: Array) -> None:
    """Adds a mast of 4.5 m with a striped board."""
    z = builder.terrain.point(*xy_m)
    add_pile(builder, xy_m, z + 4.5, 0.07)
    for index, rgba in enumerate(([0.85, 0.12, 0.10, 1], [0.95, 0.95, 0.93, 1])):
        builder.geom("beacon_board", Surface(land_class="other", reflectivity=0.5), box=[0.04, 0.4,
                     0.3], pos=[*xy_m, z + 4.2 - 0.6 * index], rgba=rgba)  # fmt: skip
    builder.claim(xy_m, 0.8)
