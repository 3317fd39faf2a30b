"""`lake`: a lake with beach, reeds, jetty and boats between meadows."""

import cv2
import numpy as np

from touchdown.scenes.api import Array
from touchdown.scenes.authoring import generation
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.ground import TEXELS, Canvas, Ground
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.authoring.plane import draw_heading, unit
from touchdown.scenes.authoring.plots import Plot, claim_free
from touchdown.scenes.authoring.relief import HALF_M, HeightField, cell_grid
from touchdown.scenes.authoring.water import WaterLook, upsample
from touchdown.scenes.places.lake import layout
from touchdown.scenes.props import waterside
from touchdown.scenes.props.houses import House, add_house
from touchdown.scenes.props.plants import Nursery, add_bush, add_rock, add_tree, plant_nursery
from touchdown.scenes.props.street import add_bench, add_bin, add_fence, add_sign

TIMBER = (150.0, 134.0, 112.0)


class Surroundings:
    """Distances from the waterline and depths of the ground."""

    def __init__(self, plan: layout.Plan, basin: layout.Basin) -> None:
        self.plan, self.basin = plan, basin
        self._shore = HeightField(heights_m=basin.shore_m)

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


def footpath(plan: layout.Plan, rng: np.random.Generator) -> Array:
    """(N, 2) a path around the lake, some metres from its shore."""
    turn = np.linspace(0.0, 2.0 * np.pi, 240)
    phase, sway = rng.uniform(0.0, 6.0), rng.uniform(0.8, 1.6)
    out = 12.5 + sway * np.sin(7.0 * turn + phase)
    smooth = plan.shore_points(turn, out)
    smooth[-1] = smooth[0]
    return smooth


def place_objects(
    builder: SceneBuilder, plan: layout.Plan, basin: layout.Basin, nursery: Nursery, path: Array
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
    parts = [
        waterside.Deck(
            plot=Plot(origin_xy_m=root + along * way, angle=angle), size_m=size, top_m=top
        )
        for along, angle, size in (
            (0.5 * length, inward, (length, width)),
            (length + 0.9, inward + 0.5 * np.pi, (5.2, 1.9)),
        )
    ]
    models = waterside.add_boat_models(builder, 4)
    for part in parts:
        waterside.add_deck(builder, part, waterside.planks(rng, part.size_m, 96.0, TIMBER))
        reach, side = 0.5 * part.size_m[0] - 0.15, 0.5 * part.size_m[1] + 0.08
        count = max(2, round(part.size_m[0] / 3.2))
        feet = [[x, y] for x in np.linspace(-reach, reach, count) for y in (-side, side)]
        for spot in part.plot.points(np.array(feet)):
            waterside.add_pile(builder, spot, top + float(rng.uniform(0.35, 0.7)))
        for x in np.arange(-reach, reach + 0.1, 1.0):
            builder.claim(part.plot.at(x, 0.0), side)
    for index, (x, y) in enumerate(((0.18, 1.0), (0.26, -1.0), (-0.08, -1.0))):
        spot = parts[0].plot.at(x * length, y * (0.5 * width + 1.15))
        if around.shore_m(spot) < -1.5:
            heading = inward + rng.uniform(-0.12, 0.12) + (np.pi if rng.random() < 0.5 else 0.0)
            waterside.add_boat(builder, models[index], spot, heading)
    waterside.add_boat(
        builder, models[3], around.on_shore(bearing + 0.22, 3.4), bearing + 1.2, upturned=True
    )
    waterside.add_boat(
        builder, models[2], around.on_shore(bearing + 0.30, 3.2), bearing + 1.3, upturned=True
    )
    waterside.add_boat(
        builder, models[1], around.on_shore(bearing - 1.3, -9.0), rng.uniform(0.0, 6.3)
    )
    waterside.add_sailing_boat(
        builder, around.on_shore(bearing + 0.75, -10.0), rng.uniform(0.0, 6.3)
    )
    shed = around.on_shore(bearing - 0.20, 5.2)
    add_house(builder, House(centre_xy_m=shed, angle=inward, size_m=(6.0, 4.4, 2.3), ridge_m=1.5))


def _place_beach(builder: SceneBuilder, around: Surroundings) -> None:
    """Adds a net on the sand, a line of floats around the bathing water, an upright sign."""
    rng = builder.rng
    middle = around.plan.middle_of(layout.Shore.BEACH)
    side = rng.choice([-0.13, 0.13])
    waterside.add_net(builder, around.on_shore(middle + side, 5.0), middle)
    bearings = np.linspace(middle - 0.36, middle + 0.36, 11)
    for index, bearing in enumerate(bearings):
        out = -8.5 * (1.0 - 0.8 * abs(2.0 * index / 10.0 - 1.0) ** 3)
        colour = [0.84, 0.14, 0.10, 1] if index % 2 else [0.95, 0.95, 0.93, 1]
        waterside.add_buoy(
            builder, around.plan.shore_point(float(bearing), out - 1.0), 0.24, colour
        )
    add_sign(builder, around.on_shore(middle - 2.0 * side, 8.0), middle + np.pi, [0.9, 0.9, 0.9, 1])
    add_bin(builder, around.on_shore(middle - 1.4 * side, 9.4), [0.16, 0.30, 0.20, 1])


def _place_islet(builder: SceneBuilder, plan: layout.Plan, nursery: Nursery) -> None:
    if plan.islet_radius_m < 0.0:
        return
    add_tree(builder, nursery, plan.islet_xy_m, float(builder.rng.uniform(0.7, 0.95)))
    for _ in range(3):
        turn = builder.rng.uniform(0.0, 2.0 * np.pi)
        reach = plan.islet_radius_m * builder.rng.uniform(0.7, 1.0)
        spot = plan.islet_xy_m + reach * unit(turn)
        add_rock(builder, spot, builder.rng.uniform(0.3, 0.6))
    builder.claim(plan.islet_xy_m, plan.islet_radius_m + 1.5)


def _place_reeds(builder: SceneBuilder, around: Surroundings) -> None:
    """Adds tufts close together in the shallows and on the mud of the reedy stretches."""
    rng, plan, limit = builder.rng, around.plan, 74
    bed = waterside.grow_reeds(builder)
    reedy = np.flatnonzero(plan.kinds == int(layout.Shore.REEDS))
    grown = 0
    for _ in range(8 * limit):
        bearing = float((rng.choice(reedy) + rng.uniform()) / len(plan.kinds) * 2.0 * np.pi)
        out = float(rng.normal(-1.2, 1.5))
        if grown >= limit or not -4.5 < out < 2.2 or np.sin(9.0 * bearing) < -0.75:
            continue
        spot = around.on_shore(bearing, out)
        if builder.is_free(spot, 0.45):
            waterside.add_reeds(builder, bed, spot)
            grown += 1


def _place_benches(builder: SceneBuilder, plan: layout.Plan, path: Array) -> None:
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
    stony = np.flatnonzero(plan.kinds == int(layout.Shore.SHINGLE))
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
                waterside.add_molehill(builder, spot)


def generate(seed: int) -> SceneDraft:
    """Returns the scene of ``seed`` without the vehicle. The same seed gives the same bytes."""
    rng = generation.scene_rng("lake", seed)
    plan = layout.draw_plan(rng)
    basin = layout.shape_basin(rng, plan)
    builder = generation.start_scene("lake", rng, basin.terrain)
    nursery = plant_nursery(builder)
    path = footpath(plan, rng)
    place_objects(builder, plan, basin, nursery, path)
    canvas = Canvas()
    paint_shore(rng, canvas, plan, basin)
    paint_fields(rng, canvas)
    paint_strand(rng, canvas, plan)
    canvas.track(path, 1.9, Ground.GRAVEL)
    rows = dict.fromkeys(Ground, float(rng.uniform(0.0, np.pi)))
    depth = upsample(basin.level_m - basin.bottom_m, TEXELS // 2)
    flood = generation.Flood(depth_m=depth, draw_look=draw_look)
    ground = generation.paint_terrain(builder, canvas, rows, flood=flood)
    return generation.finish(plan, builder, ground)


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


def paint_shore(
    rng: np.random.Generator, canvas: Canvas, plan: layout.Plan, basin: layout.Basin
) -> None:
    """Paints meadow, mown grass about the take-off spot, and the shore by its kind, edges
    frayed."""
    xy = cell_grid(_SIZE)
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
        layout.Shore.BEACH: ((9.5, 1.3, Ground.BEACH),),
        layout.Shore.REEDS: ((3.6, 1.0, Ground.MUD),),
        layout.Shore.SHINGLE: ((6.0, 1.2, Ground.GRAVEL), (2.6, 0.5, Ground.BEACH)),
        layout.Shore.BANK: ((1.5, 0.7, Ground.WORN), (-0.4, 0.4, Ground.MUD)),
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


def paint_strand(rng: np.random.Generator, canvas: Canvas, plan: layout.Plan) -> None:
    """Paints drift lines on the beach."""
    for index in range(2):
        out = 0.7 + 1.5 * index + rng.uniform(-0.2, 0.2)
        beach = plan.middle_of(layout.Shore.BEACH)
        for start in np.arange(beach - 0.6, beach + 0.6, 0.05):
            if rng.random() < 0.6:
                turn = start + np.linspace(0.0, 0.05, 8)
                line = plan.shore_points(turn, np.array([out]))
                canvas.trace(line + rng.normal(0.0, 0.05, line.shape), 0.08, 60)
