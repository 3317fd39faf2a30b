"""Forest, turf, snow, dunes, lake, open water and flat: relief, water, ice, tracks, meshes, and the
light on fine relief."""

import mujoco
import numpy as np
import pytest
from scipy import ndimage

from touchdown.scenes.api import LAND_CLASSES, Scene
from touchdown.scenes.authoring import micro_relief
from touchdown.scenes.authoring.ground import Canvas, Ground
from touchdown.scenes.authoring.plots import draw_frame
from touchdown.scenes.authoring.relief import HALF_M, HeightField
from touchdown.scenes.authoring.water import WaterLook, lay_water
from touchdown.scenes.places import dunes, turf
from touchdown.scenes.places.forest import layout
from touchdown.scenes.places.forest.layout import draw_plan
from touchdown.scenes.places.snow import layout as snow
from touchdown.scenes.places.turf.airfield import fuselage_mesh
from touchdown.scenes.props.woods import canopy_mesh, conifer_mesh, lathe
from touchdown.scenes.truth.maps import judge_touchdown, truth_maps
from touchdown.scenes.truth.static_surface import cast_down, class_ids

from support.places import cached_scene

TREES, WATER = LAND_CLASSES.index("trees"), LAND_CLASSES.index("water")
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
    seen = HeightField(heights_m=field + terrain.pos[2], half_m=HALF_M).point(*middle)
    assert 0.001 < slab.pos[2] + slab.size[2] - seen < 0.008


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
        fine = micro_relief.MicroRelief(half_m=64.0)
        size = len(fine.drifts_m)
        fine.drifts_m[:] = slope * 128.0 / size * np.arange(size, dtype=np.float32)
        tone = fine.shading(rng, SUN)
        assert tone[2000, 2000] == pytest.approx(
            micro_relief.NEUTRAL * (0.5 + 0.5 * facing), abs=1.0
        )
    level = micro_relief.MicroRelief(half_m=64.0).shading(rng, SUN)
    assert (level == micro_relief.NEUTRAL).all()


def test_ripples_have_their_wave_length_across_the_wind() -> None:
    cover = np.ones((8, 8), np.float32)
    ripples = micro_relief.Ripples(wave_m=0.12, height_m=0.008, wind_angle=0.0, cover=cover)
    tone = micro_relief.MicroRelief(half_m=64.0).shading(np.random.default_rng(0), SUN, ripples)
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
    fine, canvas = micro_relief.MicroRelief(half_m=64.0), Canvas(half_m=64.0)
    line = micro_relief.wander(rng, np.array([[-10.0, 0.0], [10.0, 0.0]]), 0.0)
    micro_relief.runners(canvas, fine, line, micro_relief.SKIS, Ground.PACKED_SNOW)
    column = fine.prints[:, 2560].astype(int) - 128
    assert column.min() == pytest.approx(-30, abs=3) and column.max() > 2
    deep = np.flatnonzero(column < -20)
    gauge = (deep[deep > 2560].mean() - deep[deep < 2560].mean()) * canvas.texel_m
    assert gauge == pytest.approx(micro_relief.SKIS.apart_m, abs=0.03)
    micro_relief.footprints(rng, canvas, fine, line + [0.0, 5.0], Ground.PACKED_SNOW)
    strip = fine.prints[2700:2820].astype(int) - 128
    assert strip.min() < -55 and strip.max() > 8
    np.testing.assert_allclose(micro_relief.parallel(line, 0.5)[:, 1], 0.5, atol=1e-9)


def test_forest_is_rugged_and_wooded() -> None:
    scene, rng = cached_scene("forest", 1), np.random.default_rng(1)
    maps = truth_maps(scene, 0.25, np.array([[-42.0, -42.0], [42.0, 42.0]]))
    assert scene.model.hfield_size[0, 2] > 6.0
    ground = layout.shape_ground(rng, draw_plan(rng))
    rise = np.gradient(ground.heights_m, ground.cell_m)
    assert np.percentile(np.rad2deg(np.arctan(np.hypot(*rise))), 90) > 20.0
    assert 0.45 < (maps.class_id == TREES).mean() < 0.95
    assert (maps.class_id == WATER).any()


def test_brook_falls_all_the_way_below_the_ground() -> None:
    for seed in range(6):
        rng = np.random.default_rng(seed)
        plan = draw_plan(rng)
        ground = HeightField(heights_m=layout.hills(rng), half_m=64.0)
        bed = layout.brook_profile(plan.brook, ground)
        inside = (np.abs(plan.brook.line_m) < 62.0).all(axis=1)
        steps = np.diff(bed[inside])
        assert (steps < 1e-9).all() or (steps > -1e-9).all()
        assert abs(steps.sum()) >= 0.8 * 0.012 * inside.sum()
    assert layout.WATER_DEPTH_M < layout.BROOK_DEPTH_M


def test_clearings_have_the_slope_of_their_kind() -> None:
    """The plane fitted to the middle of a clearing: level where it is safe, steep where not."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        plan = draw_plan(rng)
        terrain = layout.shape_ground(rng, plan)
        for clearing in plan.clearings:
            grid = np.stack(np.meshgrid(*2 * [np.linspace(-3.0, 3.0, 13)]), axis=-1).reshape(-1, 2)
            z = terrain.at(clearing.centre_xy_m + grid)
            slope = np.linalg.lstsq(np.column_stack([grid, np.ones(len(grid))]), z, rcond=None)[0]
            degrees = np.rad2deg(np.arctan(np.hypot(*slope[:2])))
            if clearing.kind in ("start", "meadow", "plot"):
                assert degrees < 4.0
            elif clearing.kind == "slope":
                assert degrees > 8.0


def test_meshes_are_wound_outwards() -> None:
    """Face normals point away from the axis or the middle for most of the area."""
    rng = np.random.default_rng(0)
    stations = np.array([[2.0, 0.2, 0.0], [0.0, 0.6, 0.0], [-2.0, 0.2, 0.0]])
    shapes = {
        "canopy": canopy_mesh(rng, np.array([3.0, 3.0, 2.4]), 10, 2.0),
        "trunk": lathe(rng, np.array([[-1.0, 0.3], [1.0, 0.2]]), 9, 0.05),
        "fuselage": fuselage_mesh(stations),
    }
    for name, mesh in shapes.items():
        corner = mesh.vertices[mesh.faces]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        outward = (normal * corner.mean(axis=1)).sum(axis=1)
        area = np.linalg.norm(normal, axis=1)
        assert area[outward > 0.0].sum() > 0.97 * area.sum(), name
    spruce = conifer_mesh(rng, 10.0, 2.4)
    assert spruce.vertices[:, 2].max() == pytest.approx(10.0)
    assert np.hypot(*spruce.vertices[:, :2].T).max() < 1.15 * 2.4


RAFT_AND_ISLET = (0, 5)
"""Seeds of `open_water`"""


def around_takeoff(scene: Scene, half_m: float) -> np.ndarray:
    return np.stack([scene.takeoff_xy_m - half_m, scene.takeoff_xy_m + half_m])


def below(scene: Scene, cell_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Heights, geoms and classes of the whole scene, seen from above."""
    low, high = scene.bounds_xy_m
    shape = tuple(np.round((high - low)[::-1] / cell_m).astype(int))
    heights, geoms = cast_down(scene, low, cell_m, (shape[0], shape[1]))
    return heights, geoms, class_ids(scene, low, cell_m, heights, geoms)


def test_lake_water_is_level_and_never_safe() -> None:
    scene = cached_scene("lake", 0)
    heights, geoms, classes = below(scene, 0.5)
    wet = (classes == WATER) & (geoms == scene.model.geom("terrain").id)
    level = float(np.median(heights[wet]))
    # Where a bank is steep, the triangle that holds the waterline rises out of the water.
    assert (np.abs(heights[wet] - level) < 1e-3).mean() > 0.97
    assert np.abs(heights[wet] - level).max() < 0.25
    ground = (classes != WATER) & (geoms == scene.model.geom("terrain").id)
    assert heights[ground].min() > level - 1e-3
    assert 0.08 < wet.mean() < 0.35
    maps = truth_maps(scene, 0.25)
    water = maps.class_id == WATER
    assert not (maps.safe_geometry & water).any()
    assert 0.1 < maps.safe.mean() < 0.7


@pytest.mark.parametrize("seed", RAFT_AND_ISLET)
def test_open_water_is_safe_at_the_takeoff_spot_only(seed: int) -> None:
    scene = cached_scene("open_water", seed)
    maps = truth_maps(scene, 0.2, around_takeoff(scene, 40.0))
    rows, cols = np.nonzero(maps.safe)
    assert 5.0 < len(rows) * 0.04 < 150.0
    points = maps.origin_xy_m + (np.stack([cols, rows], axis=-1) + 0.5) * maps.cell_m
    assert np.linalg.norm(points - scene.takeoff_xy_m, axis=1).max() < 8.0
    assert not (maps.safe_geometry & (maps.class_id == WATER)).any()
    assert (maps.class_id == WATER).mean() > 0.9


def test_water_hides_the_bottom_with_depth() -> None:
    """Red light is dimmed first: a bright bottom turns from its own colour to the body's."""
    size = 512
    depth = np.repeat(np.linspace(-1.0, 8.0, size, dtype=np.float32)[None], size, axis=0)
    image = np.full((size, size, 3), 200, np.uint8)
    look = WaterLook(body=(20.0, 60.0, 80.0), clarity_m=(0.5, 1.0, 1.2), ripple=0.2)
    sun = np.array([0.5, 0.0, -np.sqrt(0.75)])
    lay_water(np.random.default_rng(1), image, depth, 12.0, look, sun)
    columns = image.mean(axis=0)
    dry, shallow, deep = columns[:40], columns[75:80], columns[-60:]
    assert (dry == 200.0).all()
    assert (shallow[:, 0].mean() < shallow[:, 2].mean() < 200.0) and shallow[:, 0].mean() > 60.0
    np.testing.assert_allclose(deep.mean(axis=0), look.body, atol=14.0)


@pytest.mark.parametrize("seed", [0, 2])  # a pitch and an airfield
def test_puddles_on_turf_are_level(seed: int) -> None:
    rng = np.random.default_rng(0)
    frame = draw_frame(rng)
    terrain, depth = turf.shape_ground(rng, frame, turf.draw_turf(seed, rng, frame))
    labels, count = ndimage.label(depth > 0.0)
    spans = [np.ptp(terrain.heights_m[labels == n]) for n in range(1, count + 1)]
    assert spans and max(spans) < 1e-6


def test_dunes_rise_gently_from_a_flat() -> None:
    phase = np.linspace(0.0, 1.0, 4001)
    height, _ = dunes.dune_profile(phase, np.full(4001, 2.5), 30.0)
    assert height.max() == pytest.approx(2.5, rel=1e-3) and not height[phase < 0.29].any()
    assert np.gradient(height, 30.0 * phase).max() < np.tan(np.deg2rad(18.0))


def test_a_ditch_runs_beside_the_path_of_a_pitch() -> None:
    rng = np.random.default_rng(0)
    pitch = turf.draw_turf(0, rng, draw_frame(rng))
    ditch, path = (
        pitch.plot.coordinates(line)
        for line in (np.array([pitch.ditch.start_xy_m, pitch.ditch.end_xy_m]), pitch.path)
    )
    beyond = (ditch[:, 1] - path[0, 1]) * np.sign(path[0, 1])
    assert beyond == pytest.approx([3.2, 2.2], abs=1e-6)


def test_an_airfield_has_a_hangar_and_a_club() -> None:
    scene = cached_scene("turf", 2)
    names = [scene.model.geom(index).name for index in range(scene.model.ngeom)]
    assert sum(name.startswith("building_wall") for name in names) == 2


def test_sastrugi_are_longer_along_the_wind_than_across() -> None:
    """Ridges 3.6 times as long as wide: an equal drop of the correlation that much farther."""
    rng = np.random.default_rng(4)
    plan = snow.draw_plan(rng)
    along = np.array([np.cos(plan.wind_angle), np.sin(plan.wind_angle)])
    left = np.array([-along[1], along[0]])
    u, v = np.meshgrid(np.arange(0.0, 60.0, 0.1), np.arange(0.0, 60.0, 0.1))
    field = snow.sastrugi(rng, plan, u[..., None] * along + v[..., None] * left, 1.7)
    rows, columns = (
        np.mean((field - np.roll(field, 8, axis=axis))[8:, 8:] ** 2) for axis in (0, 1)
    )  # over 0.8 m across and along
    assert 4.0 < rows / columns < 12.0
    assert np.abs(np.diff(field, axis=1)).max() < 0.4  # without breaks
