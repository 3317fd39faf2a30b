"""Plan and relief of the snow field: swells, drifts, sastrugi and the pond."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import Array
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.authoring.plane import unit, wavy
from touchdown.scenes.authoring.plots import SurveyFrame, draw_frame
from touchdown.scenes.authoring.relief import HALF_M, HeightField, level_takeoff, smoothstep

_GRID = 512
NODES = 321
SASTRUGI_M = (0.10, 0.16)
"""Relief of the sastrugi, twice its standard deviation, where the wind has cut deepest; of
decimetres in nature."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Plan(SurveyFrame):
    """Spots in world metres."""

    wind_angle: float
    """radians, the way the wind blew"""
    pond_xy_m: Array
    pond_radius_m: float
    pond_waves: Array
    """(K, 2) amplitude (fraction of the radius) and phase of the k+2-th harmonic"""
    hut_xy_m: Array
    hut_angle: float
    hill_xy_m: Array
    hill_height_m: float
    fences_m: tuple[Array, ...]
    """(2, 2) ends of each"""
    rocks: tuple[tuple[Array, float], ...]
    """middle and radius"""

    @property
    def wind(self) -> Array:
        """(2,) unit"""
        return unit(self.wind_angle)


@dataclass(frozen=True, kw_only=True, slots=True)
class Relief:
    """The snow's surface."""

    terrain: HeightField
    pond_m: Array
    """(N, N) metres from the pond's edge at the nodes, negative on the ice"""
    ice_m: float
    """world height of the ice"""
    sastrugi: Array
    """(N, N) 0..1: how deep the wind has cut at the nodes"""


def draw_plan(rng: np.random.Generator) -> Plan:
    """Returns a plan with the pond in the survey, on the side away from the take-off."""
    frame = draw_frame(rng)
    middle = frame.from_middle
    wind = float(rng.uniform(-np.pi, np.pi))
    side = float(rng.choice([-1.0, 1.0]))
    pond = np.array([rng.uniform(4.0, 12.0), side * rng.uniform(5.0, 10.0)])
    hill = np.array([rng.uniform(6.0, 20.0), -side * rng.uniform(14.0, 20.0)])
    hut = np.array([rng.uniform(-16.0, -8.0), rng.uniform(17.0, 22.0)])
    rocks = []
    for _ in range(int(rng.integers(13, 19))):
        spot = rng.uniform([-38.0, -34.0], [38.0, 34.0])
        if np.hypot(*(spot - pond)) > 13.0 and np.hypot(*(spot - [-25.0, -20.0])) > 7.0:
            rocks.append((middle.points(spot), float(rng.uniform(0.25, 0.75))))
    fences = []
    for reach in (rng.uniform(-36.0, -31.0), rng.uniform(29.0, 34.0)):
        turn = rng.uniform(-0.12, 0.12)
        ends = np.array([[reach - 40.0 * turn, -30.0], [reach + 40.0 * turn, 34.0]])
        gap = rng.uniform(0.3, 0.6)
        way = ends[1] - ends[0]
        fences.append(middle.points(np.array([ends[0], ends[0] + (gap - 0.05) * way])))
        fences.append(middle.points(np.array([ends[0] + (gap + 0.05) * way, ends[1]])))
    amplitude = rng.uniform(0.4, 1.0, 5) * np.array([0.17, 0.09, 0.06, 0.035, 0.02])
    return Plan(
        takeoff_xy_m=frame.takeoff_xy_m,
        takeoff_yaw=frame.takeoff_yaw,
        wind_angle=wind,
        pond_xy_m=middle.points(pond),
        pond_radius_m=float(rng.uniform(7.5, 9.5)),
        pond_waves=np.column_stack([amplitude, rng.uniform(0.0, 2.0 * np.pi, 5)]),
        hut_xy_m=middle.points(hut),
        hut_angle=frame.takeoff_yaw + float(rng.uniform(-0.4, 0.4)),
        hill_xy_m=middle.points(hill),
        hill_height_m=float(rng.uniform(1.7, 2.6)),
        fences_m=tuple(fences),
        rocks=tuple(rocks),
    )


def pond_distance(rng: np.random.Generator, plan: Plan, xy: Array) -> Array:
    """(N, N) metres from the pond's edge at grid nodes, to first order; negative inside."""
    rel = xy - plan.pond_xy_m
    bearing = np.arctan2(rel[..., 1], rel[..., 0])
    outline = plan.pond_radius_m * wavy(bearing, *plan.pond_waves.T)
    cell = float(xy[0, 1, 0] - xy[0, 0, 0])
    ragged = 0.35 * fractal_noise(rng, xy.shape[:2], 5.0 / cell, 2).astype(np.float64)
    return np.hypot(rel[..., 0], rel[..., 1]) - outline + ragged


def along_wind(plan: Plan, xy: Array, centre_xy_m: Array) -> tuple[Array, Array]:
    """Metres downwind of a point and across the wind, each (...) for (..., 2)."""
    rel = xy - centre_xy_m
    east, north = plan.wind
    return rel @ np.array([east, north]), rel @ np.array([-north, east])


def sastrugi(rng: np.random.Generator, plan: Plan, xy: Array, wave_m: float) -> Array:
    """(...) heights of unit variance at (..., 2): ridges along the wind, broken across, that rise
    steeply against it and trail off behind."""
    downwind, across = along_wind(plan, xy, np.zeros(2))
    field = np.zeros(xy.shape[:-1])
    for fraction, stretch in ((1.0, 1.0), (0.55, 0.55)):
        sway = 1.2 * np.sin(downwind / (3.1 * wave_m * stretch) + rng.uniform(0.0, 6.3))
        noise = fractal_noise(rng, (_GRID, _GRID), 8.0, 2, 0.5)
        col = downwind / (3.6 * wave_m * stretch) * 8.0 + rng.uniform(0.0, _GRID)
        row = (across + 0.3 * sway) / (wave_m * stretch) * 8.0 + rng.uniform(0.0, _GRID)
        field += fraction * _mirrored(noise, row, col)
    field /= field.std()
    return np.sign(field) * np.abs(field) ** 1.2


def _mirrored(noise: NDArray[np.float32], row: Array, col: Array) -> Array:
    """Samples a raster that is continued by its mirror images, so that it has no seam."""
    last = len(noise) - 1.001
    row, col = (last - np.abs(np.mod(axis, 2.0 * last) - last) for axis in (row, col))
    i, j = np.floor(row).astype(np.int32), np.floor(col).astype(np.int32)
    v, u = row - i, col - j
    top = noise[i, j] * (1.0 - u) + noise[i, j + 1] * u
    return np.asarray(top * (1.0 - v) + (noise[i + 1, j] * (1.0 - u) + noise[i + 1, j + 1] * u) * v)


def drifts(plan: Plan, xy: Array) -> Array:
    """(...) metres of snow that lies behind obstacles: tails behind rocks and the hut, a bank
    behind each fence."""
    depth = np.zeros(xy.shape[:-1])
    tails = [(rock, 1.3 * radius, 0.55 * radius) for rock, radius in plan.rocks]
    for centre, wide, high in [*tails, (plan.hut_xy_m, 3.2, 0.75)]:
        downwind, across = along_wind(plan, xy, centre)
        behind = downwind / wide
        tail = np.where(behind > 0.0, np.exp(-behind / 2.2), np.exp(-((behind / 0.9) ** 2)))
        # A hollow is blown out before and beside the obstacle.
        ring = np.exp(-(((np.hypot(downwind, across) - 1.7 * wide) / (0.5 * wide)) ** 2))
        depth += high * tail * np.exp(-0.5 * (across / (0.7 * wide)) ** 2)
        depth -= 0.25 * high * ring * (behind < 0.4)
    for start, end in plan.fences_m:
        way = (end - start) / np.hypot(*(end - start))
        side = np.array([-way[1], way[0]])
        side = side * (1.0 if side @ plan.wind > 0.0 else -1.0)
        along = (xy - start) @ way
        off = (xy - start) @ side
        left = np.hypot(*(end - start)) - along
        ends = smoothstep(-2.0, 2.0, along) * smoothstep(-2.0, 2.0, left)
        bank = np.where(off > 1.6, np.exp(-(off - 1.6) / 3.0), np.exp(-(((off - 1.6) / 1.1) ** 2)))
        depth += 0.45 * abs(side @ plan.wind) * bank * ends
    return depth


def shape_snow(rng: np.random.Generator, plan: Plan) -> Relief:
    """Returns the surface of the snow; the height at the take-off spot is 0."""
    axis = np.linspace(-HALF_M, HALF_M, NODES)
    xy = np.stack(np.meshgrid(axis, axis), axis=-1)
    cell = float(axis[1] - axis[0])
    shape = (NODES, NODES)
    heights = rng.uniform(0.45, 0.7) * fractal_noise(rng, shape, 40.0 / cell, 2, 0.3).astype(float)
    heights += 0.03 * fractal_noise(rng, shape, 6.0 / cell, 2, 0.4)
    hill = np.linalg.norm(xy - plan.hill_xy_m, axis=-1) / 7.0
    heights += plan.hill_height_m * np.exp(-0.5 * hill**2)
    cut = smoothstep(0.15, 1.2, fractal_noise(rng, shape, 17.0 / cell, 3).astype(np.float64))
    spot = np.linalg.norm(xy - plan.takeoff_xy_m, axis=-1)
    cut *= smoothstep(3.0, 8.0, spot)
    pond = pond_distance(rng, plan, xy)
    cut *= smoothstep(0.5, 5.0, pond)
    heights += 0.5 * rng.uniform(*SASTRUGI_M) * cut * sastrugi(rng, plan, xy, 1.7)
    heights += drifts(plan, xy) * smoothstep(2.0, 6.0, spot)
    ring = (pond > 0.0) & (pond < 3.0)
    ice = float(np.quantile(heights[ring], 0.25)) - 0.25
    bank = ice + 0.10 * smoothstep(0.0, 0.5, pond) + 0.05 * np.maximum(pond, 0.0)
    into = smoothstep(0.0, 7.0, pond)
    heights = np.where(pond > 0.0, (1.0 - into) * bank + into * heights, ice)
    level = float(HeightField(heights_m=heights).at(plan.takeoff_xy_m))
    terrain = level_takeoff(heights, plan.takeoff_xy_m)
    return Relief(terrain=terrain, pond_m=pond, ice_m=ice - level, sastrugi=cut)
