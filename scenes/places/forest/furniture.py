"""Objects of the wood other than trees: rocks, logs, stumps, a hide, a bridge, water."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import Array, Surface
from touchdown.scenes.authoring.builder import SceneBuilder, turned
from touchdown.scenes.authoring.meshes import MeshData, box
from touchdown.scenes.authoring.noise import tileable_noise
from touchdown.scenes.authoring.plane import pick, unit
from touchdown.scenes.authoring.plots import claim_free
from touchdown.scenes.places.forest.layout import HALF_M, WATER_DEPTH_M, Clearing, Plan
from touchdown.scenes.props.plants import add_rock
from touchdown.scenes.props.street import WOOD
from touchdown.scenes.props.tree_shapes import joined, lathe
from touchdown.scenes.props.woods import LOG, Wood, add_log, add_stump

WATER = Surface(land_class="water", reflectivity=0.05, water=True)
BRIDGE = Surface(land_class="path", reflectivity=0.35)
_TIMBER = [0.46, 0.37, 0.27, 1.0]
_WATER_HALF_M = 0.95


def furnish(builder: SceneBuilder, wood: Wood, plan: Plan) -> None:
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
    builder: SceneBuilder, clearing: Clearing, count: int, margin_m: float, gap_m: float
) -> list[Array]:
    """Up to ``count`` free spots in a clearing, ``margin_m`` from its edge."""
    reach = clearing.radius_m * 1.2
    spots = clearing.centre_xy_m + builder.rng.uniform(-reach, reach, (30 * count, 2))
    inside = spots[clearing.distance(spots) < -margin_m]
    return claim_free(builder, inside, count, gap_m, 0.5 * gap_m)


def _fell(builder: SceneBuilder, wood: Wood, clearing: Clearing) -> None:
    """A felled patch: low stumps in high grass, and a few trunks left behind."""
    rng = builder.rng
    for spot in _scatter(builder, clearing, 3, 2.0, 2.0):
        angle, half = rng.uniform(0.0, np.pi), 0.5 * rng.uniform(3.0, 5.5)
        axis = half * unit(angle)
        add_log(builder, wood, spot - axis, spot + axis, float(rng.uniform(0.12, 0.22)))
    for spot in _scatter(builder, clearing, 22, 0.3, 1.1):
        add_stump(builder, wood, spot)


def _edge_spot(builder: SceneBuilder, plan: Plan, clearing: Clearing) -> Array:
    """(2,) a free spot at the edge of a clearing, away from track and brook."""
    turn = builder.rng.uniform(0.0, 2.0 * np.pi) + np.linspace(0.0, 2.0 * np.pi, 24)
    ring = unit(turn)
    spots = clearing.centre_xy_m + (clearing.radius_m + 1.2) * ring
    room = np.minimum(plan.track.nearest(spots)[0] - 4.0, plan.brook.nearest(spots)[0] - 4.5)
    free = np.flatnonzero(room > 0.0)
    return np.asarray(spots[int(free[0]) if len(free) else int(room.argmax())])


def _strew(builder: SceneBuilder, wood: Wood, plan: Plan) -> None:
    """Fallen trunks and rocks on the forest floor, rocks in and beside the brook."""
    rng = builder.rng
    spots = rng.uniform(-HALF_M + 6.0, HALF_M - 6.0, (400, 2))
    far = np.minimum(plan.track.nearest(spots)[0], plan.brook.nearest(spots)[0])
    free = spots[(plan.clearing_distance(spots) > 3.0) & (far > 6.0)]
    for spot in free[:9]:
        angle, half = rng.uniform(0.0, np.pi), 0.5 * rng.uniform(5.0, 9.0)
        axis = half * unit(angle)
        if builder.is_free(spot, 2.0):
            add_log(builder, wood, spot - axis, spot + axis, float(rng.uniform(0.16, 0.30)))
    for spot in free[9:26]:
        if builder.is_free(spot, 0.8):
            add_rock(builder, spot, float(rng.uniform(0.4, 1.1)))
    inside = np.flatnonzero((np.abs(plan.brook.line_m) < HALF_M - 2.0).all(axis=1))
    for index in rng.choice(inside, 14, replace=False):
        spot = plan.brook.beside(int(index), float(rng.normal(0.0, 1.0)))
        if plan.track.nearest(spot)[0] > 4.0:
            add_rock(builder, spot, float(rng.uniform(0.2, 0.45)))


def add_water(builder: SceneBuilder, plan: Plan) -> None:
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
    z = heights + WATER_DEPTH_M
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


def add_bridge(builder: SceneBuilder, plan: Plan) -> None:
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
    for share in (-2.5, 0.0, 2.5):
        builder.claim(at + share * unit(heading), 2.4)


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
                 rgba=[0.30, 0.34, 0.30, 1], quat=_yaw_pitch(heading, -tilt))  # fmt: skip
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


def _yaw_pitch(yaw: float, pitch: float) -> list[float]:
    """Quaternion wxyz of a turn about +y by ``pitch``, then about +z by ``yaw``."""
    cy, sy, cp, sp = np.cos(yaw / 2), np.sin(yaw / 2), np.cos(pitch / 2), np.sin(pitch / 2)
    return [float(cy * cp), float(-sy * sp), float(cy * sp), float(sy * cp)]


def _add_log_pile(builder: SceneBuilder, wood: Wood, plan: Plan) -> None:
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
            log = lathe(rng, profile, 9, 0.05)
            y = (number - 0.5 * (count - 1)) * 2.04 * radius
            z = radius + row * 1.74 * radius
            parts.append(_laid(log, np.array([0.0, y, z])))
    mesh = builder.mesh("log_pile", joined(parts))
    origin = builder.on_ground(spot, -0.08)
    builder.geom("log_pile", LOG, mesh=mesh, material=wood.bark, pos=origin, heading=heading)
    corners = [[sx * 0.5 * length, sy * (1.1 - 0.5 * h), h] for sx in (-1, 1) for sy in (-1, 1)
               for h in (0.0, 1.2)]  # fmt: skip
    builder.cast(turned(np.array(corners), heading, origin))
    builder.claim(spot, 2.4)


def _laid(log: MeshData, centre: Array) -> MeshData:
    """A lathe's product with its axis along +x."""
    turn = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    normals = None if log.normals is None else log.normals @ turn.T
    return MeshData(
        vertices=log.vertices @ turn.T + centre, faces=log.faces, uv=log.uv, normals=normals
    )
