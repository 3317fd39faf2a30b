"""`lake`: a lake with beach, reeds, jetty and boats between meadows."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from touchdown.scenes.api import Array
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.generation import (
    Flood,
    finish,
    paint_terrain,
    scene_rng,
    start_scene,
)
from touchdown.scenes.authoring.ground import TEXELS, Canvas, Ground
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.authoring.plane import draw_heading, unit
from touchdown.scenes.authoring.plots import claim_free
from touchdown.scenes.authoring.relief import HeightField, level_takeoff, natural_ground, smoothstep
from touchdown.scenes.authoring.water import WaterLook, upsample
from touchdown.scenes.props.houses import House, add_house
from touchdown.scenes.props.plants import Nursery, add_bush, add_rock, add_tree, plant_nursery
from touchdown.scenes.props.street import add_bench, add_bin, add_fence, add_sign
from touchdown.scenes.props.waterside import (
    Deck,
    add_boat,
    add_boat_models,
    add_buoy,
    add_deck,
    add_molehill,
    add_net,
    add_pile,
    add_reeds,
    add_sailing_boat,
    grow_reeds,
    planks,
)

HALF_M = 64.0
NODES = 257
_TURNS = 720


class Shore(IntEnum):
    """Kinds of shore."""

    BEACH = 0
    REEDS = 1
    SHINGLE = 2
    BANK = 3


# Bank width (m), slope at the waterline, shelf width (m), slope of the shelf.
_PROFILE: dict[Shore, tuple[float, float, float, float]] = {
    Shore.BEACH: (15.0, 0.045, 7.0, 0.05),
    Shore.REEDS: (9.0, 0.05, 5.0, 0.09),
    Shore.SHINGLE: (10.0, 0.09, 3.5, 0.12),
    Shore.BANK: (2.4, 0.10, 1.2, 0.45),
}


@dataclass(frozen=True, kw_only=True, slots=True)
class Plan:
    """A lake about ``centre_xy_m`` whose outline is a Fourier series of the bearing."""

    centre_xy_m: Array
    radius_m: float
    waves: Array
    """(K, 2) amplitude (share of the radius) and phase of the k+2-th harmonic"""
    kinds: NDArray[np.int64]
    """(720,) shore kinds by bearing, half a degree each"""
    islet_xy_m: Array
    islet_radius_m: float
    """negative: there is none"""
    jetty_bearing: float
    takeoff_xy_m: Array
    takeoff_yaw: float

    def outline_m(self, bearing: Array) -> Array:
        """Radius of the plain outline at bearings in radians."""
        order = np.arange(len(self.waves)) + 2
        phase = np.multiply.outer(bearing, order) + self.waves[:, 1]
        return self.radius_m * (1.0 + np.cos(phase) @ self.waves[:, 0])

    def outer(self, xy_m: Array) -> Array:
        """0 in the middle of the lake, 1 near its shore and beyond."""
        reach = np.linalg.norm(np.asarray(xy_m) - self.centre_xy_m, axis=-1)
        return smoothstep(0.5, 0.75, reach / self.outline_m(self.bearing(xy_m)))

    def bearing(self, xy_m: Array) -> Array:
        rel = np.asarray(xy_m) - self.centre_xy_m
        return np.arctan2(rel[..., 1], rel[..., 0])

    def kind(self, bearing: Array) -> NDArray[np.int64]:
        """`Shore` at bearings in radians."""
        index = np.floor(np.asarray(bearing) / (2.0 * np.pi) * _TURNS).astype(int) % _TURNS
        return self.kinds[index]

    def shore_point(self, bearing: float, out_m: float) -> Array:
        """(2,) world point ``out_m`` outside the plain outline."""
        return self.shore_points(np.array([bearing]), np.array([out_m]))[0]

    def shore_points(self, bearing: Array, out_m: Array) -> Array:
        """(N, 2) world points ``out_m`` (N,) outside the plain outline at bearings (N,) or (1,)."""
        reach = self.outline_m(bearing) + out_m
        return self.centre_xy_m + reach[:, None] * unit(bearing)

    def middle_of(self, kind: Shore, rank: int = 0) -> float:
        """Bearing of the middle of the ``rank``-th longest stretch of a kind."""
        same = self.kinds == int(kind)
        start = int(np.argmin(same))
        turned = np.roll(same, -start).astype(int)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], turned, [0]])))
        runs = sorted(zip(edges[::2], edges[1::2], strict=True), key=lambda run: run[0] - run[1])
        first, last = runs[min(rank, len(runs) - 1)]
        return float((0.5 * (first + last) + start) / _TURNS * 2.0 * np.pi)


@dataclass(frozen=True, kw_only=True, slots=True)
class Basin:
    """The relief of a plan."""

    terrain: HeightField
    """what stands above the water, and the level water"""
    bottom_m: Array
    """(N, N) heights at the terrain's nodes without the water"""
    shore_m: Array
    """(N, N) metres from the waterline, negative in the lake"""
    level_m: float
    """world height of the water"""


def draw_plan(rng: np.random.Generator) -> Plan:
    """Returns a lake in the north-east of the take-off meadow, its nearest shore a beach or
    reeds."""
    takeoff = np.array([-36.0, -30.0]) + rng.uniform(-2.5, 2.5, 2)
    centre = np.array([9.0, 9.0]) + rng.uniform(-3.0, 3.0, 2)
    orders = np.arange(2, 8)
    amplitude = rng.uniform(0.4, 1.0, 6) * np.array([0.20, 0.11, 0.065, 0.045, 0.03, 0.022])
    waves = np.column_stack([amplitude, rng.uniform(0.0, 2.0 * np.pi, len(orders))])
    facing = float(np.arctan2(*(takeoff - centre)[::-1]))
    radius = rng.uniform(25.0, 31.0)
    plain = Plan(centre_xy_m=centre, radius_m=radius, waves=waves, kinds=np.zeros(_TURNS, np.int64),
                 islet_xy_m=centre, islet_radius_m=0.0, jetty_bearing=0.0, takeoff_xy_m=takeoff,
                 takeoff_yaw=0.0)  # fmt: skip
    # The survey flies over the shores on both sides of the nearest one.
    near = [Shore.BEACH, Shore.REEDS] if rng.random() < 0.5 else [Shore.REEDS, Shore.BEACH]
    rest = [Shore.SHINGLE, Shore.BANK, Shore.REEDS, Shore.SHINGLE, Shore.BANK]
    order = [near[0], Shore.BANK, *[rest[i] for i in rng.permutation(5)], near[1]]
    if rng.random() < 0.5:
        order[1] = Shore.SHINGLE
    widths = rng.uniform(0.7, 1.3, len(order)) * np.where(np.array(order) == Shore.BEACH, 1.7, 1.0)
    ends = np.cumsum(widths) / widths.sum()
    kinds = np.array(order)[np.searchsorted(ends, (np.arange(_TURNS) + 0.5) / _TURNS)]
    shift = facing / (2.0 * np.pi) * _TURNS - 0.15 * ends[0] * _TURNS
    plain = replace(plain, kinds=np.roll(kinds, round(shift)))
    jetty = plain.middle_of(Shore.SHINGLE if rng.random() < 0.6 else Shore.BANK)
    way = jetty + np.pi + rng.uniform(-1.0, 1.0)
    islet = centre + rng.uniform(0.22, 0.38) * radius * unit(way)
    islet_m = float(rng.uniform(2.6, 4.2)) if rng.random() < 0.7 else -9.0
    return replace(
        plain,
        islet_xy_m=islet,
        islet_radius_m=islet_m,
        jetty_bearing=jetty,
        takeoff_yaw=float(rng.uniform(-0.10, 0.10)),
    )


def profile(plan: Plan, bearing: Array) -> Array:
    """(..., 4) row of the shore's profile at bearings, blended over 20 degrees."""
    table = np.array([_PROFILE[Shore(int(kind))] for kind in plan.kinds])
    window = np.hanning(41)
    window /= window.sum()
    wrapped = np.concatenate([table[-20:], table, table[:20]])
    smooth = np.stack([np.convolve(column, window, "valid") for column in wrapped.T], axis=-1)
    return smooth[np.floor(bearing / (2.0 * np.pi) * _TURNS).astype(int) % _TURNS]


def shore_distance(rng: np.random.Generator, plan: Plan, xy: Array) -> Array:
    """(N, N) metres from the waterline at grid nodes, ragged by noise: the level-set function over
    its gradient, a distance to first order."""
    cell = float(xy[0, 1, 0] - xy[0, 0, 0])
    reach = np.linalg.norm(xy - plan.centre_xy_m, axis=-1)
    ragged = 1.1 * fractal_noise(rng, xy.shape[:2], 9.0 / cell, 3, 0.5).astype(np.float64)
    lake = reach - plan.outline_m(plan.bearing(xy)) + ragged
    islet = plan.islet_radius_m - np.linalg.norm(xy - plan.islet_xy_m, axis=-1) + 0.5 * ragged
    field = np.maximum(lake, islet)
    rise_y, rise_x = np.gradient(field, cell)
    steepness = ndimage.gaussian_filter(np.hypot(rise_x, rise_y), 1.5 / cell)
    return field / np.clip(steepness, 0.8, 1.6)


def shape_basin(rng: np.random.Generator, plan: Plan) -> Basin:
    """Returns meadows, banks and the lake's bed; the height at the take-off spot is 0."""
    ground = natural_ground(rng, NODES, HALF_M)
    xy = np.stack(HeightField(heights_m=ground, half_m=HALF_M).node_grid(), axis=-1)
    cell = float(xy[0, 1, 0] - xy[0, 0, 0])
    shore = shore_distance(rng, plan, xy)
    row = profile(plan, plan.bearing(xy))
    width, rise, shelf, fall = np.moveaxis(row, -1, 0)
    # Towards the middle, where the bearings meet, one bed for all.
    outer = plan.outer(xy)
    shelf, fall = outer * shelf + (1.0 - outer) * 2.0, outer * fall + (1.0 - outer) * 0.2
    meadow = np.maximum(ground - ground.mean() + rng.uniform(0.95, 1.25), 0.35)
    into = smoothstep(0.0, 1.0, shore / width)
    land = (1.0 - into) * rise * shore + into * meadow
    islet = plan.islet_radius_m + 1.0 - np.linalg.norm(xy - plan.islet_xy_m, axis=-1)
    land = np.where(islet > 0.0, 0.35 * smoothstep(0.0, 3.0, shore) + 0.05 * shore, land)
    out = np.maximum(-shore, 0.0)
    sink = smoothstep(0.0, 1.0, (out - shelf) / 9.0)
    bumps = 0.05 * fractal_noise(rng, ground.shape, 2.4 / cell, 2).astype(np.float64)
    bed = -(1.0 - sink) * fall * out - sink * rng.uniform(2.6, 3.6)
    bed += bumps * smoothstep(0.4, 2.5, out)
    heights = np.where(shore >= 0.0, land, bed)
    takeoff = float(HeightField(heights_m=heights, half_m=HALF_M).at(plan.takeoff_xy_m))
    bottom = level_takeoff(heights, HALF_M, plan.takeoff_xy_m).heights_m
    terrain = HeightField(heights_m=np.maximum(bottom, -takeoff), half_m=HALF_M)
    return Basin(terrain=terrain, bottom_m=bottom, shore_m=shore, level_m=-takeoff)


TIMBER = (150.0, 134.0, 112.0)


class Surroundings:
    """Distances from the waterline and depths of the ground."""

    def __init__(self, plan: Plan, basin: Basin) -> None:
        self.plan, self.basin = plan, basin
        self._shore = HeightField(heights_m=basin.shore_m, half_m=HALF_M)

    def shore_m(self, xy_m: Array) -> float:
        """Metres from the waterline, negative in the lake."""
        return float(self._shore.at(xy_m))

    def on_shore(self, bearing: float, out_m: float) -> Array:
        """The point at ``out_m`` from the true waterline along a bearing."""
        # Not as far in as the islet's own shore.
        steps = np.arange(-11.0, 14.0, 0.1)
        points = self.plan.shore_points(np.array([bearing]), steps)
        return points[int(np.argmin(np.abs(self._shore.at(points) - out_m)))]

    def scatter(
        self, builder: SceneBuilder, count: int, shore_m: tuple[float, float], gap_m: float
    ) -> list[Array]:
        """Up to ``count`` free spots anywhere at such distances from the waterline, claimed."""
        low, high = shore_m
        spots = (builder.rng.uniform(-HALF_M + 3.0, HALF_M - 3.0, 2) for _ in range(40 * count))
        near = (spot for spot in spots if low < self.shore_m(spot) < high)
        return claim_free(builder, near, count, gap_m)


def footpath(plan: Plan, rng: np.random.Generator) -> Array:
    """(N, 2) a path around the lake, some metres from its shore."""
    turn = np.linspace(0.0, 2.0 * np.pi, 240)
    phase, sway = rng.uniform(0.0, 6.0), rng.uniform(0.8, 1.6)
    out = 12.5 + sway * np.sin(7.0 * turn + phase)
    smooth = plan.shore_points(turn, out)
    smooth[-1] = smooth[0]
    return smooth


def place_objects(
    builder: SceneBuilder, plan: Plan, basin: Basin, nursery: Nursery, path: Array
) -> None:
    """Adds jetty, boats, reeds, beach, trees, benches, rocks, fence and molehills."""
    around = Surroundings(plan, basin)
    builder.claim(plan.takeoff_xy_m, 6.0)
    for spot in path[::2]:
        builder.claim(spot, 1.0)
    _place_jetty(builder, around)
    _place_beach(builder, around)
    _place_islet(builder, plan, nursery)
    _place_reeds(builder, around)
    _place_benches(builder, plan, path)
    _place_rocks(builder, around)
    _place_pasture(builder, around)
    rng = builder.rng
    for spot in around.scatter(builder, int(rng.integers(19, 25)), (10.5, 70.0), 3.2):
        add_tree(builder, nursery, spot, rng.uniform(0.85, 1.45))
    for spot in around.scatter(builder, 12, (9.5, 70.0), 1.2):
        add_bush(builder, nursery, spot)
    for spot in around.scatter(builder, 6, (6.0, 40.0), 0.8):
        add_rock(builder, spot, rng.uniform(0.22, 0.5))


def _place_jetty(builder: SceneBuilder, around: Surroundings) -> None:
    """Adds a jetty with a head, boats moored to it, a boathouse on land."""
    rng, plan, level = builder.rng, around.plan, around.basin.level_m
    bearing = plan.jetty_bearing
    root = around.on_shore(bearing, 1.6)
    inward = bearing + np.pi
    way = unit(inward)
    length, width = float(rng.uniform(12.0, 16.0)), float(rng.uniform(1.7, 2.0))
    top = max(level + 0.5, builder.terrain.point(*root) + 0.04)
    parts = [Deck(centre_xy_m=root + 0.5 * length * way, angle=inward, size_m=(length, width),
             top_m=top), Deck(centre_xy_m=root + (length + 0.9) * way, angle=inward + 0.5 * np.pi,
             size_m=(5.2, 1.9), top_m=top)]  # fmt: skip
    models = add_boat_models(builder, 4)
    for part in parts:
        add_deck(builder, part, planks(rng, part.size_m, 96.0, TIMBER))
        reach, side = 0.5 * part.size_m[0] - 0.15, 0.5 * part.size_m[1] + 0.08
        count = max(2, round(part.size_m[0] / 3.2))
        feet = [[x, y] for x in np.linspace(-reach, reach, count) for y in (-side, side)]
        for spot in part.points(np.array(feet)):
            add_pile(builder, spot, top + float(rng.uniform(0.35, 0.7)))
        for x in np.arange(-reach, reach + 0.1, 1.0):
            builder.claim(part.points(np.array([[x, 0.0]]))[0], side)
    for index, (x, y) in enumerate(((0.18, 1.0), (0.26, -1.0), (-0.08, -1.0))):
        local = np.array([[x * length, y * (0.5 * width + 1.15)]])
        spot = parts[0].points(local)[0]
        if around.shore_m(spot) < -1.5:
            heading = inward + rng.uniform(-0.12, 0.12) + (np.pi if rng.random() < 0.5 else 0.0)
            add_boat(builder, models[index], spot, heading)
    add_boat(builder, models[3], around.on_shore(bearing + 0.22, 3.4), bearing + 1.2, upturned=True)
    add_boat(builder, models[2], around.on_shore(bearing + 0.30, 3.2), bearing + 1.3, upturned=True)
    add_boat(builder, models[1], around.on_shore(bearing - 1.3, -9.0), rng.uniform(0.0, 6.3))
    add_sailing_boat(builder, around.on_shore(bearing + 0.75, -10.0), rng.uniform(0.0, 6.3))
    shed = around.on_shore(bearing - 0.20, 5.2)
    add_house(builder, House(centre_xy_m=shed, angle=inward, size_m=(6.0, 4.4, 2.3), ridge_m=1.5))


def _place_beach(builder: SceneBuilder, around: Surroundings) -> None:
    """Adds a net on the sand, a line of floats around the bathing water, an upright sign."""
    rng = builder.rng
    middle = around.plan.middle_of(Shore.BEACH)
    side = rng.choice([-0.13, 0.13])
    add_net(builder, around.on_shore(middle + side, 5.0), middle)
    bearings = np.linspace(middle - 0.36, middle + 0.36, 11)
    for index, bearing in enumerate(bearings):
        out = -8.5 * (1.0 - 0.8 * abs(2.0 * index / 10.0 - 1.0) ** 3)
        colour = [0.84, 0.14, 0.10, 1] if index % 2 else [0.95, 0.95, 0.93, 1]
        add_buoy(builder, around.plan.shore_point(float(bearing), out - 1.0), 0.24, colour)
    add_sign(builder, around.on_shore(middle - 2.0 * side, 8.0), middle + np.pi, [0.9, 0.9, 0.9, 1])
    add_bin(builder, around.on_shore(middle - 1.4 * side, 9.4), [0.16, 0.30, 0.20, 1])


def _place_islet(builder: SceneBuilder, plan: Plan, nursery: Nursery) -> None:
    if plan.islet_radius_m < 0.0:
        return
    add_tree(builder, nursery, plan.islet_xy_m, float(builder.rng.uniform(0.7, 0.95)))
    for _ in range(3):
        turn = builder.rng.uniform(0.0, 2.0 * np.pi)
        reach = plan.islet_radius_m * builder.rng.uniform(0.7, 1.0)
        spot = plan.islet_xy_m + reach * unit(turn)
        add_rock(builder, spot, builder.rng.uniform(0.3, 0.6))
    builder.claim(plan.islet_xy_m, plan.islet_radius_m + 1.5)


def _place_reeds(builder: SceneBuilder, around: Surroundings, limit: int = 74) -> None:
    """Adds tufts close together in the shallows and on the mud of the reedy stretches."""
    rng, plan = builder.rng, around.plan
    bed = grow_reeds(builder)
    reedy = np.flatnonzero(plan.kinds == int(Shore.REEDS))
    grown = 0
    for _ in range(8 * limit):
        bearing = float((rng.choice(reedy) + rng.uniform()) / len(plan.kinds) * 2.0 * np.pi)
        out = float(rng.normal(-1.2, 1.5))
        if grown >= limit or not -4.5 < out < 2.2 or np.sin(9.0 * bearing) < -0.75:
            continue
        spot = around.on_shore(bearing, out)
        if builder.is_free(spot, 0.45):
            add_reeds(builder, bed, spot)
            grown += 1


def _place_benches(builder: SceneBuilder, plan: Plan, path: Array) -> None:
    """Adds benches beside the path that look over the lake."""
    for index in range(10, len(path), 34):
        bearing = float(plan.bearing(path[index]))
        spot = path[index] + 1.9 * unit(bearing)
        inside = (np.abs(spot) < HALF_M - 3.0).all()
        if inside and builder.is_free(spot, 0.6):
            add_bench(builder, spot, bearing + np.pi)


def _place_rocks(builder: SceneBuilder, around: Surroundings) -> None:
    """Adds boulders along the shingle, some of them in the water."""
    rng, plan = builder.rng, around.plan
    stony = np.flatnonzero(plan.kinds == int(Shore.SHINGLE))
    for _ in range(18):
        bearing = float(rng.choice(stony) / len(plan.kinds) * 2.0 * np.pi)
        spot = around.on_shore(bearing, float(rng.uniform(-2.6, 5.0)))
        if builder.is_free(spot, 0.9):
            add_rock(builder, spot, rng.uniform(0.25, 0.8))


def _place_pasture(builder: SceneBuilder, around: Surroundings) -> None:
    """Adds a fence along an edge of the scene, and molehills in the grass near the take-off
    spot."""
    rng, plan = builder.rng, around.plan
    x = -57.0 + rng.uniform(-2.0, 2.0)
    for start in np.arange(-12.0, 50.0, 21.0):
        add_fence(builder, np.array([x, start]), np.array([x, start + 20.0]), [0.50, 0.40, 0.30, 1])
    for _ in range(2):
        turn = float(plan.takeoff_yaw) + rng.uniform(-0.9, 1.4)
        middle = plan.takeoff_xy_m + rng.uniform(9.0, 15.0) * unit(turn)
        for _ in range(7):
            spot = middle + rng.normal(0.0, 1.9, 2)
            if builder.is_free(spot, 0.5) and around.shore_m(spot) > 2.0:
                add_molehill(builder, spot)


def generate(seed: int) -> SceneDraft:
    """Returns the scene of ``seed`` without the vehicle. The same seed gives the same bytes."""
    rng = scene_rng("lake", seed)
    plan = draw_plan(rng)
    basin = shape_basin(rng, plan)
    builder = start_scene("lake", rng, basin.terrain)
    nursery = plant_nursery(builder)
    path = footpath(plan, rng)
    place_objects(builder, plan, basin, nursery, path)
    canvas = Canvas(half_m=HALF_M)
    paint_shore(rng, canvas, plan, basin)
    paint_fields(rng, canvas)
    paint_strand(rng, canvas, plan)
    canvas.track(path, 1.9, Ground.GRAVEL)
    rows = dict.fromkeys(Ground, float(rng.uniform(0.0, np.pi)))
    depth = upsample(basin.level_m - basin.bottom_m, TEXELS // 2)
    flood = Flood(depth_m=depth, draw_look=draw_look)
    ground = paint_terrain(builder, canvas, rows, flood=flood)
    return finish(plan, builder, ground)


def draw_look(rng: np.random.Generator) -> WaterLook:
    """Returns the look of water from clear blue-green to brown."""
    peat = float(rng.uniform(0.0, 1.0)) ** 2
    clear, brown = np.array([26.0, 74.0, 84.0]), np.array([44.0, 56.0, 44.0])
    red, green, blue = (1.0 - peat) * clear + peat * brown
    return WaterLook(
        body=(red, green, blue),
        clarity_m=(0.55 - 0.1 * peat, 1.0 - 0.35 * peat, 0.9 - 0.5 * peat),
        wave_m=float(rng.uniform(0.8, 1.4)),
        ripple=float(rng.uniform(0.3, 0.55)),
        wind_angle=draw_heading(rng),
    )


_SIZE = TEXELS // 4
_CORNERS = (
    ((-54.0, 30.0), (-37.0, 32.0), (-27.0, 70.0), (-55.0, 70.0)),
    ((18.0, -46.0), (18.0, -70.0), (70.0, -70.0), (70.0, -38.0)),
)
"""Outlines of the fields (x, y), metres; they end at the edge of the scene."""


def paint_shore(rng: np.random.Generator, canvas: Canvas, plan: Plan, basin: Basin) -> None:
    """Paints meadow, mown grass about the take-off spot, and the shore by its kind, edges
    frayed."""
    axis = (np.arange(_SIZE) + 0.5) / _SIZE * 2.0 * HALF_M - HALF_M
    xy = np.stack(np.meshgrid(axis, axis), axis=-1)
    shore = upsample(basin.shore_m, _SIZE)
    cells = _SIZE / (2.0 * HALF_M)
    fray = np.clip(fractal_noise(rng, (_SIZE, _SIZE), 4.0 * cells, 4, 0.6), -1.3, 1.3)
    wander = fractal_noise(rng, (_SIZE, _SIZE), 7.0 * cells, 2, 0.5)
    kind = plan.kind(plan.bearing(xy) + 0.05 * wander + 0.025 * fray)
    layer = np.full((_SIZE, _SIZE), int(Ground.MEADOW), np.uint8)
    home = np.linalg.norm(xy - plan.takeoff_xy_m, axis=-1)
    mown = (home < 12.0 + 0.6 * fray) | (np.abs(shore - 11.5) < 4.5 + 0.8 * fray)
    layer[mown] = int(Ground.LAWN)
    limits = {
        Shore.BEACH: ((9.5, 1.3, Ground.BEACH),),
        Shore.REEDS: ((3.6, 1.0, Ground.MUD),),
        Shore.SHINGLE: ((6.0, 1.2, Ground.GRAVEL), (2.6, 0.5, Ground.BEACH)),
        Shore.BANK: ((1.5, 0.7, Ground.WORN), (-0.4, 0.4, Ground.MUD)),
    }
    for which, bands in limits.items():
        for edge, spread, material in bands:
            layer[(kind == which) & (shore < edge + spread * fray)] = int(material)
    layer[(plan.outer(xy) < 0.55 + 0.3 * fray) & (shore < -1.0)] = int(Ground.MUD)
    islet = np.linalg.norm(xy - plan.islet_xy_m, axis=-1) < plan.islet_radius_m + 3.0 + 1.2 * fray
    layer[islet & (shore > 1.4 + 0.4 * fray)] = int(Ground.MEADOW)
    layer[islet & (shore <= 1.4 + 0.4 * fray)] = int(Ground.GRAVEL)
    canvas.material[:] = cv2.resize(layer, canvas.material.shape, interpolation=cv2.INTER_NEAREST)


def paint_fields(rng: np.random.Generator, canvas: Canvas) -> None:
    """Paints fields in two corners of the scene, away from the lake."""
    kinds = rng.permutation([int(Ground.SOIL), int(Ground.CROPS), int(Ground.LAWN)])
    for corner, kind in zip(_CORNERS, kinds[:2], strict=True):
        outline = np.array(corner) + rng.uniform(-2.0, 2.0, (4, 2))
        canvas.fill(outline, Ground(int(kind)))


def paint_strand(rng: np.random.Generator, canvas: Canvas, plan: Plan) -> None:
    """Paints drift lines on the beach."""
    for index in range(2):
        out = 0.7 + 1.5 * index + rng.uniform(-0.2, 0.2)
        beach = plan.middle_of(Shore.BEACH)
        for start in np.arange(beach - 0.6, beach + 0.6, 0.05):
            if rng.random() < 0.6:
                turn = start + np.linspace(0.0, 0.05, 8)
                line = plan.shore_points(turn, np.array([out]))
                canvas.trace(line + rng.normal(0.0, 0.05, line.shape), 0.08, 60)
