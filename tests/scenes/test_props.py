"""Props on a slope: each stands on the ground, has the place that it takes reserved, throws the
shadow of its own extent, and has colours that exist."""

import inspect
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.relief import HeightField
from touchdown.scenes.props import (
    cars,
    garden,
    plants,
    playground,
    pools,
    scrubland,
    stonework,
    street,
    waterside,
    woods,
)

START, END = np.array([2.0, 1.0]), np.array([9.0, 6.0])
VALUES = {
    "xy_m": (START + END) / 2.0, "heading": 0.3, "height_m": 1.5, "top_m": 2.0, "radius_m": 0.5,
    "start_xy_m": START, "end_xy_m": END, "line_m": np.array([START, [5.0, 3.0], END]),
    "width_m": 3.0, "band_m": (0.2, 1.0), "size": 1.0, "rgba": [0.5, 0.4, 0.3, 1.0],
}  # fmt: skip
MADE: dict[str, Callable[[SceneBuilder], Any]] = {
    "nursery": plants.plant_nursery, "land": scrubland.grow_scrub, "bed": waterside.grow_reeds,
    "mesh": stonework.add_sheep_models, "wood": woods.grow_wood,
}  # fmt: skip
PROPS: list[Callable[..., Any]] = [
    stonework.add_stone_wall, stonework.add_well, stonework.add_log_pile, stonework.add_sheep,
    stonework.add_electric_fence, waterside.add_net, waterside.add_pile, street.add_lamp,
    street.add_sign, street.add_bench, street.add_bin, street.add_fence, street.add_post,
    playground.add_swing, playground.add_climbing_dome, playground.add_goal, playground.add_net,
    garden.add_washing_line, garden.add_table, scrubland.add_scrub, scrubland.add_tuft,
    plants.add_tree, plants.add_small_tree, plants.add_bush, plants.add_hedge, plants.add_rock,
    pools.add_umbrella, pools.add_lounger, pools.add_guard_chair,
]  # fmt: skip
UNCLAIMED = {"add_pile", "add_post"}
"""parts of others, which reserve the place"""


def slope_builder() -> SceneBuilder:
    """On a plane that rises by 0.1 to the east."""
    slope = np.tile(np.linspace(-2.0, 2.0, 41), (41, 1))
    return SceneBuilder(
        spec=mujoco.MjSpec(), rng=np.random.default_rng(3), sun=np.array([0.3, 0.2, -0.9]),
        terrain=HeightField(heights_m=slope, half_m=20.0),
    )  # fmt: skip


def corners(model: Any) -> NDArray[np.float64]:
    """(N, 3) world points: vertices of meshes, corners of the boxes around other geoms."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    found = []
    for geom in range(model.ngeom):
        if (mesh := model.geom_dataid[geom]) >= 0:
            first = model.mesh_vertadr[mesh]
            local = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
        else:
            box = model.geom_aabb[geom]
            local = box[:3] + box[3:] * (np.indices((2, 2, 2)).reshape(3, 8).T * 2 - 1)
        found.append(local @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom])
    return np.concatenate(found)


@pytest.mark.parametrize("prop", PROPS, ids=lambda prop: f"{prop.__module__[-6:]}.{prop.__name__}")
def test_a_prop_stands_where_it_is_put(prop: Callable[..., Any]) -> None:
    builder = slope_builder()
    models = {pools.add_umbrella: pools.add_umbrella_models, pools.add_lounger:
              pools.add_lounger_models}  # fmt: skip
    given = {
        name: VALUES[name] if name in VALUES
        else models[prop](builder, 1)[0] if name == "model" else MADE[name](builder)
        for name, what in inspect.signature(prop).parameters.items()
        if name != "builder" and what.default is inspect.Parameter.empty
    }  # fmt: skip
    prop(builder, **given)
    model = builder.spec.compile()
    points = corners(model)
    above = points[:, 2] - builder.terrain.at(points[:, :2])
    assert -0.8 < above.min() < 0.1 < above.max()
    assert model.geom_rgba.min() >= 0.0 and model.geom_rgba.max() <= 1.0
    if prop.__name__ not in UNCLAIMED:
        away = [
            np.linalg.norm(points[above < 1.0, :2] - centre, axis=1) - radius
            for centre, radius in builder.occupied
        ]
        assert np.min(away, axis=0).max() < 0.5  # of what stands in somebody's way
    shadow = np.concatenate([caster.points for caster in builder.casters])
    assert np.ptp(shadow, axis=0)[:2] == pytest.approx(np.ptp(points, axis=0)[:2], abs=0.75)
    assert shadow.min(axis=0)[:2] == pytest.approx(points.min(axis=0)[:2], abs=0.4)
    assert shadow[:, 2].max() == pytest.approx(points[:, 2].max(), abs=0.75)


def test_a_thatched_roof_has_four_dark_courses_a_slope() -> None:
    rows = stonework.thatch(np.random.default_rng(1)).mean(axis=(1, 2), dtype=float)
    half = rows.reshape(2, 256)
    for first in (64, 128, 192):
        assert (half[:, first : first + 3] < 0.85 * half[:, first + 6 : first + 9]).all()


@pytest.mark.parametrize("name", cars.SHAPES)
def test_panels_of_a_car_show_what_was_drawn_for_their_side(name: str) -> None:
    """From above the upper band of the picture, from aside the middle one, the ends the lower."""
    shape = cars.SHAPES[name]
    mesh = cars.car_mesh(shape)
    corners, rows = mesh.vertices[mesh.faces], mesh.uv[mesh.faces][..., 1] * cars.ATLAS_PX
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    body = rows.max(axis=1) < 480.0  # not a tyre
    above, aside = normal[:, 2] > 0.12, (normal[:, 2] <= 0.12) & (np.abs(normal[:, 1]) > 0.6)
    first = np.select([above, aside], [cars.TOP_ROW, cars.SIDE_ROW], cars.END_ROW)
    high = np.where(above, shape.width_m, shape.height_m) * cars.PX_PER_M
    inside = (rows >= first[:, None] - 1.0) & (rows <= (first + high)[:, None] + 1.0)
    assert body.sum() > 20 and inside[body].all()
    along = corners[..., 0] + 0.5 * shape.length_m
    u = mesh.uv[mesh.faces][..., 0] * cars.ATLAS_PX / cars.PX_PER_M
    np.testing.assert_allclose(u[body & (above | aside)], along[body & (above | aside)], atol=1e-3)
