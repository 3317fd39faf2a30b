"""Lamps, signs, benches, fences, kerbs, bins; posts, poles and wires, which are invisible from high
above."""

from itertools import pairwise

import numpy as np

from touchdown.scenes.api import Array, Surface
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.meshes import MeshData, box, boxes
from touchdown.scenes.authoring.plane import unit
from touchdown.scenes.authoring.streets import KERB

STEEL = Surface(land_class="other", reflectivity=0.40)
WOOD = Surface(land_class="other", reflectivity=0.45)
_STEEL_RGBA = [0.36, 0.39, 0.41, 1.0]
_WOOD_RGBA = [0.50, 0.38, 0.26, 1.0]


def add_lamp(builder: SceneBuilder, xy_m: Array, heading: float, height_m: float = 6.5) -> None:
    """Adds a street lamp whose arm points along ``heading``."""
    z = builder.terrain.point(*xy_m)
    arm = unit(heading) * 1.5
    tip = xy_m + arm
    builder.geom("lamp_pole", STEEL, rgba=_STEEL_RGBA, fromto=[*xy_m, z - 0.3, *xy_m, z + height_m],
                 cylinder=0.075)  # fmt: skip
    builder.geom("lamp_arm", STEEL, rgba=_STEEL_RGBA, fromto=[*xy_m, z + height_m, *tip,
                 z + height_m + 0.25], capsule=0.045)  # fmt: skip
    head = np.array([*tip, z + height_m + 0.22])
    builder.geom("lamp_head", STEEL, rgba=[0.78, 0.79, 0.78, 1], pos=head, heading=heading,
                 box=[0.34, 0.14, 0.06])  # fmt: skip
    foot, joint = np.array([*xy_m, z]), np.array([*xy_m, z + height_m])
    _cast_bar(builder, foot, joint, 0.075)
    _cast_bar(builder, joint, head, 0.06)
    builder.cast_box((0.3, 0.3), (0.0,), 0.0, head)
    builder.claim(xy_m, 0.6)


def add_sign(builder: SceneBuilder, xy_m: Array, heading: float, rgba: list[float]) -> None:
    """Adds a round road sign that faces ``heading``."""
    z = builder.terrain.point(*xy_m)
    builder.geom("sign_pole", STEEL, rgba=_STEEL_RGBA, fromto=[*xy_m, z - 0.2, *xy_m, z + 2.5],
                 cylinder=0.035)  # fmt: skip
    face = unit(heading) * 0.05
    builder.geom("sign_plate", STEEL, rgba=rgba, cylinder=0.32, fromto=[*(xy_m + 0.8 * face),
                 z + 2.25, *(xy_m + 1.4 * face), z + 2.25])  # fmt: skip
    offsets = np.array([[0.04, 0, 0], [-0.04, 0, 0], [0, 0.04, 0]])
    builder.cast(np.array([*xy_m, z]) + np.concatenate([offsets, offsets + np.array([0, 0, 2.5])]))
    builder.claim(xy_m, 0.5)


def add_bench(builder: SceneBuilder, xy_m: Array, heading: float) -> None:
    """Adds a bench with a back; its sitter looks along ``heading``."""
    parts = boxes([0.24, 0.85, 0.03, 0.0, 0.0, 0.45], [0.03, 0.85, 0.20, -0.26, 0.0, 0.72], [0.22,
                  0.05, 0.28, 0.0, 0.65, 0.18], [0.22, 0.05, 0.28, 0.0, -0.65, 0.18])  # fmt: skip
    name = builder.mesh(builder.unique("bench"), MeshData.join(parts))
    origin = builder.on_ground(xy_m)
    builder.geom("bench", WOOD, mesh=name, pos=origin, heading=heading, rgba=_WOOD_RGBA)
    builder.cast_box((0.27, 0.85), (0.4, 0.5), heading, origin)
    builder.claim(xy_m, 1.1)


def add_bin(builder: SceneBuilder, xy_m: Array, rgba: list[float]) -> None:
    """Adds a wheeled bin or a litter bin."""
    at = builder.on_ground(xy_m, 0.5)
    builder.geom("bin", STEEL, rgba=rgba, pos=at, box=[0.28, 0.33, 0.52])
    builder.cast_box((0.28, 0.33), (-0.52, 0.52), 0.0, at)
    builder.claim(xy_m, 0.6)


def add_fence(builder: SceneBuilder, start_xy_m: Array, end_xy_m: Array, rgba: list[float]) -> None:
    """Adds posts every 2 m, three boards and a cap rail, following the ground in panels."""
    span = end_xy_m - start_xy_m
    length = float(np.hypot(*span))
    panels = max(1, round(length / 2.0))
    angle = float(np.arctan2(span[1], span[0]))
    knots = start_xy_m + np.linspace(0.0, 1.0, panels + 1)[:, None] * span
    heights = builder.terrain.at(knots)
    base = float(heights.min())
    parts: list[MeshData] = []
    pitch = length / panels
    for index in range(panels + 1):
        x = index * pitch - 0.5 * length
        z = float(heights[index]) - base
        parts.append(box((0.05, 0.05, 0.65), (x, 0.0, z + 0.45)))
        if index < panels:
            middle = 0.5 * (z + float(heights[index + 1]) - base)
            for high, wide, up in ((0.08, 0.025, 0.25), (0.08, 0.025, 0.58), (0.08, 0.025, 0.91),
                                   (0.02, 0.07, 1.08)):  # fmt: skip
                centre = (x + 0.5 * pitch, 0.0, middle + up)
                parts.append(box((0.5 * pitch, wide, high), centre))
    name = builder.mesh(builder.unique("fence"), MeshData.join(parts))
    origin = np.array([*(0.5 * (start_xy_m + end_xy_m)), base])
    builder.geom("fence", WOOD, mesh=name, pos=origin, heading=angle, rgba=rgba)
    for board in ((0.17, 0.33), (0.50, 0.66), (0.83, 0.99), (1.06, 1.10)):
        builder.cast_box((0.5 * length, 0.03), board, angle, origin)
    for knot in knots:
        builder.claim(knot, 0.8)


def add_kerb(builder: SceneBuilder, start_xy_m: Array, end_xy_m: Array, top_m: float) -> None:
    """Adds a row of kerb stones, 0.16 m wide, from below the road to ``top_m`` (world height)."""
    span = end_xy_m - start_xy_m
    middle = 0.5 * (start_xy_m + end_xy_m)
    builder.geom("path_kerb", KERB, rgba=[0.68, 0.67, 0.64, 1], pos=[*middle, top_m - 0.15],
                 box=[0.5 * float(np.hypot(*span)) + 0.01, 0.08, 0.15],
                 heading=float(np.arctan2(span[1], span[0])))  # fmt: skip


WIRE = Surface(land_class="other", reflectivity=0.12)
POLE = Surface(land_class="other", reflectivity=0.32)
_TIMBER = [0.36, 0.29, 0.22, 1.0]


def add_post(
    builder: SceneBuilder, xy_m: Array, height_m: float, radius_m: float, rgba: list[float]
) -> None:
    """Adds an upright post that stands 0.3 m in the ground."""
    z = builder.terrain.point(*xy_m)
    builder.geom("post", STEEL, cylinder=radius_m, rgba=rgba,
                 fromto=[*xy_m, z - 0.3, *xy_m, z + height_m])  # fmt: skip
    _cast_bar(builder, np.array([*xy_m, z]), np.array([*xy_m, z + height_m]), radius_m)


def add_wire(
    builder: SceneBuilder, start_m: Array, end_m: Array, radius_m: float, rgba: list[float]
) -> None:
    """Adds a straight bar or wire between two world points (3,)."""
    builder.geom("wire", WIRE, capsule=radius_m, rgba=rgba, fromto=[*start_m, *end_m])
    _cast_bar(builder, start_m, end_m, radius_m)


def _cast_bar(builder: SceneBuilder, start_m: Array, end_m: Array, radius_m: float) -> None:
    # Less than a texel wide, a shadow would come out spotted: widen it and let light through.
    wide = max(radius_m, 0.03)
    square = wide * np.array([[1, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]], np.float64)
    builder.cast(np.concatenate([start_m + square, end_m + square]), radius_m / wide)


def add_sagging_wire(
    builder: SceneBuilder, start_m: Array, end_m: Array, sag_m: float, pieces: int = 2
) -> None:
    """Adds a hanging cable (a parabola) as straight pieces."""
    fraction = np.linspace(0.0, 1.0, pieces + 1)[:, None]
    points = start_m + fraction * (end_m - start_m)
    points[:, 2] -= 4.0 * sag_m * (fraction * (1.0 - fraction))[:, 0]
    for first, second in pairwise(points):
        add_wire(builder, first, second, 0.014, [0.08, 0.08, 0.09, 1])


def add_pole(
    builder: SceneBuilder, xy_m: Array, heading: float, height_m: float
) -> tuple[Array, Array]:
    """Adds a timber pole whose crossarm lies square to ``heading``. Returns both insulators,
    (3,)."""
    z = builder.terrain.point(*xy_m)
    top = np.array([*xy_m, z + height_m])
    builder.geom("pole", POLE, cylinder=0.11, rgba=_TIMBER, fromto=[*xy_m, z - 0.5, *top])
    arm = 0.75 * np.array([-np.sin(heading), np.cos(heading), 0.0])
    cross = top - [0.0, 0.0, 0.25]
    builder.geom("pole_arm", POLE, box=[0.05, 0.85, 0.06], rgba=_TIMBER, pos=cross, heading=heading)
    _cast_bar(builder, np.array([*xy_m, z]), top, 0.11)
    _cast_bar(builder, cross - arm, cross + arm, 0.06)
    builder.claim(xy_m, 0.7)
    return cross + arm + [0.0, 0.0, 0.1], cross - arm + [0.0, 0.0, 0.1]


def add_line(
    builder: SceneBuilder, spots_xy_m: list[Array], height_m: float, sag_m: float
) -> list[Array]:
    """Adds poles at ``spots_xy_m`` with two cables between neighbours. Returns the poles' tops,
    (3,)."""
    tops = []
    previous: tuple[Array, Array] | None = None
    for index, spot in enumerate(spots_xy_m):
        near = spots_xy_m[max(index - 1, 0)], spots_xy_m[min(index + 1, len(spots_xy_m) - 1)]
        span = near[1] - near[0]
        ends = add_pole(builder, spot, float(np.arctan2(span[1], span[0])), height_m)
        if previous is not None:
            for first, second in zip(previous, ends, strict=True):
                add_sagging_wire(builder, first, second, sag_m)
        previous = ends
        tops.append(0.5 * (ends[0] + ends[1]))
    return tops
