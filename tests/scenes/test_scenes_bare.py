"""`snow` and `dunes`: relief, ice, tracks, and the light on fine relief."""

import mujoco
import numpy as np
import pytest

from touchdown.scenes.api import LAND_CLASSES, Scene
from touchdown.scenes.authoring.ground import Canvas, Ground
from touchdown.scenes.authoring.micro_relief import (
    NEUTRAL,
    SKIS,
    MicroRelief,
    Ripples,
    footprints,
    parallel,
    runners,
    wander,
)
from touchdown.scenes.authoring.relief import HeightField
from touchdown.scenes.places import dunes
from touchdown.scenes.places.snow import layout as snow
from touchdown.scenes.truth.maps import judge_touchdown

from support.places import cached_scene

FIELD, WATER = LAND_CLASSES.index("field"), LAND_CLASSES.index("water")
SUN = np.array([0.6, 0.0, -0.8])
"""Light that travels to the east."""


def pond_middle(scene: Scene) -> np.ndarray:
    ground = scene.ground
    rows, cols = np.nonzero(ground.class_id == WATER)
    return ground.origin_xy_m + (np.array([np.median(cols), np.median(rows)]) + 0.5) * ground.cell_m


def test_frozen_pond_is_level_water_and_never_safe() -> None:
    scene = cached_scene("snow", 0)
    ground = scene.ground
    assert 80.0 < (ground.class_id == WATER).sum() * ground.cell_m**2 < 350.0
    verdict = judge_touchdown(scene, pond_middle(scene))
    assert verdict.slope_deg < 0.5
    assert not verdict.safe_geometry


def slid_m(scene: Scene, geom_name: str) -> float:
    """Way of a block with the friction of rubber, pushed at 1 m/s over the surface of a geom."""
    spec = mujoco.MjSpec()
    ice = scene.model.geom(geom_name)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[9, 9, 1], friction=ice.friction,
                            priority=int(ice.priority[0]))  # fmt: skip
    body = spec.worldbody.add_body(pos=[0, 0, 0.05])
    body.add_freejoint()
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.1, 0.1, 0.05], mass=1.0,
                  friction=[0.9, 0.01, 0.001])  # fmt: skip
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qvel[0] = 1.0
    for _ in range(2000):
        mujoco.mj_step(model, data)
    return float(data.qpos[0])


def test_ice_is_slippery_and_covers_the_pond() -> None:
    """v^2 / 2 mu g: 0.64 m on ice, 0.13 m on snow, although the feet are of rubber."""
    scene = cached_scene("snow", 0)
    slabs = [n for n in scene.surfaces if n.startswith("water_ice")]
    middle = pond_middle(scene)
    over = [
        n for n in slabs
        if (np.abs(middle - scene.model.geom(n).pos[:2]) <= scene.model.geom(n).size[:2]).all()
    ]  # fmt: skip
    assert len(over) == 1
    assert slid_m(scene, over[0]) == pytest.approx(0.637, rel=0.1)
    assert slid_m(scene, "terrain") == pytest.approx(0.127, rel=0.15)
    # The slab's top is what feet meet, millimetres over what is seen.
    slab, terrain = scene.model.geom(over[0]), scene.model.geom("terrain")
    field = scene.model.hfield_data.reshape(snow.NODES, snow.NODES) * scene.model.hfield_size[0, 2]
    seen = HeightField(heights_m=field + terrain.pos[2], half_m=snow.HALF_M).point(*middle)
    assert 0.001 < slab.pos[2] + slab.size[2] - seen < 0.008


def test_dune_profile_has_the_angle_of_repose_and_a_flat() -> None:
    phase = np.linspace(0.0, 1.0, 4001)
    height, slip = dunes.dune_profile(phase, np.full(4001, 2.5), 30.0)
    slope = np.gradient(height, 30.0 * phase)
    assert height.max() == pytest.approx(2.5, rel=1e-3)
    assert (height[phase < 0.29] == 0.0).all()
    np.testing.assert_allclose(slope[slip > 0.0][2:-2], -np.tan(np.deg2rad(32.0)), rtol=1e-6)
    assert slope.max() < np.tan(np.deg2rad(18.0))


def test_sand_is_nowhere_steeper_than_it_can_lie() -> None:
    for seed in range(3):
        rng = np.random.default_rng(seed)
        plan = dunes.draw_plan(rng)
        relief = dunes.shape_dunes(rng, plan)
        rise = np.gradient(relief.terrain.heights_m, relief.terrain.cell_m)
        steep = np.rad2deg(np.arctan(np.hypot(*rise)))[relief.rock < 0.01]
        # Steeper than 32 degrees where crests turn and two edges of a cell both lie at repose.
        assert np.percentile(steep, 99) < 40.0
        assert 28.0 < np.percentile(steep, 97) < 38.0
        assert (relief.slip > 0.5).mean() > 0.02


def test_light_on_slopes_follows_lambert() -> None:
    """A plane of 20 % that rises to the east is turned to a sun in the west by 1 + 0.2 * 0.75,
    over the length of its normal; half of the light is the sky's, highlights count half."""
    rng = np.random.default_rng(0)
    bright, dark = 1.0 + 0.5 * (1.15 / np.sqrt(1.04) - 1.0), 0.85 / np.sqrt(1.04)
    for slope, facing in ((0.2, bright), (-0.2, dark)):
        fine = MicroRelief(half_m=64.0)
        size = len(fine.drifts_m)
        fine.drifts_m[:] = slope * 128.0 / size * np.arange(size, dtype=np.float32)
        tone = fine.shading(rng, SUN)
        assert tone[2000, 2000] == pytest.approx(NEUTRAL * (0.5 + 0.5 * facing), abs=1.0)
    level = MicroRelief(half_m=64.0).shading(rng, SUN)
    assert (level == NEUTRAL).all()


def test_ripples_have_their_wave_length_across_the_wind() -> None:
    cover = np.ones((8, 8), np.float32)
    ripples = Ripples(wave_m=0.12, height_m=0.008, wind_angle=0.0, cover=cover)
    tone = MicroRelief(half_m=64.0).shading(np.random.default_rng(0), SUN, ripples)
    window = tone[1000:1400, 1000:2024].astype(float) - tone.mean()
    power = (np.abs(np.fft.rfft(window, axis=1)) ** 2).mean(axis=0)
    texel = 128.0 / len(tone)
    wave = 1024 * texel / np.arange(1, len(power))
    strong = np.average(wave, weights=power[1:] * (wave < 1.0))
    assert strong == pytest.approx(0.12, rel=0.2)
    across = (np.abs(np.fft.rfft(window[:, :400], axis=0)) ** 2).mean(axis=1)
    assert across[:20].sum() > 0.5 * across.sum()  # crests run on along y


def test_tracks_press_hollows_with_rims() -> None:
    rng = np.random.default_rng(0)
    fine, canvas = MicroRelief(half_m=64.0), Canvas(half_m=64.0)
    line = wander(rng, np.array([[-10.0, 0.0], [10.0, 0.0]]), 0.0)
    runners(canvas, fine, line, SKIS, Ground.PACKED_SNOW)
    column = fine.prints[:, 2560].astype(int) - 128
    assert column.min() == pytest.approx(-30, abs=3) and column.max() > 2
    deep = np.flatnonzero(column < -20)
    gauge = (deep[deep > 2560].mean() - deep[deep < 2560].mean()) * canvas.texel_m
    assert gauge == pytest.approx(SKIS.apart_m, abs=0.03)
    footprints(rng, canvas, fine, line + [0.0, 5.0], Ground.PACKED_SNOW)
    strip = fine.prints[2700:2820].astype(int) - 128
    assert strip.min() < -55 and strip.max() > 8
    np.testing.assert_allclose(parallel(line, 0.5)[:, 1], 0.5, atol=1e-9)
