"""First and last steps that all scene generators share."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from zlib import crc32

import mujoco
import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import GroundRaster, MovingBody, Surface
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.ground import Canvas, Ground
from touchdown.scenes.authoring.light import SUN_ELEVATIONS_DEG, draw_sun, ground_texture
from touchdown.scenes.authoring.plots import SurveyFrame
from touchdown.scenes.authoring.relief import HeightField, write_hfield
from touchdown.scenes.authoring.water import Float32, WaterLook, flood_raster, lay_water, varied

PLACES = Path(__file__).parents[1] / "places"
LAWN = Surface(land_class="lawn", reflectivity=0.45)


@dataclass(frozen=True, kw_only=True, slots=True)
class Flood:
    """Water on the terrain."""

    depth_m: Float32
    """(n, n) over the terrain's square, row 0 at y_min; negative above the water"""
    draw_look: Callable[[np.random.Generator], WaterLook]
    """called once the ground below the water is painted"""


def scene_rng(name: str, seed: int) -> np.random.Generator:
    """The random stream of a named scene."""
    return np.random.default_rng([seed, crc32(f"scenes.{name}".encode())])


def start_scene(
    name: str,
    rng: np.random.Generator,
    terrain: HeightField,
    *,
    base_m: float = 2.0,
    support: HeightField | None = None,
    sun_deg: tuple[float, float] = SUN_ELEVATIONS_DEG,
) -> SceneBuilder:
    """Reads the MJCF of the scene ``name``, fills its height field `terrain` if it has one, draws
    the sun, and returns the builder.

    base_m: thickness of the ground below the lowest node. support: the surface that objects
    stand on where it is not ``terrain`` (the bed of a stream, the deck of a building). sun_deg:
    between these elevations stands the sun.
    """
    spec = mujoco.MjSpec.from_file(str(PLACES / name / f"{name}.xml"))
    if spec.hfield("terrain") is not None:
        write_hfield(spec, "terrain", "terrain", terrain, base_m)
    sun = draw_sun(rng, spec, sun_deg)
    return SceneBuilder(spec=spec, rng=rng, terrain=support or terrain, sun=sun)


def paint_terrain(
    builder: SceneBuilder,
    canvas: Canvas,
    pattern_angles: dict[Ground, float],
    *,
    hilly: bool = False,
    flood: Flood | None = None,
    slopes: NDArray[np.uint8] | None = None,
) -> GroundRaster:
    """Writes the texture `ground` under the light and shadows of everything placed so far, and
    returns the terrain's class raster. The other arguments are those of `light.ground_texture`."""
    shade = ground_texture(builder, canvas, pattern_angles, hilly, slopes)
    raster = canvas.raster("terrain")
    shape = (*canvas.material.shape, 3)
    if flood is None:
        builder.picture("ground", shape, shade)
        return raster
    texture = np.empty(shape, np.uint8)
    shade(texture)
    look = varied(flood.draw_look(builder.rng))
    lay_water(builder.rng, texture, flood.depth_m, canvas.half_m, look, builder.sun)
    builder.picture("ground", shape, partial(np.copyto, src=texture))
    return flood_raster(raster, flood.depth_m)


def finish(
    frame: SurveyFrame,
    builder: SceneBuilder,
    ground: GroundRaster | None,
    *,
    half_m: float | None = None,
    terrain: Surface = LAWN,
    moving: tuple[MovingBody, ...] = (),
) -> SceneDraft:
    """Returns the draft of everything placed, with the take-off pose of ``frame``.

    ground: class raster of the ground's geom. half_m: half the side of the scene's bounds, by
    default that of the terrain. terrain: surface of the geom `terrain` outside of its raster.
    """
    half = builder.terrain.half_m if half_m is None else half_m
    if builder.spec.geom("terrain") is not None:
        builder.surfaces["terrain"] = terrain
    return SceneDraft(
        spec=builder.spec,
        takeoff_xy_m=frame.takeoff_xy_m,
        takeoff_yaw=frame.takeoff_yaw,
        bounds_xy_m=np.array([[-half, -half], [half, half]]),
        surfaces=builder.surfaces,
        ground=ground,
        moving=moving,
        pictures=builder.pictures,
    )
