"""`crossroad`: fills crossroad.xml with a scene drawn from a seed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.generation import finish, paint_terrain, scene_rng, start_scene
from touchdown.scenes.authoring.ground import Canvas, Ground
from touchdown.scenes.authoring.plane import pick, unit
from touchdown.scenes.places.crossroad import roads
from touchdown.scenes.places.crossroad.layout import (
    HALF_M,
    QUADRANTS,
    Plan,
    Quarter,
    draw_plan,
    shape_ground,
)
from touchdown.scenes.places.crossroad.quarters import Common, Farm, Homes, Shop, Theme
from touchdown.scenes.props.cars import add_car_models, park_car
from touchdown.scenes.props.plants import Nursery, add_tree, plant_nursery
from touchdown.scenes.props.street import add_lamp, add_sign

CAR_MODELS = 8


def generate(seed: int) -> SceneDraft:
    """Returns the scene of ``seed`` without the vehicle. The same seed gives the same bytes."""
    rng = scene_rng("crossroad", seed)
    plan = draw_plan(rng)
    themes = draw_themes(rng, plan)
    pads = [pad for theme in themes for pad in theme.pads]
    ditches = [ditch for theme in themes for ditch in theme.ditches]
    terrain = shape_ground(rng, plan, pads, ditches)
    builder = start_scene("crossroad", rng, terrain)
    moving = place_objects(builder, plan, themes)
    canvas = paint_ground(rng, plan, themes)
    ground = paint_terrain(builder, canvas, pattern_angles(rng, plan))
    return finish(plan, builder, ground, moving=moving)


def draw_themes(rng: np.random.Generator, plan: Plan) -> list[Theme]:
    """Returns the green in the south-west; houses, a shop and a farm on the other plots in any
    order."""
    kinds: list[Callable[[Quarter, np.random.Generator], Theme]] = [Homes, Shop, Farm]
    order = rng.permutation(3)
    themes: list[Theme] = [Common(Quarter(plan=plan, signs=QUADRANTS["SW"]), rng)]
    for name, index in zip(("NE", "NW", "SE"), order, strict=True):
        themes.append(kinds[int(index)](Quarter(plan=plan, signs=QUADRANTS[name]), rng))
    return themes


def place_objects(builder: SceneBuilder, plan: Plan, themes: list[Theme]) -> tuple[Any, ...]:
    """Adds all objects and cars. Returns the moving cars."""
    rng = builder.rng
    nursery = plant_nursery(builder)
    models = add_car_models(builder, CAR_MODELS)
    builder.claim(plan.takeoff_xy_m, 6.0)
    openings = [opening for theme in themes for opening in theme.openings]
    roads.place_kerbs(builder, plan, openings)
    for theme in themes:
        theme.build(builder, nursery, models)
    scatter_edge_trees(builder, plan, nursery)
    for road in (plan.main, plan.side):
        low, high = road.ends_m()
        edge = 0.5 * road.width_m + 0.55
        for index, along in enumerate(np.arange(low + rng.uniform(6.0, 12.0), high - 3.0, 24.0)):
            side = 1.0 if index % 2 else -1.0
            if abs(along) > 12.0 and builder.is_free(road.point(along, side * edge), 0.3):
                heading = road.angle - side * 0.5 * np.pi
                add_lamp(builder, road.point(along, side * edge), heading)
        for sign in (1.0, -1.0):
            spot = road.point(sign * 16.5, sign * (0.5 * road.width_m + 0.6))
            if builder.is_free(spot, 0.2):
                heading = road.angle + (0.0 if sign > 0 else np.pi)
                red = [0.80, 0.10, 0.10, 1.0]
                add_sign(builder, spot, heading, red if road is plan.side else [0.1, 0.25, 0.65, 1])
    for along in (-34.0, 31.0):
        across = (1.0 if along < 0 else -1.0) * (0.5 * plan.side.width_m - 1.05)
        spot = plan.side.point(along + rng.uniform(-4.0, 4.0), across)
        heading = plan.side.angle + (0.0 if across < 0 else np.pi)
        if builder.is_free(spot, 1.0):
            park_car(builder, pick(rng, models), spot, heading)
    return roads.add_traffic(builder, plan, models, rng)


def scatter_edge_trees(builder: SceneBuilder, plan: Plan, nursery: Nursery) -> None:
    """Adds single trees on the outskirts, where the plots end."""
    rng = builder.rng
    for _ in range(14):
        angle = rng.uniform(0.0, 2.0 * np.pi)
        spot = rng.uniform(54.0, 61.0) * unit(angle)
        spot = np.clip(spot * 1.25, -HALF_M + 3.0, HALF_M - 3.0)
        if float(plan.kerb_distance(spot)) > plan.corridor_m + 2.5 and builder.is_free(spot, 2.8):
            add_tree(builder, nursery, spot, rng.uniform(0.9, 1.3))


def paint_ground(rng: np.random.Generator, plan: Plan, themes: list[Theme]) -> Canvas:
    """Paints materials, markings and stains: plots first, roads over them."""
    canvas = Canvas(half_m=HALF_M)
    for theme in themes:
        theme.paint(canvas)
    roads.paint_surfaces(canvas, plan)
    roads.wear_down(canvas, plan, rng)
    roads.paint_markings(canvas, plan)
    return canvas


def pattern_angles(rng: np.random.Generator, plan: Plan) -> dict[Ground, float]:
    """Slabs along the roads, mowing stripes askew, furrows along or across."""
    angle = plan.main.angle
    turned = dict.fromkeys(Ground, angle)
    turned[Ground.SIDE_PAVEMENT] = plan.side.angle
    turned[Ground.LAWN] = angle + float(rng.uniform(0.3, 1.2))
    turned[Ground.SOIL] = angle + (0.5 * np.pi if rng.random() < 0.5 else 0.0)
    return turned
