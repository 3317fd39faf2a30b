"""Plan of the stream or road and of the bridge over it, the ground that both are cut into, and the
bridge itself."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from touchdown.scenes.api import Array, Image, Surface
from touchdown.scenes.authoring.builder import SceneBuilder, turned
from touchdown.scenes.authoring.meshes import MeshData, box, polygon
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.authoring.plane import pick
from touchdown.scenes.authoring.plots import Plot, SurveyFrame
from touchdown.scenes.authoring.relief import HALF_M, NODES, natural_ground, smoothstep
from touchdown.scenes.authoring.streets import Street, roadway_depth, smooth_line
from touchdown.scenes.authoring.textures import to_texture
from touchdown.scenes.props.waterside import planks

ROAD_M, VERGE_M = 7.0, 1.7
LANDING_M = 1.6
"""Level ground between the top of the bank and the end of the deck's approach."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Bridge:
    """A deck that rises from both ends to its middle, with a ramp down from each end. Plot: ``u``
    along the deck from its middle, ``v`` to the left."""

    plot: Plot
    half_length_m: float
    width_m: float
    end_m: float
    """height of the deck's ends over the banks, which are about at height 0"""
    rise_m: float
    """of the middle over the ends"""
    ramp_m: float
    thick_m: float = 0.40

    def top(self, u: Array) -> Array:
        """World height of deck and ramps at ``u``; below the ground beyond the ramps."""
        u = np.abs(np.asarray(u, np.float64))
        deck = self.end_m + self.rise_m * (1.0 - (u / self.half_length_m) ** 2)
        ramp = self.end_m * (1.0 - (u - self.half_length_m) / self.ramp_m)
        return np.where(u <= self.half_length_m, deck, ramp)

    @property
    def reach_m(self) -> float:
        """From the middle to the foot of a ramp."""
        return self.half_length_m + self.ramp_m


@dataclass(frozen=True, kw_only=True, slots=True)
class Plan(SurveyFrame):
    """A course that winds from south to north and the bridge over it."""

    over_road: bool
    course: Street
    """the roadway, or the stream's bed"""
    floor_m: float
    """from the course's middle line to the foot of the bank"""
    bank_m: float
    """horizontal width of a bank"""
    depth_m: float
    """of the floor below the banks' top"""
    water_m: float
    """of the water over the stream's bed, 0: none"""
    bridge: Bridge

    @property
    def level_m(self) -> float:
        """World height of the water."""
        return self.water_m - self.depth_m

    def bank_distance(self, xy_m: Array) -> Array:
        """(..., 2) -> (...) metres to the top of the nearer bank, negative below it."""
        return self.course.nearest(xy_m)[0] - self.floor_m - self.bank_m


def draw_plan(rng: np.random.Generator) -> Plan:
    """Returns a stream or a road, east of a lawn for the take-off."""
    over_road = bool(rng.random() < 0.5)
    y = np.linspace(-HALF_M, HALF_M, 9)
    swing = rng.uniform(1.5, 3.0) if over_road else rng.uniform(3.0, 5.5)
    wave = swing * np.sin(2.0 * np.pi * y / rng.uniform(75.0, 110.0) + rng.uniform(0.0, 6.28))
    lean = rng.uniform(-0.10, 0.10)
    x = rng.uniform(-1.0, 5.0) + lean * y + wave - np.interp(0.0, y, wave)
    width = ROAD_M if over_road else rng.uniform(5.0, 7.0)
    course = Street(line_m=smooth_line(np.column_stack([x, y])), width_m=width, pavement_m=VERGE_M)
    floor = 0.5 * width + (VERGE_M if over_road else 0.0)
    bank = rng.uniform(6.0, 7.5) if over_road else rng.uniform(5.0, 7.0)
    middle = float(course.nearest(np.array([0.0, rng.uniform(-4.0, 6.0)]))[1])
    angle = course.heading(middle) - 0.5 * np.pi + rng.uniform(-0.06, 0.06)
    end = rng.uniform(1.3, 1.6) if over_road else rng.uniform(0.35, 0.6)
    half_length = floor + bank + LANDING_M
    bridge = Bridge(
        plot=Plot(origin_xy_m=course.point(middle, 0.0), angle=angle),
        half_length_m=half_length,
        width_m=rng.uniform(4.6, 5.6),
        end_m=end,
        # No steeper than 3.2 degrees at the ends.
        rise_m=float(rng.uniform(0.35, 0.5) * half_length * np.tan(np.deg2rad(3.2))),
        ramp_m=end * (11.0 if over_road else 14.0),
    )
    return Plan(over_road=over_road, course=course, floor_m=floor, bank_m=bank,
                depth_m=rng.uniform(3.5, 3.9) if over_road else rng.uniform(2.2, 3.0),
                water_m=0.0 if over_road else rng.uniform(0.55, 0.9), bridge=bridge,
                takeoff_xy_m=np.array([-40.0, -22.0]) + rng.uniform(-2.0, 2.0, 2),
                takeoff_yaw=float(rng.uniform(-0.10, 0.10)))  # fmt: skip


def shape_ground(rng: np.random.Generator, plan: Plan) -> Array:
    """Returns (N, N) heights without the water. The banks' tops are rugged lawns about height 0;
    level at 0 around the take-off spot and along the way over the bridge."""
    heights, xy = natural_ground(rng)
    cell = 2.0 * HALF_M / (NODES - 1)
    heights = heights - heights.mean() + 0.15
    spot = np.linalg.norm(xy - plan.takeoff_xy_m, axis=-1)
    heights = heights * smoothstep(2.5, 7.0, spot)
    u, v = np.moveaxis(plan.bridge.plot.coordinates(xy), -1, 0)
    beyond = np.maximum(np.abs(u) - plan.bridge.reach_m - 3.0, 0.0)
    beside = np.maximum(np.abs(v) - 0.5 * plan.bridge.width_m - 1.0, 0.0)
    heights = heights * smoothstep(0.0, 5.0, np.hypot(beyond, beside))
    distance, _ = plan.course.nearest(xy)
    foot = distance - plan.floor_m
    if not plan.over_road:
        # A stream's banks are nowhere alike.
        ragged = fractal_noise(rng, heights.shape, 7.0 / cell, 3, 0.6)
        foot = foot + 0.7 * ragged * smoothstep(3.0, 9.0, np.abs(u) + np.abs(v))
    fraction = np.clip(foot / plan.bank_m, 0.0, 1.0)
    bank = 0.25 * smoothstep(0.0, 1.0, fraction) + 0.75 * fraction
    heights = heights * smoothstep(-3.0, 4.0, foot - plan.bank_m) - plan.depth_m * (1.0 - bank)
    if plan.over_road:
        return heights - roadway_depth(distance - 0.5 * ROAD_M)
    bed = 0.08 * fractal_noise(rng, heights.shape, 4.0 / cell, 3, 0.6)
    return heights + bed * (1.0 - fraction)


ASPHALT_DECK = Surface(land_class="road", reflectivity=0.24)
TIMBER_DECK = Surface(land_class="path", reflectivity=0.24)
STEEL = Surface(land_class="other", reflectivity=0.40)
CONCRETE = Surface(land_class="building", reflectivity=0.36)
STAIRS = Surface(land_class="path", reflectivity=0.33)
RAIL_M, POST_STEP_M = 1.15, 2.0
STEP_RISE_M = 0.17
PX_PER_M = 40.0
_CONCRETE_RGBA = [0.66, 0.65, 0.62, 1.0]
_RAILS = ([0.24, 0.34, 0.30, 1.0], [0.34, 0.36, 0.38, 1.0], [0.55, 0.22, 0.16, 1.0])


def add_bridge(builder: SceneBuilder, plan: Plan) -> None:
    """Adds all parts of the bridge, with their shadows."""
    bridge = plan.bridge
    rng = builder.rng
    image = asphalt_deck(rng, bridge) if plan.over_road else timber_deck(rng, bridge)
    deck = ASPHALT_DECK if plan.over_road else TIMBER_DECK
    material = builder.material(f"{deck.land_class}_deck", image)
    pose = {"pos": [*bridge.plot.origin_xy_m, 0.0], "heading": bridge.plot.angle}
    for name, first, last in (
        (f"{deck.land_class}_deck", -bridge.half_length_m, bridge.half_length_m),
        (f"{deck.land_class}_ramp", bridge.half_length_m, bridge.reach_m),
        (f"{deck.land_class}_ramp", -bridge.reach_m, -bridge.half_length_m),
    ):
        mesh = builder.mesh(builder.unique(name), slab_mesh(bridge, first, last))
        builder.geom(name, deck, mesh=mesh, material=material, **pose)
    _cast_slab(builder, bridge)
    rgba = pick(rng, _RAILS)
    for side in (1.0, -1.0):
        for first, last in (
            (-bridge.reach_m + 0.1, -bridge.half_length_m),
            (-bridge.half_length_m, bridge.half_length_m),
            (bridge.half_length_m, bridge.reach_m - 0.1),
        ):
            _add_railing(builder, bridge, side, first, last, rgba)
    _add_supports(builder, plan)
    side, end = float(rng.choice([-1.0, 1.0])), float(rng.choice([-1.0, 1.0]))
    _add_stairs(builder, plan, side, end, rgba)
    for u in np.arange(-bridge.reach_m, bridge.reach_m + 1.0, 2.0):
        builder.claim(bridge.plot.at(float(u), 0.0), 0.5 * bridge.width_m + 1.0)


def slab_mesh(bridge: Bridge, first: float, last: float) -> MeshData:
    """Returns a deck or ramp between two ``u``: a convex body (contacts use a mesh's hull), its top
    mapped along and across the whole texture, the rest on the texture's dark rim."""
    stations = np.linspace(first, last, 17 if first * last < 0.0 else 2)
    top = bridge.top(stations)
    half, length = 0.5 * bridge.width_m, 2.0 * bridge.reach_m
    inner = bridge.end_m - bridge.thick_m
    outer = -0.6
    low = np.where(np.abs(stations) <= bridge.half_length_m + 1e-6, inner, outer)
    along = (stations + bridge.reach_m) / length
    parts = []
    rim = 0.004
    for i, j in pairwise(range(len(stations))):
        a, b = stations[i], stations[j]
        parts.append(polygon(
            np.array([
                [a, -half, top[i]], [b, -half, top[j]], [b, half, top[j]], [a, half, top[i]],
            ]),
            np.array([[along[i], 0.98], [along[j], 0.98], [along[j], 0.02], [along[i], 0.02]]),
        ))  # fmt: skip
        for y in (-half, half):
            wall = np.array([[a, y, low[i]], [b, y, low[j]], [b, y, top[j]], [a, y, top[i]]])
            parts.append(polygon(wall if y < 0 else wall[::-1], rim))
        under = np.array(
            [[a, half, low[i]], [b, half, low[j]], [b, -half, low[j]], [a, -half, low[i]]]
        )
        parts.append(polygon(under, rim))
    for k, sign in ((0, -1.0), (-1, 1.0)):
        x = stations[k]
        face = np.array(
            [[x, -half, low[k]], [x, half, low[k]], [x, half, top[k]], [x, -half, top[k]]]
        )
        parts.append(polygon(face if sign > 0 else face[::-1], rim))
    return MeshData.join(parts)


def timber_deck(rng: np.random.Generator, bridge: Bridge) -> Image:
    """Boards across the way, dark at the rim."""
    base = (150.0, 128.0, 104.0) if rng.random() < 0.5 else (134.0, 128.0, 118.0)
    image = planks(rng, (2.0 * bridge.reach_m, bridge.width_m), PX_PER_M, base)
    return _rimmed(image)


def asphalt_deck(rng: np.random.Generator, bridge: Bridge) -> Image:
    """A red or grey coating with a broken middle line, joints where deck and ramps meet, stains."""
    size = (round(bridge.width_m * PX_PER_M), round(2.0 * bridge.reach_m * PX_PER_M))
    base = (146.0, 96.0, 82.0) if rng.random() < 0.4 else (128.0, 127.0, 124.0)
    tone = 1.0 + 0.05 * fractal_noise(rng, size, 1.2 * PX_PER_M, 4, 0.7)
    tone += 0.09 * fractal_noise(rng, size, 2.5, 2, 0.8)
    tone -= 0.25 * np.clip(fractal_noise(rng, size, 0.5 * PX_PER_M, 3, 0.6) - 1.3, 0.0, 1.0)
    image = tone[..., None] * np.array(base, np.float32)
    middle = size[0] // 2
    for start in range(0, size[1] - 60, 120):
        image[middle - 2 : middle + 3, start : start + 60] = (
            214.0 * tone[middle - 2 : middle + 3, start : start + 60, None]
        )
    for u in (-bridge.half_length_m, bridge.half_length_m):
        col = round((u + bridge.reach_m) * PX_PER_M)
        image[:, max(col - 3, 0) : col + 3] = 58.0
    return _rimmed(to_texture(image))


def _rimmed(image: Image) -> Image:
    """The colour of the deck's sides at the texture's edge."""
    edge = max(3, round(0.016 * image.shape[0]))
    image[:edge], image[-edge:] = (96, 94, 90), (96, 94, 90)
    image[:, :2] = (96, 94, 90)
    return image


def _cast_slab(builder: SceneBuilder, bridge: Bridge) -> None:
    """The deck's shadow, in pieces, since it falls on banks and floor."""
    half = 0.5 * bridge.width_m
    for a, b in pairwise(np.linspace(-bridge.reach_m, bridge.reach_m, 15)):
        z = float(bridge.top(np.array(0.5 * (a + b))))
        corners = np.array([[u, v, h] for u in (a, b) for v in (-half, half) for h in (z, z - 0.3)])
        builder.cast(_world(bridge, corners))


def _world(bridge: Bridge, local: Array) -> Array:
    return turned(local, bridge.plot.angle, np.array([*bridge.plot.origin_xy_m, 0.0]))


def _add_railing(
    builder: SceneBuilder, bridge: Bridge, side: float, first: float, last: float, rgba: list[float]
) -> None:
    """Adds posts, a hand rail and four wires along the deck's edge, as one mesh."""
    v = side * (0.5 * bridge.width_m - 0.07)
    count = max(1, round((last - first) / POST_STEP_M))
    knots = np.linspace(first, last, count + 1)
    parts = []
    for u in knots:
        z = float(bridge.top(u))
        parts.append(box((0.035, 0.035, 0.5 * RAIL_M), (u, v, z + 0.5 * RAIL_M)))
    fine = np.linspace(first, last, 2 * count + 1)
    for a, b in pairwise(fine):
        middle = 0.5 * (a + b)
        z = float(bridge.top(middle))
        for height, thick in ((0.18, 0.015), (0.42, 0.015), (0.66, 0.015), (0.90, 0.015),
                              (RAIL_M, 0.04)):  # fmt: skip
            half = np.array([0.5 * (b - a) + 0.01, thick, thick])
            parts.append(box(half, np.array([middle, v, z + height])))
    mesh = builder.mesh(builder.unique("railing"), MeshData.join(parts))
    builder.geom("railing", STEEL, mesh=mesh, rgba=rgba, pos=[*bridge.plot.origin_xy_m, 0.0],
                 heading=bridge.plot.angle)  # fmt: skip
    for a, b in pairwise(knots):
        ends = [[u, v, float(bridge.top(u)) + RAIL_M + dz] for u in (a, b) for dz in (-0.04, 0.04)]
        builder.cast(_world(bridge, np.array([*ends, [a, v + 0.05, ends[0][2]]])), 0.8)


def _add_supports(builder: SceneBuilder, plan: Plan) -> None:
    """Adds abutments at the tops of the banks, girders, and columns at their feet."""
    bridge = plan.bridge
    heading, half = bridge.plot.angle, 0.5 * bridge.width_m
    low = bridge.end_m - bridge.thick_m
    for sign in (1.0, -1.0):
        spot = bridge.plot.at(sign * (bridge.half_length_m - 0.5), 0.0)
        builder.geom(
            "building_abutment", CONCRETE, pos=[*spot, 0.5 * (low - 1.6)], heading=heading,
            box=[0.6, half, 0.5 * (low + 1.6)], rgba=_CONCRETE_RGBA,
        )  # fmt: skip
        girder = bridge.plot.at(0.0, sign * 0.55 * half)
        builder.geom("girder", STEEL, rgba=[0.30, 0.32, 0.33, 1], pos=[*girder, low - 0.18],
                     box=[bridge.half_length_m - 0.2, 0.12, 0.18], heading=heading)  # fmt: skip
        for side in (1.0, -1.0):
            foot = bridge.plot.at(sign * (plan.floor_m + 0.9), side * 0.55 * half)
            z = builder.terrain.point(*foot)
            builder.geom("building_pier", CONCRETE, rgba=_CONCRETE_RGBA,
                         fromto=[*foot, z - 0.5, *foot, low - 0.3], cylinder=0.28)  # fmt: skip


def _add_stairs(
    builder: SceneBuilder, plan: Plan, side: float, end: float, rgba: list[float]
) -> None:
    """Adds stairs beside the bridge, from the bank's top down to its foot, with a hand rail."""
    bridge = plan.bridge
    top_u = plan.floor_m + plan.bank_m + 0.5
    low_u = plan.floor_m + (0.2 if plan.over_road else 0.9)
    v = side * (0.5 * bridge.width_m + 1.3)
    ends = [bridge.plot.at(end * u, v) for u in (top_u, low_u)]
    high, low = (builder.terrain.point(*spot) for spot in ends)
    count = max(4, round((high - low) / STEP_RISE_M))
    tread = (top_u - low_u) / count
    middles = top_u - (np.arange(count) + 0.5) * tread
    steps = np.linspace(high, low, count, endpoint=False)
    across = bridge.plot.points(np.stack([end * middles, np.full(count, v)], axis=-1))
    # The flight lies on the bank, which bulges.
    steps += max(0.0, float((builder.terrain.at(across) - steps).max())) + 0.03
    parts = [
        box((0.5 * tread, 0.8, 0.5), (end * u, v, z - 0.5))
        for u, z in zip(middles, steps, strict=True)
    ]
    mesh = builder.mesh("stairs", MeshData.join(parts))
    pose = {"pos": [*bridge.plot.origin_xy_m, 0.0], "heading": bridge.plot.angle}
    builder.geom("path_stairs", STAIRS, mesh=mesh, **pose, rgba=[0.60, 0.59, 0.56, 1])
    aside = bridge.plot.points(np.array([[end * u, v + side * 0.85] for u in (top_u, low_u)]))
    builder.geom("railing", STEEL, rgba=rgba, capsule=0.03,
                 fromto=[*aside[0], high + 1.0, *aside[1], low + 1.0])  # fmt: skip
    for spot, z in zip(aside, (high, low), strict=True):
        builder.geom("railing", STEEL, rgba=rgba, cylinder=0.03,
                     fromto=[*spot, z - 0.2, *spot, z + 1.0])  # fmt: skip
    for fraction in (0.1, 0.5, 0.9):
        builder.claim(fraction * ends[0] + (1.0 - fraction) * ends[1], 1.4)
