"""The green at the edge of the settlement: lawn, playground, footpath, and the take-off spot."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from touchdown.scenes.api import Array
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.ground import Canvas, Ground
from touchdown.scenes.authoring.plane import unit
from touchdown.scenes.authoring.plots import claim_area, scatter
from touchdown.scenes.authoring.relief import Ditch, Mound
from touchdown.scenes.places.houses.layout import Plan
from touchdown.scenes.props.garden import add_toys
from touchdown.scenes.props.plants import Nursery, add_bush, add_small_tree, add_tree
from touchdown.scenes.props.playground import (
    add_climbing_dome,
    add_goal,
    add_play_slide,
    add_slackline,
    add_swing,
)
from touchdown.scenes.props.street import add_bench, add_lamp


@dataclass(frozen=True, kw_only=True, slots=True)
class Green:
    """In frame coordinates: u from ``west`` to ``east``, v from ``low`` to ``high``."""

    plan: Plan
    west: float
    east: float
    low: float
    high: float
    play_uv: Array
    """middle of the playground"""
    path_m: Array
    """(N, 2) world"""
    mound: Mound
    ditch: Ditch


def draw_green(rng: np.random.Generator, plan: Plan) -> Green:
    """Returns the green: a playground in the south-west corner, a slope with the look of lawn,
    a grassed ditch."""
    frame = plan.frame
    local = [frame.coordinates(plan.south.point(s, -plan.south.edge_m)) for s in (20.0, 45.0)]
    east = float(min(point[0] for point in local)) - 0.8
    high = float(frame.coordinates(plan.takeoff_xy_m)[1]) + 17.0
    u = np.arange(-66.0, east + 1.0, 1.0)
    swing = rng.uniform(1.0, 2.2) * np.sin(u / rng.uniform(7.0, 11.0) + rng.uniform(0.0, 6.0))
    path = frame.points(np.column_stack([u, -32.5 + rng.uniform(-1.0, 1.0) + swing]))
    spot = frame.at(east - rng.uniform(7.0, 9.0), -15.0 + rng.uniform(-4.0, 3.0))
    return Green(plan=plan, west=-44.0, east=east, low=-50.0, high=high,
                 play_uv=np.array([-30.0 + rng.uniform(-5.0, 6.0), -41.5]), path_m=path,
                 mound=Mound(centre_xy_m=spot, height_m=rng.uniform(0.8, 1.3),
                 radius_m=rng.uniform(3.4, 4.2)), ditch=Ditch(start_xy_m=frame.at(-62.0, -51.0),
                 end_xy_m=frame.at(east - 4.0, -50.0), depth_m=rng.uniform(0.5, 0.8),
                 half_width_m=1.6))  # fmt: skip


def paint_green(canvas: Canvas, green: Green, rng: np.random.Generator) -> None:
    """Paints footpath, safety surface, meadow beyond the ditch, bare patches before the goal."""
    frame = green.plan.frame
    meadow = [frame.at(u, -50.5 + 0.6 * np.sin(0.3 * u)) for u in np.arange(-70.0, green.east, 2.0)]
    canvas.fill(
        np.array([*meadow, frame.at(green.east, -90.0), frame.at(-70.0, -90.0)]), Ground.MEADOW
    )
    canvas.track(np.array([green.ditch.start_xy_m, green.ditch.end_xy_m]), 1.0, Ground.WORN)
    canvas.track(green.path_m, 1.8, Ground.GRAVEL)
    u, v = green.play_uv
    canvas.fill(frame.rectangle((u - 8.5, u + 4.5), (v - 4.6, v + 4.6)), Ground.RUBBER)
    canvas.fill(frame.ring(u + 8.0, v, 3.4), Ground.SAND)
    # A kick-about field worn by feet.
    for spot in (green.plan.takeoff_xy_m + rng.normal(0.0, 3.0, 2) for _ in range(3)):
        blot = rng.uniform(0.5, 1.1, 14)[:, None] * frame.ring(0.0, 0.0, 1.0, 14)
        canvas.fill(spot + blot, Ground.WORN)


def build_green(builder: SceneBuilder, green: Green, nursery: Nursery) -> None:
    """Adds trees along the edges, play equipment, benches, and lines over the lawn."""
    rng, frame = builder.rng, green.plan.frame
    start = frame.coordinates(green.plan.takeoff_xy_m)
    for spot in green.path_m[::2]:
        builder.claim(spot, 1.0)
    u, v = green.play_uv
    add_swing(builder, frame.at(u - 5.5, v + 1.5), frame.angle)
    add_play_slide(builder, frame.at(u - 1.0, v - 1.8), frame.angle)
    add_climbing_dome(builder, frame.at(u + 2.0, v + 2.0))
    builder.claim(frame.at(u + 8.0, v), 3.4)
    claim_area(builder, frame, (u - 8.5, u + 4.5), (v - 4.6, v + 4.6))
    for reach in (-5.0, 4.0):
        add_bench(builder, frame.at(u + reach, v + 6.0), frame.away + np.pi)
    add_toys(builder, frame.at(start[0] + rng.uniform(7.0, 11.0), start[1] + rng.uniform(4.0, 9.0)))
    near = frame.at(start[0] - 9.0, start[1] + rng.uniform(4.0, 8.0))
    add_goal(builder, near, frame.angle, 2.4, 1.6)
    line_v = start[1] + rng.uniform(-7.0, -5.0)
    first, last = start[0] + rng.uniform(5.0, 8.0), start[0] + rng.uniform(17.0, 20.0)
    add_slackline(builder, frame.at(first, line_v), frame.at(last, line_v + rng.uniform(-2, 2)),
                  rng.uniform(0.45, 0.9))  # fmt: skip
    builder.claim(frame.at(0.5 * (first + last), line_v), 5.0)
    for along in np.arange(green.west + 2.0, green.east - 3.0, rng.uniform(8.5, 10.5)):
        spot = frame.at(along, green.high - 1.0)
        distance = float(green.plan.pavement_distance(spot))
        if distance > 2.0 and builder.is_free(spot, 2.0):
            add_tree(builder, nursery, spot, rng.uniform(0.8, 1.0))
    lawn = (green.west + 2.0, green.east - 3.0)
    for spot in scatter(builder, frame, 2, lawn, (green.low + 3.0, -24.0), 3.0):
        add_tree(builder, nursery, spot, rng.uniform(0.9, 1.2))
    for spot in scatter(builder, frame, 3, (-57.0, green.east - 4.0), (-57.0, -53.0), 2.4):
        add_small_tree(builder, nursery, spot, rng.uniform(0.9, 1.1))
    for spot in scatter(builder, frame, 3, (-57.0, green.east - 2.0), (-57.0, -36.0), 1.0):
        add_bush(builder, nursery, spot)
    for index in (int(0.35 * len(green.path_m)), int(0.75 * len(green.path_m))):
        spot = green.path_m[index] + 1.6 * unit(frame.away)
        if builder.is_free(spot, 0.0) or index:
            add_lamp(builder, spot, frame.away + np.pi, 4.0)
