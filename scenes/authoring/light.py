"""The light under which scenes are made, their sun, and the ground texture under it.

Day, overcast, dusk or night is a property of the context, not of a scene's plan: generators draw
the same numbers under every light. Only what is drawn of them changes: lamps of the model, shadows
in the ground's texture, the sky. All lights show a level white surface about equally bright; how
bright that is in lux is `scenes.api.LIGHT_LUX`, and a camera's exposure deals with it.

- overcast: no sun. A light from the zenith and an even one give walls 0.4 of the light of level
  ground, as under the CIE's overcast sky;
- dusk: the sun stands 2 degrees high. A quarter of the light on level ground comes from it, with
  long, soft shadows, three quarters from the sky. What faces the sun is no brighter than 1.2 times
  a white level surface, which the eight bits of a drawing ask for;
- night: no sun and no lamps, an even light, which leaves the occlusion below objects.

The light of a low sun is reddened by the atmosphere, by exp(-m (R + B)) for each colour, with the
air mass m of Kasten and Young (Applied Optics 28, 1989), Rayleigh scattering R = 0.008735 w^-4.08
(Leckner, Solar Energy 20, 1978) and haze B = 0.05 w^-1.3 (Angstrom's turbidity formula), w the
wavelength in micrometres. Half of the light on level ground then comes from the sky; the exposure
of a camera is that for both together.
"""

import contextlib
import math
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import Any, NamedTuple

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import Array, Float32, Light, LowSun
from touchdown.scenes.authoring.builder import Caster, SceneBuilder
from touchdown.scenes.authoring.ground import Canvas, Ground, ground_shader
from touchdown.scenes.authoring.plane import unit
from touchdown.scenes.authoring.relief import HeightField

DUSK_SUN_DEG = 2.0
DUSK_SUN_FRACTION = 0.25
"""of the light on level ground at dusk"""
SHADE = 0.5
"""Light left in full shadow by day"""


class Sky(NamedTuple):
    """Light, and the sun of ``day`` where it is not the scene's own."""

    light: Light = "day"
    sun: LowSun | None = None


_DAY = Sky()
_sky: ContextVar[Sky] = ContextVar("sky", default=_DAY)

_SKIES: dict[str, tuple[list[float], list[float]]] = {
    "overcast": ([0.70, 0.72, 0.75], [0.84, 0.85, 0.86]),
    "dusk": ([0.30, 0.36, 0.55], [0.96, 0.66, 0.42]),
    "night": ([0.03, 0.04, 0.07], [0.08, 0.09, 0.13]),
}
"""Colours of a gradient sky, zenith and horizon"""


@contextlib.contextmanager
def lit_by(light: Light, sun: LowSun | None = None) -> Iterator[None]:
    """Gives this light to all scenes made inside the context; ``sun`` None leaves each its own."""
    token = _sky.set(Sky(light, sun))
    try:
        yield
    finally:
        _sky.reset(token)


def present_sky() -> Sky:
    """The light of the context."""
    return _sky.get()


def sun_shines() -> bool:
    """True by day: shadows are sharp and water glints."""
    return _sky.get().light == "day"


def light_in_shadow() -> float:
    """Fraction of the light that a full shadow leaves."""
    light = _sky.get().light
    if light == "day":
        return SHADE
    return 1.0 - DUSK_SUN_FRACTION if light == "dusk" else 1.0


def set_sky(spec: Any) -> None:
    """Colours the gradient sky of a model."""
    colours = _SKIES.get(_sky.get().light)
    if colours is None:
        return
    for texture in spec.textures:
        gradient = texture.builtin == mujoco.mjtBuiltin.mjBUILTIN_GRADIENT
        if texture.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX and gradient:
            texture.rgb1, texture.rgb2 = colours


_WAVELENGTHS_UM = np.array([0.65, 0.55, 0.45])
"""of the three colours"""
_HAZE = 0.05
_DUSK_TINT = np.array([1.15, 0.98, 0.82])
_BRIGHTEST_BEAM = 1.2
"""of the sun at dusk on what faces it, 1 for white"""


def air_mass(elevation_deg: float) -> float:
    """Returns the relative air mass between the ground and the sun, 1 at the zenith."""
    zenith_deg = 90.0 - elevation_deg
    cosine = np.cos(np.deg2rad(zenith_deg))
    return float(1.0 / (cosine + 0.50572 * (96.07995 - zenith_deg) ** -1.6364))


def sun_colour(elevation_deg: float) -> Array:
    """Returns (3,) red, green and blue of direct sunlight, the largest of them 1; white at the
    zenith."""
    depth = 0.008735 * _WAVELENGTHS_UM**-4.08 + _HAZE * _WAVELENGTHS_UM**-1.3
    colour: Array = np.exp(-(air_mass(elevation_deg) - air_mass(90.0)) * depth)
    return colour / colour.max()


def _beam(azimuth: float, elevation: float) -> Array:
    """(3,) unit, the direction in which the light of a sun there travels."""
    return -np.array([*np.cos(elevation) * unit(azimuth), np.sin(elevation)])


def lower_sun(light: Any, sun: LowSun, direction: Array) -> Array:
    """Turns and tints a directional light whose light travelled along ``direction`` (3,). Returns
    its new direction, (3,) unit."""
    azimuth = np.arctan2(-direction[1], -direction[0])
    if sun.azimuth_deg is not None:
        azimuth = np.deg2rad(sun.azimuth_deg)
    elevation = np.deg2rad(sun.elevation_deg)
    lowered = _beam(azimuth, elevation)
    level = np.array(light.diffuse) * max(0.0, -float(direction[2]))
    light.dir = lowered
    light.ambient = np.array(light.ambient) + 0.5 * level
    light.diffuse = 0.5 * level.max() / np.sin(elevation) * sun_colour(sun.elevation_deg)
    return lowered


SUN_ELEVATIONS_DEG = (38.0, 62.0)


def draw_sun(
    rng: np.random.Generator, spec: Any, elevations_deg: tuple[float, float] = SUN_ELEVATIONS_DEG
) -> Array:
    """Turns and tints the light `sun`, between ``elevations_deg`` over the horizon. Returns the
    direction in which it travels, (3,) unit."""
    elevation, azimuth = np.deg2rad(rng.uniform(*elevations_deg)), rng.uniform(0.0, 2.0 * np.pi)
    direction = _beam(azimuth, elevation)
    warmth = rng.uniform(0.0, 1.0)
    strength = rng.uniform(0.62, 0.74) / np.sin(elevation) * 0.92
    light = spec.light("sun")
    light.dir = direction
    light.diffuse = strength * np.array([1.0, 0.985 - 0.04 * warmth, 0.95 - 0.12 * warmth])
    return _under_sky(spec, light, direction)


def _under_sky(spec: Any, light: Any, direction: Array) -> Array:
    """Lights a model as the context says by its sun, whose light travelled along ``direction``.
    Returns the direction in which sunlight travels now; that of an overcast day or of a night is
    the old one."""
    sky = present_sky()
    if sky.light == "day":
        return direction if sky.sun is None else lower_sun(light, sky.sun, direction)
    if sky.light == "night":
        _switch_off(spec)
        return direction
    level = np.array(light.diffuse) * max(0.0, -float(direction[2]))
    light.specular = [0.0] * 3
    if sky.light == "overcast":
        light.dir = [0.0, 0.0, -1.0]
        light.diffuse = [float(level.mean())] * 3
        return direction
    azimuth, elevation = np.arctan2(-direction[1], -direction[0]), np.deg2rad(DUSK_SUN_DEG)
    lowered = _beam(azimuth, elevation)
    light.dir = lowered
    light.ambient = np.array(light.ambient) + level * _DUSK_TINT
    beam = DUSK_SUN_FRACTION * level.max() / np.sin(elevation)
    light.diffuse = min(beam, _BRIGHTEST_BEAM) * sun_colour(DUSK_SUN_DEG)
    headlight = spec.visual.headlight
    headlight.ambient = np.array(headlight.ambient) * _DUSK_TINT
    return lowered


def _switch_off(spec: Any) -> None:
    """Puts out every lamp of a model; an even light remains."""
    for lamp in spec.lights:
        lamp.active = False
    headlight = spec.visual.headlight
    headlight.active = 1
    headlight.ambient, headlight.diffuse, headlight.specular = [1.0] * 3, [0.0] * 3, [0.0] * 3


def light_file(spec: Any) -> None:
    """Lights a scene from a file as the context says, by its first directional light; the others
    shine by day alone. A scene without one keeps its lamps until night."""
    sky = present_sky()
    if sky == Sky():
        return
    suns = [a for a in spec.lights if a.type == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL]
    if sky.light == "night" and not suns:
        _switch_off(spec)
    if not suns:
        return
    direction = np.array(suns[0].dir) / np.linalg.norm(suns[0].dir)
    _under_sky(spec, suns[0], direction)
    for other in suns[1:] if sky.light != "day" else ():
        other.active = False


def ground_texture(
    builder: SceneBuilder,
    canvas: Canvas,
    pattern_angles: dict[Ground, float],
    hilly: bool = False,
    slopes: NDArray[np.uint8] | None = None,
) -> Callable[[NDArray[np.uint8]], None]:
    """Returns what fills an image, (rows, cols, 3), top row = y_max, with the ground under the
    light and shadows of everything placed so far. pattern_angles, slopes: as in
    `scenes.authoring.ground.ground_shader`; hilly: as in `bake_light`."""
    pixels = len(canvas.material) // 2
    light = bake_light(builder.casters, builder.terrain, builder.sun, pixels, hilly)
    return ground_shader(builder.rng, canvas, light, pattern_angles, slopes)


_SUBPIXEL_BITS = 4
_SLOPE_STEPS = 3
"""Steps towards the point where a sun ray meets the slope; each shrinks the error by the slope
over the sun's own."""


def bake_light(
    casters: list[Caster],
    terrain: HeightField,
    sun_direction: Array,
    pixels: int,
    hilly: bool = False,
) -> Float32:
    """Returns the fraction of full light on the ground, (pixels, pixels) float32 in (0, 1], row 0
    at y_min.

    sun_direction: (3,) unit, the direction in which the light travels. Casters are projected on the
    level ground at their own foot, or, in ``hilly`` scenes, on the slope that the shadow falls on;
    overlaps multiply."""
    ambient = light_in_shadow()
    cell = 2.0 * terrain.half_m / pixels
    sun = np.ones((pixels, pixels), np.float32)
    sky = np.ones((pixels // 4, pixels // 4), np.float32)
    for caster in casters:
        points = caster.points
        middle = points[:, :2].mean(axis=0)
        ground = terrain.point(*middle)
        height = np.maximum(points[:, 2] - ground, 0.0)
        lift = float(height.min())
        if ambient < 1.0:
            shadow = points[:, :2] - height[:, None] * sun_direction[:2] / sun_direction[2]
            for _ in range(_SLOPE_STEPS if hilly else 0):
                height = np.maximum(points[:, 2] - terrain.at(shadow), 0.0)
                shadow = points[:, :2] - height[:, None] * sun_direction[:2] / sun_direction[2]
            _darken(sun, shadow, terrain.half_m, cell, 1.0 - caster.opacity)
        # Low objects dim the ground around their foot, high crowns hardly do.
        _darken(sky, points[:, :2], terrain.half_m, 4.0 * cell, 1.0 - 0.55 * np.exp(-lift / 1.5))
    soft = cv2.GaussianBlur(sun, (0, 0), 0.8)
    open_sky = cv2.GaussianBlur(sky, (0, 0), 0.35 / (4.0 * cell))
    open_sky = cv2.resize(open_sky, (pixels, pixels), interpolation=cv2.INTER_LINEAR)
    light = np.asarray(soft, np.float32)
    light *= 1.0 - ambient  # in place: each new raster would cost more than the sum
    light += ambient
    sky = np.asarray(open_sky, np.float32)
    sky *= 0.55
    sky += 0.45
    light *= sky
    return light


def _darken(layer: Float32, outline: Array, half_m: float, cell: float, factor: float) -> None:
    """Multiplies the convex hull of ``outline`` (N, 2) metres into ``layer``."""
    hull = cv2.convexHull(((outline + half_m) / cell - 0.5).astype(np.float32))[:, 0]
    (left, right), (low, high) = (_span(axis, len(layer)) for axis in hull.T.tolist())
    if high <= low or right <= left:
        return
    mask = np.zeros((high - low, right - left), np.uint8)
    corners = np.round((hull - (left, low)) * 2**_SUBPIXEL_BITS).astype(np.int32)
    cv2.fillConvexPoly(mask, corners, 255, cv2.LINE_AA, _SUBPIXEL_BITS)
    window = layer[low:high, left:right]
    window *= 1.0 - (1.0 - factor) * (mask.astype(np.float32) / 255.0)


def _span(places: list[float], pixels: int) -> tuple[int, int]:
    """First and past-the-last pixel around ``places``."""
    low, high = math.floor(min(places)) - 1, math.ceil(max(places)) + 2
    return min(max(low, 0), pixels), min(max(high, 0), pixels)
