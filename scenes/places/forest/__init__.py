"""`forest`: wooded hills with clearings, a brook and a track."""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import Array, Surface
from touchdown.scenes.authoring.builder import SceneBuilder, quat_zy, turned
from touchdown.scenes.authoring.draft import SceneDraft
from touchdown.scenes.authoring.generation import finish, paint_terrain, scene_rng, start_scene
from touchdown.scenes.authoring.ground import TEXELS, Canvas, Ground
from touchdown.scenes.authoring.meshes import MeshData, box
from touchdown.scenes.authoring.noise import fractal_noise, tileable_noise
from touchdown.scenes.authoring.plane import SQUARE, pick, rotated, unit
from touchdown.scenes.authoring.plots import claim_free
from touchdown.scenes.authoring.relief import HALF_M, cell_grid
from touchdown.scenes.places.forest import layout
from touchdown.scenes.props import woods
from touchdown.scenes.props.plants import add_rock
from touchdown.scenes.props.street import WOOD

WATER = Surface(land_class="water", reflectivity=0.05, water=True)
BRIDGE = Surface(land_class="path", reflectivity=0.35)
_TIMBER = [0.46, 0.37, 0.27, 1.0]
_WATER_HALF_M = 0.95


def furnish(builder: SceneBuilder, wood: woods.Wood, plan: layout.Plan) -> None:
    """Adds the objects that later plants keep away from."""
    builder.claim(plan.frame.takeoff_xy_m, 5.0)
    add_water(builder, plan)
    add_bridge(builder, plan)
    for clearing in plan.clearings:
        if clearing.kind == "stumps":
            _fell(builder, wood, clearing)
        elif clearing.kind == "boulders":
            for spot in _scatter(builder, clearing, 15, 0.0, 1.3):
                add_rock(builder, spot, float(builder.rng.uniform(0.3, 0.85)))
        elif clearing.kind == "slope":
            for spot in _scatter(builder, clearing, 4, 0.0, 1.6):
                add_rock(builder, spot, float(builder.rng.uniform(0.25, 0.5)))
    safe = plan.clearings[1]
    add_hide(builder, _edge_spot(builder, plan, safe), safe.centre_xy_m)
    _add_log_pile(builder, wood, plan)
    _strew(builder, wood, plan)


def _scatter(
    builder: SceneBuilder, clearing: layout.Clearing, count: int, margin_m: float, gap_m: float
) -> list[Array]:
    """Up to ``count`` free spots in a clearing, ``margin_m`` from its edge."""
    reach = clearing.radius_m * 1.2
    spots = clearing.centre_xy_m + builder.rng.uniform(-reach, reach, (30 * count, 2))
    inside = spots[clearing.distance(spots) < -margin_m]
    return claim_free(builder, inside, count, gap_m, 0.5 * gap_m)


def _fell(builder: SceneBuilder, wood: woods.Wood, clearing: layout.Clearing) -> None:
    """A felled patch: low stumps in high grass, and a few trunks left behind."""
    rng = builder.rng
    for spot in _scatter(builder, clearing, 3, 2.0, 2.0):
        angle, half = rng.uniform(0.0, np.pi), 0.5 * rng.uniform(3.0, 5.5)
        axis = half * unit(angle)
        woods.add_log(builder, wood, spot - axis, spot + axis, float(rng.uniform(0.12, 0.22)))
    for spot in _scatter(builder, clearing, 22, 0.3, 1.1):
        woods.add_stump(builder, wood, spot)


def _edge_spot(builder: SceneBuilder, plan: layout.Plan, clearing: layout.Clearing) -> Array:
    """(2,) a free spot at the edge of a clearing, away from track and brook."""
    turn = builder.rng.uniform(0.0, 2.0 * np.pi) + np.linspace(0.0, 2.0 * np.pi, 24)
    ring = unit(turn)
    spots = clearing.centre_xy_m + (clearing.radius_m + 1.2) * ring
    room = np.minimum(plan.track.nearest(spots)[0] - 4.0, plan.brook.nearest(spots)[0] - 4.5)
    free = np.flatnonzero(room > 0.0)
    return np.asarray(spots[int(free[0]) if len(free) else int(room.argmax())])


def _strew(builder: SceneBuilder, wood: woods.Wood, plan: layout.Plan) -> None:
    """Fallen trunks and rocks on the forest floor, rocks in and beside the brook."""
    rng = builder.rng
    spots = rng.uniform(-HALF_M + 6.0, HALF_M - 6.0, (400, 2))
    far = np.minimum(plan.track.nearest(spots)[0], plan.brook.nearest(spots)[0])
    free = spots[(plan.clearing_distance(spots) > 3.0) & (far > 6.0)]
    for spot in free[:9]:
        angle, half = rng.uniform(0.0, np.pi), 0.5 * rng.uniform(5.0, 9.0)
        axis = half * unit(angle)
        if builder.is_free(spot, 2.0):
            woods.add_log(builder, wood, spot - axis, spot + axis, float(rng.uniform(0.16, 0.30)))
    for spot in free[9:26]:
        if builder.is_free(spot, 0.8):
            add_rock(builder, spot, float(rng.uniform(0.4, 1.1)))
    inside = np.flatnonzero((np.abs(plan.brook.line_m) < HALF_M - 2.0).all(axis=1))
    for index in rng.choice(inside, 14, replace=False):
        spot = plan.brook.beside(int(index), float(rng.normal(0.0, 1.0)))
        if plan.track.nearest(spot)[0] > 4.0:
            add_rock(builder, spot, float(rng.uniform(0.2, 0.45)))


def add_water(builder: SceneBuilder, plan: layout.Plan) -> None:
    """Adds the brook's surface: level strips that step down the valley. It has no contacts: a body
    that falls in rests on the bed."""
    brook = plan.brook
    name = builder.material("water_brook", _ripples(builder.rng), shine=0.35)
    inside = np.flatnonzero((np.abs(brook.line_m) < HALF_M).all(axis=1))
    line = brook.line_m[inside[0] : inside[-1] + 1]
    heights = builder.terrain.at(line)
    # The bed is cut into a grid: its highest node decides, lest it shows above the water.
    heights = np.array([heights[max(i - 1, 0) : i + 2].mean() for i in range(len(line))])
    step = np.gradient(line, axis=0)
    left = np.stack([-step[:, 1], step[:, 0]], -1) / np.linalg.norm(step, axis=1, keepdims=True)
    z = heights + layout.WATER_DEPTH_M
    banks = np.stack([line + _WATER_HALF_M * left, line - _WATER_HALF_M * left], axis=1)
    points = np.concatenate([banks, np.repeat(z[:, None, None], 2, axis=1)], axis=-1)
    low = points - np.array([0.0, 0.0, 0.05])
    count = len(line)
    along = np.repeat(np.arange(count), 2) / 3.0
    across = np.tile([0.0, 2.0 * _WATER_HALF_M / 3.0], count)
    i = 2 * np.arange(count - 1)
    faces = np.concatenate([np.stack([i, i + 1, i + 3], -1), np.stack([i, i + 3, i + 2], -1)])
    under = faces[:, ::-1] + 2 * count
    mesh = builder.mesh("water_brook", MeshData(
        vertices=np.concatenate([points.reshape(-1, 3), low.reshape(-1, 3)]),
        faces=np.concatenate([faces, under]).astype(np.int32),
        uv=np.tile(np.column_stack([across, along]), (2, 1)),
    ))  # fmt: skip
    builder.geom("water_brook", WATER, mesh=mesh, material=name, contype=0)


def _ripples(rng: np.random.Generator) -> NDArray[np.uint8]:
    """(256, 256, 3), periodic: dark water with riffles."""
    tone = 1.0 + 0.16 * tileable_noise(rng, 256, 1.1, 3.0)
    foam = np.clip(tileable_noise(rng, 256, 0.8, 5.0) - 1.9, 0.0, 1.0)
    image = tone[..., None] * np.array([70.0, 82.0, 76.0]) + foam[..., None] * 120.0
    return np.clip(image, 0.0, 255.0).astype(np.uint8)


def add_bridge(builder: SceneBuilder, plan: layout.Plan) -> None:
    """Adds a plank bridge at the crossing of track and brook."""
    distance, _ = plan.brook.nearest(plan.track.line_m)
    index = int(distance.argmin())
    at = plan.track.line_m[index]
    heading = plan.track.heading(index)
    ends = builder.terrain.at(np.array([plan.track.beside(index - 3, 0.0),
                                        plan.track.beside(index + 3, 0.0)]))  # fmt: skip
    z = float(ends.mean()) + 0.06
    origin = np.array([*at, z])
    parts = []
    for x in np.arange(-3.0, 3.01, 0.25):
        parts.append(box((0.115, 1.6, 0.04), (x, 0.0, 0.0)))
    for y in (-1.2, 1.2):
        parts.append(box((3.3, 0.12, 0.12), (0.0, y, -0.16)))
    mesh = builder.mesh("bridge", MeshData.join(parts))
    builder.geom("path_bridge", BRIDGE, mesh=mesh, pos=origin, heading=heading,
                 rgba=[0.60, 0.52, 0.42, 1])  # fmt: skip
    for y in (-1.55, 1.55):
        rail = turned(np.array([[-3.1, y, 0.95], [3.1, y, 0.95]]), heading, origin)
        builder.geom("rail", WOOD, fromto=[*rail[0], *rail[1]], capsule=0.05, rgba=_TIMBER)
        builder.cast(np.concatenate([rail, rail - [0.0, 0.0, 0.06]]) + [0.03, 0.03, 0.0])
        for x in (-3.0, 0.0, 3.0):
            post = turned(np.array([[x, y, -0.2], [x, y, 0.95]]), heading, origin)
            builder.geom("rail_post", WOOD, fromto=[*post[0], *post[1]], capsule=0.055,
                         rgba=_TIMBER)  # fmt: skip
    builder.cast_box((3.1, 1.6), (0.0,), heading, origin)
    for fraction in (-2.5, 0.0, 2.5):
        builder.claim(at + fraction * unit(heading), 2.4)


def add_hide(builder: SceneBuilder, xy_m: Array, toward_xy_m: Array) -> None:
    """Adds a hunter's raised hide that looks towards a clearing: four legs, cabin, roof and
    ladder."""
    heading = float(np.arctan2(*(toward_xy_m - xy_m)[::-1]))
    ground = builder.terrain.point(*xy_m)
    floor = 3.2
    origin = np.array([*xy_m, ground])
    for sx in (-1.0, 1.0):
        for sy in (-1.0, 1.0):
            leg = turned(np.array([[sx * 0.95, sy * 0.95, -0.8], [sx * 0.6, sy * 0.6, floor]]),
                         heading, origin)  # fmt: skip
            builder.geom("hide_leg", WOOD, fromto=[*leg[0], *leg[1]], capsule=0.07, rgba=_TIMBER)
    wall = [0.0, 0.0, floor + 0.85]
    builder.geom("hide_cabin", WOOD, box=[0.72, 0.72, 0.85], heading=heading, pos=origin + wall,
                 rgba=[0.40, 0.31, 0.22, 1])  # fmt: skip
    slot = turned(np.array([[0.70, 0.0, floor + 1.15]]), heading, origin)[0]
    builder.geom("hide_window", WOOD, box=[0.04, 0.55, 0.18], heading=heading, pos=slot,
                 rgba=[0.08, 0.08, 0.07, 1])  # fmt: skip
    roof = np.array([[-1.05, -0.95, 1.78], [1.05, -0.95, 2.02], [1.05, 0.95, 2.02],
                     [-1.05, 0.95, 1.78]])  # fmt: skip
    tilt = float(np.arctan2(0.24, 2.1))
    builder.geom("hide_roof", WOOD, box=[1.08, 0.95, 0.04], pos=origin + [0.0, 0.0, floor + 1.9],
                 rgba=[0.30, 0.34, 0.30, 1], quat=quat_zy(heading, -tilt))  # fmt: skip
    parts = [box((0.035, 0.28, 0.025), (-0.78 - 0.25 * (floor - z), 0.0, z))
             for z in np.arange(0.3, floor, 0.32)]  # fmt: skip
    rungs = builder.mesh(builder.unique("hide_ladder"), MeshData.join(parts))
    builder.geom("hide_ladder", WOOD, mesh=rungs, pos=origin, heading=heading, rgba=_TIMBER)
    for y in (-0.3, 0.3):
        side = turned(np.array([[-0.78 - 0.25 * (floor + 0.3), y, -0.3], [-0.78, y, floor]]),
                      heading, origin)  # fmt: skip
        builder.geom("hide_ladder", WOOD, fromto=[*side[0], *side[1]], capsule=0.04, rgba=_TIMBER)
    builder.cast(turned(roof + [0.0, 0.0, floor], heading, origin))
    builder.cast_box((0.72, 0.72), (floor, floor + 1.7), heading, origin)
    builder.claim(xy_m, 1.8)


def _add_log_pile(builder: SceneBuilder, wood: woods.Wood, plan: layout.Plan) -> None:
    """Adds cut trunks stacked beside the track."""
    rng = builder.rng
    line = plan.track.line_m
    inside = np.flatnonzero((np.abs(line) < HALF_M - 14.0).all(axis=1))
    clear = (plan.clearing_distance(line) > 4.0) & (plan.brook.nearest(line)[0] > 9.0)
    choice = [int(i) for i in inside if clear[i]]
    index = pick(rng, choice)
    spot = plan.track.beside(index, 3.3 * float(rng.choice([-1.0, 1.0])))
    heading = plan.track.heading(index)
    radius, length = 0.23, 4.2
    parts = []
    for row, count in enumerate((5, 4, 3)):
        for number in range(count):
            profile = np.array([[-0.5 * length, radius], [0.5 * length, 0.92 * radius]])
            profile[:, 0] += rng.uniform(-0.15, 0.15)
            log = woods.lathe(rng, profile, 9, 0.05)
            y = (number - 0.5 * (count - 1)) * 2.04 * radius
            z = radius + row * 1.74 * radius
            parts.append(_laid(log, np.array([0.0, y, z])))
    mesh = builder.mesh("log_pile", MeshData.join(parts))
    origin = builder.on_ground(spot, -0.08)
    builder.geom("log_pile", woods.LOG, mesh=mesh, material=wood.bark, pos=origin, heading=heading)
    corners = [[sx * 0.5 * length, sy * (1.1 - 0.5 * h), h] for sx in (-1, 1) for sy in (-1, 1)
               for h in (0.0, 1.2)]  # fmt: skip
    builder.cast(turned(np.array(corners), heading, origin))
    builder.claim(spot, 2.4)


def _laid(log: MeshData, centre: Array) -> MeshData:
    """A lathe's product with its axis along +x."""
    turn = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    normals = None if log.normals is None else log.normals @ turn.T
    return replace(log, vertices=log.vertices @ turn.T + centre, normals=normals)


TREES = 222
UNDERGROWTH = 54
TREE_TOP_M = 17.0
"""No tree reaches higher over the take-off spot."""
_GRID = 128
_OVERLAP = 0.62
"""Neighbouring crowns reach into one another: fraction of their radii that stays apart."""


def plant(builder: SceneBuilder, wood: woods.Wood, plan: layout.Plan) -> None:
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


def open_ground(plan: layout.Plan, xy_m: Array) -> Array:
    """(N, 2) -> (N,) metres to the nearest clearing, track or brook; negative on them."""
    to_track, _ = plan.track.nearest(xy_m)
    to_brook, _ = plan.brook.nearest(xy_m)
    ways = np.minimum(to_track - 2.0, to_brook - 2.0)
    return np.minimum(plan.clearing_distance(xy_m), ways)


def _plant_one(
    builder: SceneBuilder,
    wood: woods.Wood,
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
    trunk_m = pick(rng, woods.TRUNKS_M)
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
            woods.add_conifer(builder, wood, spot, crown, wood.needles[leaf])
        else:
            count = len(wood.leaves)
            leaf = int(np.clip(0.5 * count + 1.2 * species + rng.normal(0.0, 0.5), 0, count - 1))
            woods.add_broadleaf(builder, wood, spot, crown, wood.leaves[leaf], trunk_m)
        return crown.radius_m
    return 0.0


def _undergrow(builder: SceneBuilder, wood: woods.Wood, plan: layout.Plan, standing: Array) -> None:
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
        (woods.add_sapling if rng.random() < 0.45 else woods.add_shrub)(builder, wood, spot)
        placed = np.concatenate([placed, [spot]])


FLOOR = Surface(land_class="trees", reflectivity=0.35)


def generate(seed: int) -> SceneDraft:
    """Returns the scene of ``seed`` without the vehicle. The same seed gives the same bytes."""
    rng = scene_rng("forest", seed)
    plan = layout.draw_plan(rng)
    builder = start_scene("forest", rng, layout.shape_ground(rng, plan))
    wood = woods.grow_wood(builder)
    furnish(builder, wood, plan)
    plant(builder, wood, plan)
    canvas = paint_floor(rng, plan)
    turned = dict.fromkeys(Ground, plan.frame.takeoff_yaw + 0.4)
    ground = paint_terrain(builder, canvas, turned, hilly=True)
    return finish(plan.frame, builder, ground, terrain=FLOOR)


_COARSE = 1280
_GRASS = {"start": Ground.MEADOW, "meadow": Ground.MEADOW, "plot": Ground.MEADOW,
          "slope": Ground.ROUGH, "stumps": Ground.MEADOW, "boulders": Ground.ROUGH}  # fmt: skip


def paint_floor(rng: np.random.Generator, plan: layout.Plan) -> Canvas:
    """Paints litter and ferns, grass in the clearings, the track and its ruts, the brook's muddy
    banks."""
    canvas = Canvas()
    cell = 2.0 * HALF_M / _COARSE
    xy = cell_grid(_COARSE)
    ferns = fractal_noise(rng, (_COARSE, _COARSE), 9.0 / cell, 4, 0.6)
    fray = fractal_noise(rng, (_COARSE, _COARSE), 2.2 / cell, 3, 0.6)
    material = np.full((_COARSE, _COARSE), int(Ground.LITTER), np.uint8)
    material[ferns > 0.45] = int(Ground.FERN)
    to_brook = _distance_to(plan.brook.line_m)
    to_track = _distance_to(plan.track.line_m)
    material[to_brook + 0.6 * fray < 5.0] = int(Ground.FERN)
    material[to_track + 0.45 * fray < 3.0] = int(Ground.ROUGH)
    for clearing in plan.clearings:
        distance = clearing.distance(xy) + 0.7 * fray
        material[distance < 0.9] = int(Ground.WORN)
        material[distance < 0.2] = int(_GRASS[clearing.kind])
    material[to_track + 0.12 * fray < 1.65] = int(Ground.GRAVEL)
    material[to_track + 0.30 * fray < 0.34] = int(Ground.ROUGH)
    material[to_brook + 0.25 * fray < 1.8] = int(Ground.MULCH)
    size = (TEXELS, TEXELS)
    canvas.material[:] = cv2.resize(material, size, interpolation=cv2.INTER_NEAREST)
    for clearing in plan.clearings:
        if clearing.kind == "plot":
            _plough(canvas, plan, clearing)
    _rut(canvas, plan, rng)
    return canvas


def _distance_to(line_m: Array) -> NDArray[np.float32]:
    """(_COARSE, _COARSE) metres to a polyline, row 0 at y_min."""
    mask = np.full((_COARSE, _COARSE), 255, np.uint8)
    cell = 2.0 * HALF_M / _COARSE
    points = np.round(((line_m + HALF_M) / cell - 0.5) * 16).astype(np.int32)
    cv2.polylines(mask, [points], False, 0, 1, cv2.LINE_8, 4)
    distance = cv2.distanceTransform(mask, cv2.DIST_L2, 5)
    return np.asarray(distance * cell, np.float32)


def _plough(canvas: Canvas, plan: layout.Plan, clearing: layout.Clearing) -> None:
    """A game plot: a tilled rectangle in the middle of the clearing."""
    corners = SQUARE * (clearing.radius_m * np.array([0.62, 0.50]))
    turned = rotated(corners, plan.frame.takeoff_yaw + 0.4)
    canvas.fill(clearing.centre_xy_m + turned, Ground.SOIL)


def _rut(canvas: Canvas, plan: layout.Plan, rng: np.random.Generator) -> None:
    """Wheel ruts, a puddle's length dark here and there."""
    line = plan.track.line_m
    step = np.gradient(line, axis=0)
    left = np.stack([-step[:, 1], step[:, 0]], -1) / np.linalg.norm(step, axis=1, keepdims=True)
    for side in (-0.8, 0.8):
        canvas.trace(line + side * left, 0.42, 46)
        for start in rng.integers(0, len(line) - 6, 9):
            part = slice(int(start), int(start) + int(rng.integers(3, 6)))
            canvas.trace(line[part] + side * left[part], 0.36, 120)
