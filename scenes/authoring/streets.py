"""Roads: rectangles and wear in road coordinates; curved streets with kerbs and traffic."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
from scipy.spatial import cKDTree

from touchdown.scenes.api import Array, MovingBody, Surface
from touchdown.scenes.authoring.builder import SceneBuilder, quat_z
from touchdown.scenes.authoring.ground import Canvas, Ground
from touchdown.scenes.authoring.meshes import MeshData, polygon
from touchdown.scenes.authoring.plane import unit, unit_circle
from touchdown.scenes.authoring.relief import smoothstep

KERB = Surface(land_class="path", reflectivity=0.35)
STEP_M = 0.5
KERB_RUN_M = 18.0
ROAD_DEPTH_M, GUTTER_M = 0.12, 0.45
"""How far roadways lie below the ground beside them, and the width in which they fall."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Street:
    """A roadway of constant width along a smooth line with `STEP_M` between points, (N, 2)."""

    line_m: Array
    width_m: float
    pavement_m: float = 0.0

    @property
    def length_m(self) -> float:
        """Length of the centre line."""
        return STEP_M * (len(self.line_m) - 1)

    @property
    def edge_m(self) -> float:
        """From the centre line to the outer edge of the pavement."""
        return 0.5 * self.width_m + self.pavement_m

    def ends_m(self) -> tuple[float, float]:
        return 0.0, self.length_m

    def heading(self, along_m: float) -> float:
        index = int(np.clip(along_m / STEP_M, 1, len(self.line_m) - 2))
        span = self.line_m[index + 1] - self.line_m[index - 1]
        return float(np.arctan2(span[1], span[0]))

    def point(self, along_m: float, across_m: float) -> Array:
        """(2,) world, ``across_m`` to the left; the ends go on straight."""
        inside = float(np.clip(along_m, 0.0, self.length_m))
        position = inside / STEP_M
        index = min(int(position), len(self.line_m) - 2)
        rest = position - index
        base = (1.0 - rest) * self.line_m[index] + rest * self.line_m[index + 1]
        angle = self.heading(inside)
        along = unit(angle)
        left = np.array([-along[1], along[0]])
        return base + (along_m - inside) * along + across_m * left

    def nearest(self, xy_m: Array) -> tuple[Array, Array]:
        """(..., 2) world -> (...) metres to the centre line and (...) metres along it."""
        distance, index = cKDTree(self.line_m).query(np.asarray(xy_m))
        return np.asarray(distance), STEP_M * np.asarray(index, np.float64)

    def kerb_distance(self, xy_m: Array) -> Array:
        """(..., 2) -> (...) metres to the edge of the roadway, negative on it."""
        return self.nearest(xy_m)[0] - 0.5 * self.width_m

    def offset_line(self, across_m: float, first_m: float = 0.0, last_m: float = 1e9) -> Array:
        """(K, 2) line beside the centre line."""
        last = min(last_m, self.length_m)
        stations = np.linspace(first_m, last, max(2, round((last - first_m) / 1.0) + 1))
        return np.array([self.point(float(station), across_m) for station in stations])


def roadway_depth(kerb_m: Array) -> Array:
    """(...) metres of a roadway below the ground, at (...) metres from its edge, negative on it."""
    return ROAD_DEPTH_M * smoothstep(0.0, GUTTER_M, -kerb_m)


class Way(Protocol):
    """A road with its own coordinates: metres along it and metres to its left."""

    @property
    def width_m(self) -> float: ...

    def point(self, along_m: float, across_m: float) -> Array:
        """(2,) world."""
        ...

    def ends_m(self) -> tuple[float, float]:
        """First and last coordinate along it."""
        ...


def band(way: Way, along: tuple[float, float], across: tuple[float, float]) -> Array:
    """(4, 2) world corners of a rectangle in road coordinates."""
    return np.array([way.point(along[0], across[0]), way.point(along[1], across[0]),
                    way.point(along[1], across[1]), way.point(along[0], across[1])])  # fmt: skip


def paint_wear(canvas: Canvas, way: Way, rng: np.random.Generator, junction_m: float) -> None:
    """Repair patches, tar seams, cracks, manholes, gullies and oil stains on the roadway. No
    gullies within ``junction_m`` of the middle."""
    low, high = way.ends_m()
    half = 0.5 * way.width_m
    for _ in range(int(rng.integers(5, 9))):
        along, across = rng.uniform(low, high), rng.uniform(-half + 1.0, half - 1.0)
        size = rng.uniform([0.8, 0.4], [4.0, 1.1])
        lines = (max(across - size[1], -half + 0.1), min(across + size[1], half - 0.1))
        outline = band(way, (along, along + size[0]), lines)
        canvas.fill(outline, Ground.NEW_ASPHALT)
        canvas.trace(np.concatenate([outline, outline[:1]]), 0.05, 190)
    for _ in range(int(rng.integers(22, 32))):
        _crack(canvas, way, rng, rng.uniform(low, high), rng.uniform(-half + 0.4, half - 0.4))
    for _ in range(7):
        along = rng.uniform(low, high)
        centre = way.point(along, rng.choice([-0.25, 0.25]) * way.width_m)
        ring = unit_circle(20)
        canvas.soil(centre + 0.36 * ring, 200)
        canvas.soil(centre + 0.30 * ring, 120)
        for bar in (-0.15, 0.0, 0.15):
            canvas.trace(centre + np.array([[bar, -0.2], [bar, 0.2]]), 0.04, 220)
    for along in np.arange(low + 6.0, high, 17.0):
        for side in (1.0, -1.0):
            if abs(along) > junction_m:
                edge = side * (half - 0.28)
                canvas.soil(band(way, (along, along + 0.5), (edge - 0.2, edge + 0.2)), 215)
    for _ in range(26):
        centre = way.point(rng.uniform(low, high), rng.normal(0.0, 0.3 * half))
        blot = rng.uniform(0.08, 0.35) * rng.uniform(0.7, 1.2, (12, 1)) * unit_circle(12)
        canvas.soil(centre + blot, int(rng.integers(40, 110)))


def _crack(canvas: Canvas, way: Way, rng: np.random.Generator, along: float, across: float) -> None:
    steps = int(rng.integers(10, 36))
    heading = rng.uniform(0.0, 2.0 * np.pi) + np.cumsum(rng.normal(0.0, 0.35, steps))
    path = np.cumsum(0.22 * unit(heading), axis=0)
    limit = 0.5 * way.width_m - 0.1
    lateral = np.clip(across + path[:, 1], -limit, limit)
    line = np.array([way.point(along + a, c) for a, c in zip(path[:, 0], lateral, strict=True)])
    canvas.trace(line, 0.03 if rng.random() < 0.7 else 0.07, int(rng.integers(130, 230)))


def trace_crack(canvas: Canvas, rng: np.random.Generator, start_m: Array) -> None:
    """A crack that wanders from a point (2,) over a car park."""
    steps = rng.normal(0.0, 0.25, (24, 2)) + rng.normal(0.0, 0.15, 2)
    canvas.trace(start_m + np.cumsum(steps, axis=0), 0.03, 170)


def smooth_line(corners_m: Array) -> Array:
    """A line through the ends of ``corners_m`` (K, 2) with its corners cut smooth (Chaikin's
    subdivision), resampled every `STEP_M`."""
    line = np.asarray(corners_m, np.float64)
    for _ in range(5):
        first, second = 0.75 * line[:-1] + 0.25 * line[1:], 0.25 * line[:-1] + 0.75 * line[1:]
        inner = np.stack([first, second], axis=1).reshape(-1, 2)
        line = np.concatenate([line[:1], inner, line[-1:]])
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    stations = STEP_M * np.arange(int(lengths[-1] / STEP_M) + 1)
    return np.stack([np.interp(stations, lengths, line[:, axis]) for axis in (0, 1)], axis=-1)


def paint_street(
    canvas: Canvas, street: Street, roadway: Ground = Ground.ASPHALT, pavement: Ground | None = None
) -> None:
    """Paints one layer of a street. Pavements of crossing streets must not cover roadways: paint
    all pavements (``pavement`` given) first and then all roadways."""
    if pavement is not None:
        canvas.track(street.line_m, 2.0 * street.edge_m, pavement)
    else:
        canvas.track(street.line_m, street.width_m, roadway)


def paint_dashes(canvas: Canvas, street: Street, first_m: float, last_m: float) -> None:
    """A broken centre line."""
    for dash in np.arange(first_m, last_m - 2.0, 6.0):
        left = street.offset_line(0.06, dash, dash + 3.0)
        right = street.offset_line(-0.06, dash, dash + 3.0)
        canvas.mark(np.concatenate([left, right[::-1]]))


def place_street_kerb(
    builder: SceneBuilder,
    street: Street,
    side: float,
    openings_m: list[tuple[float, float]],
    top: float,
) -> None:
    """Kerb stones along one side (+1: left), 0.16 m wide, ``top`` metres over the
    ground beside them; without the stretches ``openings_m`` (first, last)."""
    across = side * (0.5 * street.width_m + 0.08)
    cuts = sorted(openings_m)
    stretches, start = [], 0.0
    for first, last in cuts:
        if first > start:
            stretches.append((start, min(first, street.length_m)))
        start = max(start, last)
    if start < street.length_m:
        stretches.append((start, street.length_m))
    for first, last in stretches:
        # Contacts are with a mesh's convex hull: only a short run is nearly its own hull.
        pieces = max(1, int(np.ceil((last - first) / KERB_RUN_M)))
        for start, end in pairwise(np.linspace(first, last, pieces + 1)):
            if last - first > 0.4:
                parts = _kerb_run(builder, street, across, (float(start), float(end)), top)
                mesh = builder.mesh(builder.unique("street_kerb"), MeshData.join(parts))
                builder.geom("path_kerb", KERB, mesh=mesh, rgba=[0.68, 0.67, 0.64, 1])


def _kerb_run(
    builder: SceneBuilder, street: Street, across: float, span: tuple[float, float], top: float
) -> list[MeshData]:
    stations = np.linspace(*span, max(2, round((span[1] - span[0]) / 1.5) + 1))
    inner = np.array([street.point(float(s), across - 0.08) for s in stations])
    outer = np.array([street.point(float(s), across + 0.08) for s in stations])
    beside = np.sign(across) * 0.6 + across
    ground = builder.terrain.at(np.array([street.point(float(s), beside) for s in stations]))
    high, low = ground + top, ground - 0.3
    parts = []
    for i, j in pairwise(range(len(stations))):
        a, b = np.append(inner[i], high[i]), np.append(inner[j], high[j])
        c, d = np.append(outer[j], high[j]), np.append(outer[i], high[i])
        parts.append(polygon(np.array([a, b, c, d])))
        for first, second, z0, z1 in ((b, a, low[j], low[i]), (d, c, low[i], low[j])):
            foot = np.array([[*second[:2], z1], [*first[:2], z0]])
            parts.append(polygon(np.array([first, second, *foot])))
    return parts


def lane_loop(builder: SceneBuilder, street: Street, first_m: float, last_m: float) -> Array:
    """(K, 3) closed path on both lanes, right-hand traffic, turning at ``first_m`` and
    ``last_m`` along the street."""
    lane = 0.25 * street.width_m
    stations = np.linspace(first_m, last_m, max(2, round((last_m - first_m) / 2.0)))
    turn = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 7)[1:-1]
    spots = [(s, -lane) for s in stations]
    spots += [(last_m + lane * np.cos(a), lane * np.sin(a)) for a in turn]
    spots += [(s, lane) for s in stations[::-1]]
    spots += [(first_m - lane * np.cos(a), -lane * np.sin(a)) for a in turn]
    xy = np.array([street.point(float(along), float(across)) for along, across in spots])
    return np.column_stack([xy, builder.terrain.at(xy)])


def along_path(path: Array, distance_m: float) -> tuple[Array, float]:
    """Point (3,) and heading (radians) on a closed polyline."""
    steps = np.roll(path, -1, axis=0) - path
    lengths = np.linalg.norm(steps, axis=1)
    rest = distance_m % float(lengths.sum())
    index = int(np.searchsorted(np.cumsum(lengths), rest, side="right"))
    into = rest - float(lengths[:index].sum())
    unit = steps[index] / lengths[index]
    return path[index] + into * unit, float(np.arctan2(unit[1], unit[0]))


def path_length(path: Array) -> float:
    """Metres once round a closed polyline, (K, 3)."""
    return float(np.linalg.norm(np.roll(path, -1, axis=0) - path, axis=1).sum())


def add_car(
    builder: SceneBuilder,
    path: Array,
    look: tuple[str, str],
    surface: Surface,
    speed_mps: float,
    start_m: float,
) -> MovingBody:
    """Adds ``moving_car_0``, ... as a mocap body at its start on a closed path. look: names of mesh
    and material."""
    car = MovingBody(body_name=builder.unique("moving_car"), path_world=path, speed_mps=speed_mps,
                     start_m=start_m)  # fmt: skip
    where, heading = along_path(path, start_m)
    body = builder.spec.worldbody.add_body(
        name=car.body_name, mocap=True, pos=where, quat=quat_z(heading)
    )
    builder.geom("car_moving", surface, body=body, mesh=look[0], material=look[1])
    return car


def send_round(
    builder: SceneBuilder,
    path: Array,
    looks: list[tuple[str, str]],
    surface: Surface,
    speed_mps: float,
) -> tuple[MovingBody, ...]:
    """Adds cars spread over one closed path, all at one speed, so that none meets the one ahead."""
    length, count = path_length(path), len(looks)
    return tuple(
        add_car(builder, path, look, surface, speed_mps,
                (index + float(builder.rng.uniform(0.0, 0.6))) / count * length)
        for index, look in enumerate(looks)
    )  # fmt: skip
