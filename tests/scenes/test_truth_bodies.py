"""Truth maps against MuJoCo's single rays: geoms on any body, of any type, in any attitude, and
every shipped scene, of which ``-m slow -s`` prints the figures."""

import numpy as np
import pytest

from touchdown.scenes.api import Scene
from touchdown.scenes.registry import scene_names
from touchdown.scenes.truth.maps import judge_touchdown, truth_maps
from touchdown.scenes.truth.static_surface import cast_points

from support.places import cached_scene, scene_of, scene_on_lawn
from support.truth_rays import SingleRays

FORMS = {
    "box": "1.0 0.8 1.2", "sphere": "1.1", "capsule": "0.6 1.0", "cylinder": "0.9 1.1",
    "ellipsoid": "1.2 0.8 0.9",
}  # fmt: skip
NEST = ("{0}", "<body>{0}</body>", "<body pos='2 -1 0.2'><body euler='0 0 30'>{0}</body></body>")


def forms(rng: np.random.Generator) -> str:
    """Twelve geoms of all forms in any attitude, in turn on the world, a body and nested ones."""
    xml = ""
    for number in range(12):
        kind = list(FORMS)[number % len(FORMS)]
        x, y = (number % 4) * 5.0 - 8.0, (number // 4) * 5.0 + 3.0
        turn = " ".join(f"{angle:.3f}" for angle in rng.uniform(0.0, 360.0, 3))
        geom = (
            f"<geom name='building_{number}' type='{kind}' size='{FORMS[kind]}' "
            f"pos='{x} {y} {rng.uniform(0.0, 2.0):.3f}' euler='{turn}'/>"
        )
        xml += NEST[number % len(NEST)].format(geom)
    return xml


def check_against_single_rays(scene: Scene, points: np.ndarray) -> None:
    """All heights within 1 cm of ``mj_ray`` and all geoms equal but at edges, which are few."""
    rays = SingleRays(scene)
    heights, geoms = cast_points(scene, points)
    wrong, edges = rays.disagreements(points, heights)
    assert wrong.size == 0, points[wrong]
    assert edges <= 0.01 * len(points)
    others = [i for i, point in enumerate(points) if rays.cast(point)[1] != geoms[i]]
    assert all(rays.is_edge(points[i]) for i in others)


@pytest.mark.parametrize("layout", range(5))
def test_every_form_in_every_attitude_is_seen(layout: int) -> None:
    rng = np.random.default_rng([layout, 23])
    scene = scene_on_lawn(forms(rng))
    check_against_single_rays(scene, rng.uniform([-14.0, -4.0], [14.0, 18.0], (1500, 2)))


def test_meshes_and_fields_are_seen() -> None:
    """A mesh, two height fields, one of them turned and not square, and a tilted plane that ends,
    all on one body."""
    rng = np.random.default_rng(5)
    field = " ".join(f"{z:.3f}" for z in rng.uniform(0.0, 1.0, 6 * 9))
    other = " ".join(f"{z:.3f}" for z in rng.uniform(0.0, 1.0, 5 * 5))
    assets = (
        "<mesh name='wedge' vertex='0 0 0  3 0 0  0 3 0  0 0 2  2 2 3'/>"
        f"<hfield name='a' nrow='6' ncol='9' size='4 2 1.5 0.5' elevation='{field}'/>"
        f"<hfield name='b' nrow='5' ncol='5' size='2 2 1 0.5' elevation='{other}'/>"
    )
    things = (
        "<body name='all' pos='0 0 0.3'><body euler='0 0 20'>"
        "<geom name='building_w' type='mesh' mesh='wedge' pos='6 6 0' euler='10 20 30'/>"
        "<geom name='field_a' type='hfield' hfield='a' pos='-8 6 0'/>"
        "<geom name='field_b' type='hfield' hfield='b' pos='4 -8 0' euler='0 8 15'/>"
        "<geom name='road_p' type='plane' size='2 3 1' pos='-8 -6 1' euler='12 0 40'/>"
        "</body></body>"
    )
    scene = scene_on_lawn(things, assets)
    points = rng.uniform(-14.0, 14.0, (3000, 2))
    check_against_single_rays(scene, points)
    names = {scene.model.geom(int(g)).name for g in cast_points(scene, points)[1]}
    assert names == {"lawn", "building_w", "field_a", "field_b", "road_p"}


def test_signed_distance_shapes_are_seen() -> None:
    """MuJoCo marches along a ray until it is near enough to such a shape; a few rays pass it."""
    corners = " ".join(f"{x} {y} {z}" for x in (-1, 1) for y in (-1, 1) for z in (-1, 1))
    things = (
        "<body pos='5 5 1' euler='0 0 20'>"
        "<geom name='building_s' type='sdf' mesh='cube' euler='10 15 0'/></body>"
    )
    scene = scene_on_lawn(things, f"<mesh name='cube' vertex='{corners}'/>")
    points = np.random.default_rng(2).uniform(4.4, 5.6, (400, 2))
    heights, geoms = cast_points(scene, points)
    assert {scene.model.geom(int(g)).name for g in geoms} == {"building_s"}
    true = SingleRays(scene).heights(points)
    passed = np.abs(heights - true) > 0.01
    assert passed.mean() < 0.02 and (heights[passed] > true[passed]).all()


def test_planes_are_infinite_where_they_have_no_size() -> None:
    """Far outside of the scene, level and tilted, and in one direction only; never from below."""
    scene = scene_of(
        "<mujoco><worldbody><geom name='lawn' type='plane' size='0 0 1' pos='300 0 0'/>"
        "<body><geom name='road' type='plane' size='0 2 1' pos='0 20 0.5'/>"
        "<geom name='field' type='plane' size='0 0 1' pos='0 200 -1' euler='5 0 0'/>"
        "<geom name='path' type='plane' size='0 0 1' pos='0 0 30' euler='180 0 0'/></body>"
        "</worldbody></mujoco>"
    )
    points = np.array([[0.0, 0.0], [900.0, 21.0], [-3000.0, 19.0], [70.0, 260.0], [0.0, -900.0]])
    check_against_single_rays(scene, points)


def test_what_cannot_be_seen_and_can_be_touched_has_a_height_and_no_class() -> None:
    things = (
        "<geom name='building_hull' type='box' size='2 2 0.5' pos='6 0 0.5' rgba='1 1 1 0'/>"
        "<geom name='trees_ghost' type='box' size='2 2 0.5' pos='-6 0 0.5' rgba='1 1 1 0' "
        "contype='0' conaffinity='0'/>"
    )
    scene = scene_on_lawn(things)
    heights, geoms = cast_points(scene, np.array([[6.0, 0.0], [-6.0, 0.0]]))
    np.testing.assert_allclose(heights, [1.0, 0.0], atol=1e-5)
    assert [scene.model.geom(int(g)).name for g in geoms] == ["lawn", "lawn"]


def test_what_can_be_seen_and_not_touched_is_no_ground() -> None:
    """A thin mark is as safe as the lawn below it; through a deck half a metre up one falls."""
    decks = "".join(
        f"<geom name='path_{x}' type='box' size='3 3 {half}' pos='{x} 0 {half}' contype='0' "
        "conaffinity='0'/>"
        for x, half in ((10, 0.02), (20, 0.25))
    )
    scene = scene_on_lawn(decks)
    mark, deck = (judge_touchdown(scene, np.array([x, 0.0])) for x in (10.0, 20.0))
    assert mark.safe and mark.land_class == "path"
    assert not deck.safe and deck.land_class == "other"


def test_bare_ground_lies_where_its_body_puts_it() -> None:
    """An obstacle's height counts from a slope of 4.4 degrees on a raised and moved body."""
    field = " ".join(str(column / 4) for column in list(range(5)) * 4)
    assets = f"<hfield name='a' nrow='4' ncol='5' size='9 7 1.4 0.5' elevation='{field}'/>"
    things = (
        "<body pos='20 0 1.5'><geom name='lawn_h' type='hfield' hfield='a'/>"
        "<geom name='building_b' type='box' size='0.5 0.5 1' pos='6 0 1'/></body>"
    )
    scene = scene_on_lawn(things, assets)
    judged = judge_touchdown(scene, np.array([20.0, 0.0]))
    assert judged.safe and judged.land_class == "lawn"
    assert judged.slope_deg == pytest.approx(np.degrees(np.arctan(1.4 / 18.0)), abs=0.01)
    assert judged.obstacle_distance_m == pytest.approx(5.5, abs=0.06)


BESIDE_M = np.array([1.37e-4, 2.11e-4])
"""Truth rays aim beside the edges of regular grids."""
MAX_EDGES = 0.003
"""fraction of points; a scene has some hundreds of metres of edges, looked at 4 mm wide"""


@pytest.mark.slow
@pytest.mark.parametrize("name", scene_names())
def test_truth_maps_are_those_of_single_rays(name: str) -> None:
    """10,000 random cells of the map. A cell that holds something narrower than itself has that
    thing's height, not the one at its centre: counted as well."""
    scene = cached_scene(name, 0)
    maps = truth_maps(scene, 0.1)
    rng = np.random.default_rng(12)
    cells = np.stack([rng.integers(0, count, 10_000) for count in maps.height_m.shape[::-1]], 1)
    centres = maps.origin_xy_m + (cells + 0.5) * maps.cell_m
    heights = maps.height_m[cells[:, 1], cells[:, 0]].astype(np.float64)
    sampled = cast_points(scene, centres)[0]
    thin = heights > sampled + 1e-3
    rays = SingleRays(scene)
    wrong, edges = rays.disagreements(centres[~thin] + BESIDE_M, heights[~thin])
    wrong_thin, _ = rays.disagreements(centres[thin] + BESIDE_M, sampled[thin])
    print(f"{name}: {len(cells)} cells, {wrong.size + wrong_thin.size} differ by more than 1 cm, "
          f"{edges} at edges, {thin.sum()} with thin things")  # fmt: skip
    assert wrong.size == 0 and wrong_thin.size == 0
    assert edges <= MAX_EDGES * len(cells) and thin.sum() <= 0.02 * len(cells)
