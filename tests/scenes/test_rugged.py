"""`rugged`: its dials are met by the relief, the rocks and the safe ground, and what is seen of it
is what rays and feet meet."""

import dataclasses
import functools
import itertools
from typing import Any

import mujoco
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from touchdown.experiments.cli import main as cli
from touchdown.experiments.config.loading import load_config
from touchdown.experiments.errors import UsageError
from touchdown.scenes.api import RuggedParams, Scene
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.ground import Canvas, Ground
from touchdown.scenes.authoring.relief import HALF_M, HeightField
from touchdown.scenes.compose import load_scene
from touchdown.scenes.places.rugged import objects, paint, rocks
from touchdown.scenes.places.rugged.presets import PRESETS, Dials
from touchdown.scenes.places.rugged.relief import (
    CELL_M,
    NODES,
    grooves,
    mean_slope_deg,
    relief_m,
    roughness,
    shape_ground,
    snow_depth,
)
from touchdown.scenes.places.rugged.safe_ground import SafeGround, rule_map
from touchdown.scenes.truth.maps import truth_maps
from touchdown.scenes.truth.static_surface import cast_points

AREA_M2 = (2.0 * HALF_M) ** 2


def dials(**given: Any) -> Dials:
    return Dials.of(RuggedParams(**given))


@functools.cache
def scene() -> Scene:
    params = RuggedParams(preset="lava", safe_fraction=0.08, rock_abundance=0.06)
    return load_scene("rugged", 9001, dials=params)


@pytest.mark.parametrize("k", [0.02, 0.1, 0.3])
def test_rocks_cover_what_the_law_says(k: float) -> None:
    found = rocks.draw_rocks(np.random.default_rng(1), k, AREA_M2, np.ones((8, 8)))
    area = 0.25 * np.pi * found.diameter_m**2 / AREA_M2
    assert found.diameter_m.min() >= 0.1
    for diameter in (0.1, 0.2, 0.4, 0.8):
        covered = float(area[found.diameter_m >= diameter].sum())
        law = k * np.exp(-(1.79 + 0.152 / k) * diameter)
        if law * AREA_M2 > 20.0:  # else a few large rocks are chance
            assert covered == pytest.approx(law, rel=0.12), diameter
    assert len(rocks.draw_rocks(np.random.default_rng(1), 0.0, AREA_M2, np.ones((8, 8)))[0]) == 0


def test_density_is_where_rocks_lie() -> None:
    density = np.zeros((4, 4))
    density[1, 2] = 1.0
    found = rocks.draw_rocks(np.random.default_rng(1), 0.1, AREA_M2, density)
    assert (found.xy_m >= [0.0, -32.0]).all() and (found.xy_m <= [32.0, 0.0]).all()


@pytest.mark.parametrize("shape", [rocks.ROUND, rocks.SLAB, rocks.ANGULAR])
def test_a_rock_in_the_ground_and_as_a_body_has_its_size(shape: int) -> None:
    one = rocks.Rocks(np.array([[3.0, -5.0]]), np.array([2.0]), np.array([1.5]), np.array([0.4]),
                      np.array([shape]), np.array([0.9]), np.array([0.3]))  # fmt: skip
    raised = rocks.heap(one, 2561)
    cell = 2.0 * HALF_M / 2560
    assert (raised > 0.0).sum() * cell**2 == pytest.approx(np.pi, rel=0.08)
    assert 0.75 <= raised.max() / 0.9 <= 1.02
    row, col = np.argwhere(raised > 0.0).mean(axis=0)
    assert np.hypot(col * cell - HALF_M - 3.0, row * cell - HALF_M + 5.0) < 0.1
    body = rocks.boulder_mesh(np.random.default_rng(2), one, 0, 1.0)
    assert ConvexHull(body.vertices[:, :2]).volume == pytest.approx(np.pi, rel=1e-6)
    assert body.vertices[:, 2].max() == pytest.approx(0.9) and body.vertices[:, 2].min() < -0.2
    corners = body.vertices[body.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((normal * (corners.mean(axis=1) - body.vertices.mean(axis=0))).sum(axis=1) > 0.0).all()


def test_a_rock_narrower_than_two_cells_is_not_lost() -> None:
    small = rocks.draw_rocks(np.random.default_rng(3), 0.05, AREA_M2, np.ones((8, 8)))
    small = small.only(small.diameter_m < 0.15)
    for index in range(12):
        one = small.only(np.array([index]))
        assert rocks.heap(one, NODES).max() > 0.6 * one.height_m[0]


@pytest.mark.parametrize("given", [
    {"preset": "felled_forest", "slope_deg": 0.0}, {"preset": "alpine", "slope_deg": 25.0},
    {"preset": "quarry", "slope_deg": 10.0}, {"preset": "gully", "slope_deg": 12.0},
])  # fmt: skip
def test_mean_slope_is_the_dial_s(given: dict[str, Any]) -> None:
    ground = shape_ground(np.random.default_rng(4), dials(**given))
    assert mean_slope_deg(ground, CELL_M) == pytest.approx(given["slope_deg"], abs=0.6)


def test_relief_is_the_dial_s_where_the_slope_allows_it() -> None:
    found = [
        relief_m(shape_ground(np.random.default_rng(5), dials(
            preset="felled_forest", slope_deg=10.0, relief_m=wanted)))
        for wanted in (4.0, 9.0, 16.0)
    ]  # fmt: skip
    np.testing.assert_allclose(found, (4.0, 9.0, 16.0), rtol=0.15)


def test_relief_has_the_spectrum_of_the_preset() -> None:
    ground = shape_ground(np.random.default_rng(6), dials(preset="felled_forest"))
    axis = np.linspace(-1.0, 1.0, NODES)
    plane = np.stack(np.broadcast_arrays(1.0, axis, axis[:, None]), axis=-1).reshape(-1, 3)
    fit = np.linalg.lstsq(plane, ground.ravel(), rcond=None)[0]
    ground -= (plane @ fit).reshape(ground.shape)
    side = NODES - 1
    window = np.hanning(side)
    power = np.abs(np.fft.rfft2(ground[:side, :side] * window[:, None] * window)) ** 2
    waves = np.hypot(np.fft.fftfreq(side, 1.0 / side)[:, None], np.arange(side // 2 + 1))
    edges = np.geomspace(4.0, 100.0, 11)
    rings = [(waves >= a) & (waves < b) for a, b in itertools.pairwise(edges)]
    fit = np.polyfit(np.log(np.sqrt(edges[:-1] * edges[1:])),
                     np.log([power[ring].mean() for ring in rings]), 1)  # fmt: skip
    assert -fit[0] == pytest.approx(PRESETS["felled_forest"].spectrum, abs=0.25)


@pytest.mark.parametrize(("given", "seed"), [
    ({"preset": "felled_forest", "slope_deg": 1.0}, 9002),  # too much is safe
    ({"preset": "alpine", "slope_deg": 22.0}, 9003),  # too little
    ({"preset": "quarry"}, 9004),
])  # fmt: skip
@pytest.mark.parametrize("fraction", [0.005, 0.05, 0.25])
def test_safe_fraction_is_reached(given: dict[str, Any], seed: int, fraction: float) -> None:
    rng = np.random.default_rng(seed)
    made = dials(**given)
    ground = shape_ground(rng, made) + roughness(rng, made)
    lying = rocks.draw_rocks(rng, 0.05, AREA_M2, np.ones((8, 8)))
    safe = SafeGround(rng=rng, heights=ground, things=rocks.heap(lying, NODES))
    reached = safe.reach(fraction, np.array([-20.0, -15.0]))
    assert reached == pytest.approx(fraction, rel=0.25)
    assert reached == rule_map(safe.heights + safe.things).mean()
    clear = safe.clear(lying.xy_m, 0.5 * lying.diameter_m)
    assert 0 < (~clear).sum() < 0.7 * len(clear)


def test_grooves_and_snow_cover_what_they_should() -> None:
    rng, made = np.random.default_rng(7), dials(preset="lava", groove_fraction=0.03)
    cut = grooves(rng, made)
    assert (cut > 0.05).mean() == pytest.approx(0.03, rel=0.4) and cut.max() < 0.8
    assert not grooves(rng, dials(groove_fraction=0.0)).any()
    ground = shape_ground(rng, dials(preset="alpine"))
    assert (snow_depth(rng, ground) > 0.05).mean() == pytest.approx(0.25, abs=0.08)


def test_a_wall_throws_the_shadow_of_its_height() -> None:
    """A sun 45 degrees high over a wall of 1 m, from all sides."""
    heights = np.zeros((60, 60), np.float32)
    heights[28:32, 28:32] = 1.0
    for way in ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)):
        sun = np.array([*way, -1.0]) / np.sqrt(2.0)
        depth = paint.shadow_depth(heights, sun, 0.1)
        ahead = np.round(30 + np.arange(3, 20) * way[0]).astype(int)
        aside = np.round(30 + np.arange(3, 20) * way[1]).astype(int)
        assert int((depth[aside, ahead] > 0.05).sum()) == pytest.approx(9, abs=2)
        assert depth[30 - int(5 * way[1]), 30 - int(5 * way[0])] < 1e-3


def test_pads_lie_apart_and_nothing_lies_on_them() -> None:
    """Logs of 2 to 10 m, felled about the same way; scrub beside the pads alone."""
    rng = np.random.default_rng(5)
    given = dials(preset="felled_forest", safe_fraction=0.1)
    ground = shape_ground(rng, given)
    safe = SafeGround(rng=rng, heights=ground, things=np.zeros_like(ground))
    safe.reach(0.1, np.zeros(2))
    middles = np.array([pad.xy_m for pad in safe.pads])
    reach = np.array([pad.reach_m for pad in safe.pads])
    room = np.linalg.norm(middles[:, None] - middles, axis=-1) - reach[:, None] - reach
    assert len(middles) > 20 and room[~np.eye(len(room), dtype=bool)].min() > 1.3
    plants = objects.draw_plants(rng, given)
    ways = plants.logs[:, 2:] - plants.logs[:, :2]
    inside = (np.abs(plants.logs) < HALF_M - 1.5).all(axis=1)
    lengths = np.linalg.norm(ways[inside], axis=1)
    assert 2.0 <= lengths.min() < 4.0 and 8.0 < lengths.max() <= 10.0
    mean = np.abs(np.mean(np.exp(1j * np.arctan2(ways[inside, 1], ways[inside, 0]))))
    assert mean == pytest.approx(np.exp(-0.5 * 0.45**2), abs=0.1)
    scrub = dataclasses.replace(plants, scrub=rng.uniform(-20.0, 20.0, (60, 2)))
    flat = HeightField(heights_m=np.zeros((2, 2)))
    builder = SceneBuilder(spec=mujoco.MjSpec(), rng=rng, terrain=flat, sun=-np.eye(3)[2])
    objects.place_plants(builder, scrub, safe)
    bushes = [geom.pos[:2] for geom in builder.spec.geoms if geom.name.startswith("trees_scrub")]
    assert 10 < len(bushes) < 60
    assert min(pad.distance(bush) for bush in bushes for pad in safe.pads) > 0.7


def test_the_truth_maps_find_the_safe_fraction() -> None:
    place = scene()
    maps = truth_maps(place, 0.2)
    assert place.facts["safe_fraction_wanted"] == 0.08
    assert place.facts["safe_fraction"] == pytest.approx(0.08, rel=0.2)
    assert maps.safe_geometry.mean() == pytest.approx(0.08, rel=0.3)
    assert (maps.safe & ~maps.safe_geometry).sum() == 0


def test_feet_stand_on_the_rocks_that_rays_meet() -> None:
    """A ball dropped on a rock of the ground comes to touch it at the height of the truth."""
    place = scene()
    model = place.model
    field = model.hfield_data.reshape(NODES, NODES) * model.hfield_size[0, 2]
    bumps = field - np.median([np.roll(field, (i, j), (0, 1)) for i in (-3, 3) for j in (-3, 3)], 0)
    row, col = np.unravel_index(bumps[40:-40, 40:-40].argmax(), (NODES - 80, NODES - 80))
    xy = np.array([col + 40, row + 40]) * CELL_M - HALF_M
    top = float(cast_points(place, xy[None])[0][0])
    below = cast_points(place, xy + 0.8 * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]]))[0]
    assert top > np.median(below) + 0.15
    data = mujoco.MjData(model)
    data.qpos[:3] = [*xy, top + 1.2]
    mujoco.mj_forward(model, data)
    lowest = np.inf
    for _ in range(400):
        mujoco.mj_step(model, data)
        if data.ncon:
            lowest = float(data.contact.pos[:, 2].max())
            break
    assert lowest == pytest.approx(top, abs=0.45) and lowest > np.median(below) - 0.3


@pytest.mark.parametrize(("override", "words"), [
    (["rugged.slope_deg=40"], ["rugged.slope_deg = 40", "0 to 25"]),
    (["rugged.safe_fraction=0.5"], ["rugged.safe_fraction", "0.003 to 0.3"]),
    (["rugged.preset=moon"], ["rugged.preset", "alpine"]),
    (["rugged.cover=mud"], ["rugged.cover", "scree"]),
    (["rugged.slope=3"], ["rugged.slope_deg"]),
    (["scene=forest", "rugged.slope_deg=3"], ["rugged.slope_deg", "'forest'"]),
])  # fmt: skip
def test_a_wrong_dial_is_named_in_one_line(override: list[str], words: list[str]) -> None:
    with pytest.raises(UsageError) as caught:
        load_config(None, ["scene=rugged", *override])
    message = str(caught.value)
    assert "\n" not in message and all(word in message for word in words), message


@pytest.mark.parametrize("command", [["check", "--seeds", "1"], ["render"]])
def test_commands_about_scenes_take_dials(command: list[str]) -> None:
    assert cli.main(["scenes", *command, "flat", "--set", "rugged.slope_deg=3"]) == 2


def test_dials_override_the_preset() -> None:
    made = dials(preset="lava", slope_deg=0.0, cover="scree")
    assert (made.slope_deg, made.cover) == (0.0, "scree")
    assert made.rock_abundance == PRESETS["lava"].rock_abundance
    config = load_config(None, ["scene=rugged", "rugged.preset=lava", "rugged.slope_deg=0"])
    assert Dials.of(config.rugged).slope_deg == 0.0


@pytest.mark.parametrize("deep", [0.0, 0.4])
def test_snow_is_white_where_it_lies_and_nowhere_else(deep: float) -> None:
    """On the western half of level ground, without rocks and tussocks."""
    rng, level = np.random.default_rng(2), np.zeros((NODES, NODES))
    snow = level.copy()
    snow[:, : NODES // 2] = deep
    canvas = Canvas.of_size(2.0 * HALF_M, paint.TEXELS)
    none = rocks.draw_rocks(rng, 0.0, 1.0, np.ones((8, 8)))
    paint.paint_ground(rng, canvas, dials(preset="alpine"), level, snow, level, none, none)
    white = (canvas.material == int(Ground.SNOW)).mean(axis=0)
    edge = paint.TEXELS // 20
    west, east = white[: paint.TEXELS // 2 - edge], white[paint.TEXELS // 2 + edge :]
    assert east.max() < 0.05 and (west.min() > 0.95 if deep else west.max() == 0.0)
