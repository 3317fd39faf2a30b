"""Course and materials of the shore: a signed distance from which relief, texture and objects are
derived."""

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from touchdown.scenes.api import Array
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.authoring.plane import unit, wavy
from touchdown.scenes.authoring.plots import SurveyFrame
from touchdown.scenes.authoring.relief import HeightField, level_takeoff, natural_ground, smoothstep

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
class Plan(SurveyFrame):
    """A lake about ``centre_xy_m`` whose outline is a Fourier series of the bearing."""

    centre_xy_m: Array
    radius_m: float
    waves: Array
    """(K, 2) amplitude (fraction of the radius) and phase of the k+2-th harmonic"""
    kinds: NDArray[np.int64]
    """(720,) shore kinds by bearing, half a degree each"""
    islet_xy_m: Array
    islet_radius_m: float
    """negative: there is none"""
    jetty_bearing: float

    def outline_m(self, bearing: Array) -> Array:
        """Radius of the plain outline at bearings in radians."""
        return self.radius_m * wavy(bearing, *self.waves.T)

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

    def middle_of(self, kind: Shore) -> float:
        """Bearing of the middle of the longest stretch of a kind."""
        same = self.kinds == int(kind)
        start = int(np.argmin(same))
        turned = np.roll(same, -start).astype(int)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], turned, [0]])))
        first, last = edges.reshape(-1, 2)[np.argmax(edges[1::2] - edges[::2])]
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
    ground, xy = natural_ground(rng, NODES)
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
    takeoff = float(HeightField(heights_m=heights).at(plan.takeoff_xy_m))
    bottom = level_takeoff(heights, plan.takeoff_xy_m).heights_m
    terrain = HeightField(heights_m=np.maximum(bottom, -takeoff))
    return Basin(terrain=terrain, bottom_m=bottom, shore_m=shore, level_m=-takeoff)
