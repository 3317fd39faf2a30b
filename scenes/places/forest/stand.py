"""Positions and kinds of the trees."""

from __future__ import annotations

import numpy as np

from touchdown.scenes.api import Array
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.authoring.plane import pick
from touchdown.scenes.places.forest.layout import HALF_M, Plan
from touchdown.scenes.props.woods import (
    TRUNKS_M,
    Wood,
    add_broadleaf,
    add_conifer,
    add_sapling,
    add_shrub,
)

TREES = 222
UNDERGROWTH = 54
TREE_TOP_M = 17.0
"""No tree reaches higher over the take-off spot."""
_GRID = 128
_OVERLAP = 0.62
"""Neighbouring crowns reach into one another: share of their radii that stays apart."""


def plant(builder: SceneBuilder, wood: Wood, plan: Plan) -> None:
    """Trees in groups of their kind, dense except where the ground is clear; undergrowth between
    them and along the edges."""
    rng = builder.rng
    kind = fractal_noise(rng, (_GRID, _GRID), 24.0, 2, 0.4)
    density = fractal_noise(rng, (_GRID, _GRID), 18.0, 2, 0.5)
    species = fractal_noise(rng, (_GRID, _GRID), 13.0, 2, 0.5)
    spots = rng.uniform(-HALF_M + 1.5, HALF_M - 1.5, (7000, 2))
    open_m = open_ground(plan, spots)
    standing = np.zeros((0, 3))
    for spot, room in zip(spots, open_m, strict=True):
        if len(standing) == TREES:
            break
        row, col = ((spot[::-1] + HALF_M) / (2.0 * HALF_M) * (_GRID - 1)).astype(int)
        if room < 1.2 or density[row, col] < -1.5 + 0.5 * rng.random():
            continue
        conifer = kind[row, col] + 0.35 * rng.standard_normal() > 0.05
        radius = _plant_one(builder, wood, spot, conifer, room, float(species[row, col]), standing)
        if radius > 0.0:
            standing = np.concatenate([standing, [[*spot, radius]]])
    _undergrow(builder, wood, plan, standing)


def open_ground(plan: Plan, xy_m: Array) -> Array:
    """(N, 2) -> (N,) metres to the nearest clearing, track or brook; negative on them."""
    to_track, _ = plan.track.nearest(xy_m)
    to_brook, _ = plan.brook.nearest(xy_m)
    ways = np.minimum(to_track - 2.0, to_brook - 2.0)
    return np.minimum(plan.clearing_distance(xy_m), ways)


def _plant_one(
    builder: SceneBuilder,
    wood: Wood,
    spot: Array,
    conifer: bool,
    room_m: float,
    species: float,
    standing: Array,
) -> float:
    """Plants the tallest tree of up to three drawn that has room. Returns its crown's radius, 0
    where none has."""
    rng = builder.rng
    crowns = wood.conifers if conifer else wood.crowns
    gap = np.linalg.norm(standing[:, :2] - spot, axis=1) - _OVERLAP * standing[:, 2]
    nearest = float(gap.min()) if len(gap) else 99.0
    ceiling = TREE_TOP_M - builder.terrain.point(*spot)
    trunk_m = pick(rng, TRUNKS_M)
    drawn = np.sort(rng.integers(0, len(crowns), 3))[::-1]
    for index in drawn:
        crown = crowns[int(index)]
        top = crown.height_m if conifer else trunk_m + 2.0 * crown.height_m
        fits = _OVERLAP * crown.radius_m <= nearest and 0.55 * crown.radius_m <= room_m
        if not fits or top > ceiling or not builder.is_free(spot, 0.8):
            continue
        if conifer:
            count = len(wood.needles)
            leaf = int(np.clip(0.5 * count + 0.9 * species + rng.normal(0.0, 0.5), 0, count - 1))
            add_conifer(builder, wood, spot, crown, wood.needles[leaf])
        else:
            count = len(wood.leaves)
            leaf = int(np.clip(0.5 * count + 1.2 * species + rng.normal(0.0, 0.5), 0, count - 1))
            add_broadleaf(builder, wood, spot, crown, wood.leaves[leaf], trunk_m)
        return crown.radius_m
    return 0.0


def _undergrow(builder: SceneBuilder, wood: Wood, plan: Plan, standing: Array) -> None:
    """Saplings and shrubs wherever no trunk is near, most of them at the edges of clearings."""
    rng = builder.rng
    spots = rng.uniform(-HALF_M + 1.0, HALF_M - 1.0, (2600, 2))
    open_m = open_ground(plan, spots)
    placed = np.zeros((0, 2))
    for spot, room in zip(spots, open_m, strict=True):
        if len(placed) == UNDERGROWTH:
            break
        near = room < 3.5
        if room < 0.4 or (not near and rng.random() < 0.7):
            continue
        trunk_gap = np.linalg.norm(standing[:, :2] - spot, axis=1) - 0.45 * standing[:, 2]
        if trunk_gap.min() < 0.7 or not builder.is_free(spot, 0.8):
            continue
        if len(placed) and np.linalg.norm(placed - spot, axis=1).min() < 1.5:
            continue
        (add_sapling if rng.random() < 0.45 else add_shrub)(builder, wood, spot)
        placed = np.concatenate([placed, [spot]])
