"""Day, overcast, dusk and night: the same places under another light."""

from itertools import pairwise

import mujoco
import numpy as np
import pytest
from numpy.random import default_rng
from numpy.typing import NDArray

from touchdown.scenes.api import LIGHT_LUX, Light
from touchdown.scenes.authoring.builder import Caster
from touchdown.scenes.authoring.light import (
    DUSK_SUN_DEG,
    DUSK_SUN_FRACTION,
    bake_light,
    draw_sun,
    lit_by,
)
from touchdown.scenes.authoring.relief import HeightField

from support.places import scene_of

LIGHTS: tuple[Light, ...] = ("day", "overcast", "dusk", "night")

FILE = """<mujoco>
  <asset><texture name="sky" type="skybox" builtin="gradient" rgb1="0.4 0.6 0.9" rgb2="0.9 0.9 1"
          width="64" height="64"/></asset>
  <worldbody>
    <light name="lamp" pos="0 0 5" dir="0 0 -1" diffuse="1 1 1"/>
    <light name="high" type="directional" dir="0.3 0 -1" diffuse="0.7 0.7 0.7"/>
    <light name="fill" type="directional" dir="-0.3 0 -1" diffuse="0.2 0.2 0.2"/>
    <geom name="lawn_floor" type="plane" size="60 60 0.1"/>
  </worldbody></mujoco>"""


def suns() -> dict[Light, tuple[mujoco.MjSpec, NDArray[np.float64], float]]:
    """By light: a model with a sun drawn from one seed, the way its light travels, and the number
    that the generator draws next."""
    drawn: dict[Light, tuple[mujoco.MjSpec, NDArray[np.float64], float]] = {}
    for light in LIGHTS:
        spec, rng = mujoco.MjSpec.from_string(FILE.replace("high", "sun")), default_rng(3)
        with lit_by(light):
            drawn[light] = spec, draw_sun(rng, spec), rng.uniform()
    return drawn


def test_the_sun_of_each_light() -> None:
    """Overcast light comes from above and is grey, as strong on level ground as the sun's; the
    sun of dusk is 2 degrees high, where it stood by day, and red; at night nothing shines. None
    draws a number, so that the place is the same."""
    made = suns()
    assert len({number for _, _, number in made.values()}) == 1
    lights = {name: spec.light("sun") for name, (spec, _, _) in made.items()}
    direction, colour = lights["day"].dir, lights["day"].diffuse
    np.testing.assert_allclose(lights["overcast"].dir, [0.0, 0.0, -1.0], atol=1e-6)
    grey = lights["overcast"].diffuse
    assert np.ptp(grey) < 1e-6
    assert grey.mean() == pytest.approx(-direction[2] * colour.mean(), rel=1e-3)
    np.testing.assert_allclose(made["overcast"][1], direction, atol=1e-6)
    low, red = lights["dusk"].dir, lights["dusk"].diffuse
    assert np.rad2deg(np.arcsin(-low[2])) == pytest.approx(DUSK_SUN_DEG, abs=0.01)
    assert low[0] * direction[1] == pytest.approx(low[1] * direction[0], abs=1e-6)
    assert red[0] > 1.5 * red[1] > 1.5 * red[2]
    assert not any(lamp.active for lamp in made["night"][0].lights)
    np.testing.assert_array_equal(made["night"][0].visual.headlight.ambient, 1.0)
    assert tuple(LIGHT_LUX) == LIGHTS
    lux = list(LIGHT_LUX.values())
    assert all(brighter > 5.0 * dimmer for brighter, dimmer in pairwise(lux))


def test_shadows_are_those_of_the_light() -> None:
    """A wall 4 m high: by day its shadow keeps half of the light, at dusk three quarters and is
    longer; under clouds and at night only its foot is dimmed, and the ground beyond is even."""
    terrain = HeightField(heights_m=np.zeros((65, 65)), half_m=32.0)
    corners = [(x, y, z) for x in (-1.0, 1.0) for y in (-8.0, 8.0) for z in (0.0, 4.0)]
    wall = Caster(points=np.array(corners), opacity=1.0)
    sun = np.array([np.cos(0.8), 0.0, -np.sin(0.8)])
    low = np.array([np.cos(0.2), 0.0, -np.sin(0.2)])

    def baked(light: Light, direction: NDArray[np.float64]) -> NDArray[np.float32]:
        with lit_by(light):
            return bake_light([wall], terrain, direction, 256)[128]

    place = {x: 128 + 4 * x for x in (3, 12, 25)}
    day, dusk = baked("day", sun), baked("dusk", low)
    assert day[place[3]] == pytest.approx(0.5, abs=0.03)
    assert day[place[12]] == pytest.approx(1.0, abs=0.01)
    assert dusk[place[12]] == pytest.approx(1.0 - DUSK_SUN_FRACTION, abs=0.03)
    assert dusk[place[25]] == pytest.approx(1.0, abs=0.01)
    for light in ("overcast", "night"):
        even = baked(light, sun)  # type: ignore[arg-type]
        assert even[place[3]] == pytest.approx(1.0, abs=0.02)
        assert even[128] == pytest.approx(0.45 + 0.55 * 0.45, abs=0.02)


def test_scenes_from_files_have_every_light() -> None:
    day, overcast, dusk, night = (scene_of(FILE, light=light).model for light in LIGHTS)
    active = {
        name: [bool(m.light(name).active[0]) for m in (day, overcast, dusk, night)]
        for name in ("lamp", "high", "fill")
    }
    assert active["high"] == [True, True, True, False]
    assert active["fill"] == [True, False, False, False]
    assert active["lamp"] == [True, True, True, False]
    np.testing.assert_allclose(overcast.light("high").dir, [0.0, 0.0, -1.0], atol=1e-6)
    assert -dusk.light("high").dir[2] == pytest.approx(np.sin(np.deg2rad(DUSK_SUN_DEG)), abs=1e-4)
    skies = [m.tex_data[: 64 * 64 * 3].mean() for m in (day, overcast, dusk, night)]
    assert skies[3] < 0.3 * skies[0]
    assert len({round(float(s)) for s in skies}) == 4
