"""Swings, slides, climbing frames and goals, nets and lines between posts."""

from itertools import pairwise

import numpy as np

from touchdown.scenes.api import Array, Surface
from touchdown.scenes.authoring.builder import SceneBuilder, quat_zy
from touchdown.scenes.authoring.meshes import box, plate
from touchdown.scenes.authoring.plane import rotated, unit
from touchdown.scenes.props.garden import CLOTH
from touchdown.scenes.props.street import WOOD, add_post, add_wire

NET = Surface(land_class="other", reflectivity=0.35, porosity=0.7)
_STEEL_RGBA = [0.80, 0.26, 0.18, 1.0]


def _frame(heading: float) -> tuple[Array, Array]:
    along = np.array([np.cos(heading), np.sin(heading), 0.0])
    return along, np.array([-along[1], along[0], 0.0])


def add_swing(builder: SceneBuilder, xy_m: Array, heading: float) -> None:
    """Adds two swings under a bar between two A-frames of thin tube."""
    along, left = _frame(heading)
    foot = builder.on_ground(xy_m)
    up = np.array([0.0, 0.0, 2.3])
    for end in (-1.8, 1.8):
        for side in (-0.8, 0.8):
            add_wire(builder, foot + end * along + side * left, foot + end * along + up, 0.035,
                     _STEEL_RGBA)  # fmt: skip
    add_wire(builder, foot - 1.8 * along + up, foot + 1.8 * along + up, 0.035, _STEEL_RGBA)
    seats = []
    for seat in (-0.8, 0.8):
        ropes = [box((0.012, 0.012, 0.9), (seat + rope, 0.0, 1.4)) for rope in (-0.2, 0.2)]
        seats += [box((0.24, 0.09, 0.02), (seat, 0.0, 0.5)), *ropes]
    builder.stand("swing_seats", WOOD, seats, xy_m, heading, rgba=[0.12, 0.12, 0.13, 1])
    for end in (-1.8, 0.0, 1.8):
        builder.claim(xy_m + end * along[:2], 1.6)


def add_play_slide(builder: SceneBuilder, xy_m: Array, heading: float) -> None:
    """Adds a small tower with a roof and a slide along ``heading``."""
    along, _ = _frame(heading)
    deck = [box((0.6, 0.6, 0.05), (-1.4, 0.0, 1.4))]
    deck += [box((0.05, 0.05, 1.35), (-1.4 + x, y, 1.35))
             for x in (-0.55, 0.55) for y in (-0.55, 0.55)]  # fmt: skip
    deck += [box((0.03, 0.3, 0.03), (-2.1 - 0.25 * (1.4 - rung), 0.0, rung))
             for rung in np.arange(0.25, 1.4, 0.28)]  # fmt: skip
    builder.stand("play_tower", WOOD, deck, xy_m, heading, rgba=[0.56, 0.42, 0.27, 1])
    roof = []
    for y in (-0.75, 0.75):
        roof += plate([[-2.1, y, 2.5], [-0.7, y, 2.5], [-0.7, 0, 3.1], [-2.1, 0, 3.1]])
    builder.stand("play_roof", CLOTH, roof, xy_m, heading, rgba=[0.24, 0.46, 0.70, 1])
    chute = np.array([[-0.8, -0.25, 1.4], [1.3, -0.25, 0.3], [1.3, 0.25, 0.3], [-0.8, 0.25, 1.4]])
    bed = plate(chute, 0.04)
    for y in (-0.25, 0.25):
        bed += plate([[-0.8, y, 1.4], [1.3, y, 0.3], [1.3, y, 0.45], [-0.8, y, 1.55]])
    builder.stand("play_slide", CLOTH, bed, xy_m, heading, rgba=[0.92, 0.76, 0.16, 1])
    for reach in (-1.6, 0.0, 1.4):
        builder.claim(xy_m + reach * along[:2], 1.5)


def add_climbing_dome(builder: SceneBuilder, xy_m: Array) -> None:
    """Adds three hoops of thin rope tube over the middle."""
    foot, arc = builder.on_ground(xy_m), np.linspace(0.0, np.pi, 5)
    for turn in np.arange(0.0, 3.0, np.pi / 3.0):
        out = np.array([*unit(turn), 0.0])
        points = [foot + 1.7 * np.cos(a) * out + [0, 0, 1.8 * np.sin(a)] for a in arc]
        for first, second in pairwise(points):
            add_wire(builder, first, second, 0.025, [0.16, 0.42, 0.30, 1])
    builder.claim(xy_m, 2.3)


def add_goal(
    builder: SceneBuilder, xy_m: Array, heading: float, width_m: float, height_m: float
) -> None:
    """Adds a goal of white tube that opens along ``heading``; its net lets most pulses through."""
    along, left = _frame(heading)
    foot = builder.on_ground(xy_m)
    up, white = np.array([0.0, 0.0, height_m]), [0.94, 0.94, 0.93, 1]
    ends = [foot + sign * 0.5 * width_m * left for sign in (-1.0, 1.0)]
    for end in ends:
        add_wire(builder, end, end + up, 0.05, white)
        add_wire(builder, end + up, end - 1.1 * along, 0.02, white)
    add_wire(builder, ends[0] + up, ends[1] + up, 0.05, white)
    lean = float(np.hypot(1.1, height_m))
    tilt = float(np.arctan2(1.1, height_m))
    builder.geom("net", NET, box=[0.008, 0.5 * width_m, 0.5 * lean], quat=quat_zy(heading, tilt),
                 pos=foot - 0.55 * along + 0.5 * up, rgba=[0.90, 0.90, 0.90, 0.28])  # fmt: skip
    for fraction in (-0.5, 0.0, 0.5):
        builder.claim(xy_m + fraction * width_m * left[:2], 1.0)


def add_net(
    builder: SceneBuilder, start_xy_m: Array, end_xy_m: Array, band_m: tuple[float, float]
) -> None:
    """Adds a net between two posts from ``band_m[0]`` to ``band_m[1]`` above the ground."""
    span = end_xy_m - start_xy_m
    low, high = band_m
    middle = 0.5 * (start_xy_m + end_xy_m)
    z = builder.terrain.point(*middle)
    for end in (start_xy_m, end_xy_m):
        add_post(builder, end, high + 0.08, 0.04, [0.25, 0.27, 0.30, 1])
    builder.geom("net", NET, pos=[*middle, z + 0.5 * (low + high)],
                 box=[0.5 * float(np.hypot(*span)), 0.008, 0.5 * (high - low)], rgba=[0.15, 0.16,
                 0.16, 0.4], heading=float(np.arctan2(span[1], span[0])))  # fmt: skip
    tops = [np.array([*end, z + high]) for end in (start_xy_m, end_xy_m)]
    add_wire(builder, tops[0], tops[1], 0.02, [0.93, 0.93, 0.90, 1])
    builder.claim_line(start_xy_m, end_xy_m, 6)


def add_slackline(
    builder: SceneBuilder, start_xy_m: Array, end_xy_m: Array, height_m: float
) -> None:
    """Adds a webbing of 5 cm between two stakes over the lawn."""
    tops = []
    for end in (start_xy_m, end_xy_m):
        add_post(builder, end, height_m + 0.15, 0.05, [0.45, 0.36, 0.26, 1])
        tops.append(builder.on_ground(end, height_m))
    add_wire(builder, tops[0], tops[1], 0.02, [0.86, 0.52, 0.20, 1])


def add_flag(builder: SceneBuilder, xy_m: Array, height_m: float, rgba: list[float]) -> None:
    """Adds a flagpole of 8 cm with a limp flag."""
    z = builder.terrain.point(*xy_m)
    add_post(builder, xy_m, height_m, 0.04, [0.90, 0.90, 0.90, 1])
    builder.geom("flag", CLOTH, box=[0.4, 0.01, 0.6], rgba=rgba,
                 pos=[xy_m[0] + 0.42, xy_m[1], z + height_m - 0.7])  # fmt: skip
    builder.claim(xy_m, 0.6)


def add_towel(builder: SceneBuilder, xy_m: Array, size_m: tuple[float, float], heading: float,
              rgba: list[float]) -> None:  # fmt: skip
    """Adds a thin cloth on the ground (a towel, a blanket)."""
    half = [0.5 * size_m[0], 0.5 * size_m[1], 0.015]
    corners = np.array([[sx * half[0], sy * half[1]] for sx in (-1, 1) for sy in (-1, 1)])
    z = float(builder.terrain.at(xy_m + rotated(corners, heading)).max())
    builder.geom("towel", CLOTH, box=half, pos=[*xy_m, z], heading=heading, rgba=rgba)
    builder.claim(xy_m, 0.7)
