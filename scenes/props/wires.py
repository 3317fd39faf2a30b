"""Posts and wires: thin objects that are invisible from high above."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from touchdown.scenes.api import Array, Surface
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.props.street import STEEL

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
    share = np.linspace(0.0, 1.0, pieces + 1)[:, None]
    points = start_m + share * (end_m - start_m)
    points[:, 2] -= 4.0 * sag_m * (share * (1.0 - share))[:, 0]
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
