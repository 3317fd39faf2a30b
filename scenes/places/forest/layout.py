"""Plan of the clearings, the track and the brook."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from touchdown.scenes.api import Array
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.authoring.plane import left_of
from touchdown.scenes.authoring.plots import Plot, SurveyFrame, draw_frame
from touchdown.scenes.authoring.relief import HALF_M, HeightField, level_takeoff, smoothstep

SLOTS_M = ((17.0, 3.0), (47.0, 35.0), (15.0, 37.0), (50.0, 4.0))
"""Places for clearings in survey coordinates, around the crossing of track and brook."""
KINDS = ("slope", "stumps", "boulders")
CROSSING_M = (33.0, 20.0)


@dataclass(frozen=True, kw_only=True, slots=True)
class Clearing:
    """A gap in the wood. kind: ``start`` (take-off), ``meadow`` or ``plot`` (level and safe),
    ``slope``, ``stumps`` or ``boulders``."""

    kind: str
    centre_xy_m: Array
    radius_m: float
    phases: Array
    """(3,) of the waves of its edge"""

    def distance(self, xy_m: Array) -> Array:
        """(..., 2) -> (...) metres to the wood's edge, negative in the clearing."""
        rel = np.asarray(xy_m) - self.centre_xy_m
        angle = np.arctan2(rel[..., 1], rel[..., 0])
        orders = np.array([2.0, 3.0, 5.0])
        waves = np.sin(angle[..., None] * orders + self.phases) @ np.array([0.10, 0.07, 0.05])
        return np.hypot(rel[..., 0], rel[..., 1]) - self.radius_m * (1.0 + waves)


@dataclass(frozen=True, kw_only=True, slots=True)
class Course:
    """A curve across the whole scene, a point every metre."""

    line_m: Array
    """(N, 2) world"""

    def nearest(self, xy_m: Array) -> tuple[Array, NDArray[np.int64]]:
        """(..., 2) -> (...) metres to the curve and the index of its nearest point."""
        distance, index = cKDTree(self.line_m).query(np.asarray(xy_m))
        return np.asarray(distance), np.asarray(index, np.int64)

    def heading(self, index: int) -> float:
        """Radians, along the curve."""
        last = len(self.line_m) - 1
        step = self.line_m[min(index + 1, last)] - self.line_m[max(index - 1, 0)]
        return float(np.arctan2(step[1], step[0]))

    def beside(self, index: int, left_m: float) -> Array:
        """(2,) point ``left_m`` to the left of the curve."""
        angle = self.heading(index)
        return self.line_m[index] + left_m * left_of(angle)


@dataclass(frozen=True, kw_only=True, slots=True)
class Plan:
    """The forest of one seed."""

    frame: SurveyFrame
    clearings: tuple[Clearing, ...]
    track: Course
    brook: Course

    def clearing_distance(self, xy_m: Array) -> Array:
        """(..., 2) -> (...) metres to the nearest clearing's edge, negative in it."""
        return np.min([clearing.distance(xy_m) for clearing in self.clearings], axis=0)


def draw_plan(rng: np.random.Generator) -> Plan:
    """Returns a plan with its survey in the middle of the scene, turned any way."""
    frame = draw_frame(rng)
    plot = frame.from_takeoff
    along_is_track = bool(rng.random() < 0.5)
    crossing = np.array(CROSSING_M) + rng.uniform(-1.0, 1.0, 2)
    along = _curve(rng, crossing, 0.0)
    across = _curve(rng, crossing, 0.5 * np.pi)
    track, brook = (along, across) if along_is_track else (across, along)
    return Plan(
        frame=frame,
        clearings=_draw_clearings(rng, plot),
        track=Course(line_m=plot.points(track)),
        brook=Course(line_m=plot.points(brook)),
    )


def _draw_clearings(rng: np.random.Generator, plot: Plot) -> tuple[Clearing, ...]:
    """Returns the take-off's clearing, a safe one on one of the first three slots, and unsafe ones
    on the others."""
    safe_slot = int(rng.integers(3))
    others = [slot for index, slot in enumerate(SLOTS_M) if index != safe_slot]
    kinds = [KINDS[int(k)] for k in rng.permutation(3)]
    kind = "plot" if rng.random() < 0.3 else "meadow"
    places = [("start", (0.0, 0.0), 7.0), (kind, SLOTS_M[safe_slot], rng.uniform(9.0, 10.5))]
    places += [(k, slot, rng.uniform(6.5, 9.0)) for k, slot in zip(kinds, others, strict=True)]
    clearings = []
    for kind, slot, radius in places:
        jitter = 0.0 if kind == "start" else 1.2
        centre = plot.points(np.array(slot) + rng.uniform(-jitter, jitter, 2))
        clearings.append(Clearing(kind=kind, centre_xy_m=centre, radius_m=float(radius),
                         phases=rng.uniform(0.0, 2.0 * np.pi, 3)))  # fmt: skip
    return tuple(clearings)


def _curve(rng: np.random.Generator, through_m: Array, angle: float) -> Array:
    """(N, 2) points of a meandering curve in survey coordinates, straight near its middle."""
    s = np.arange(-100.0, 101.0)
    far = np.abs(s) / 100.0
    sway = rng.uniform(0.8, 1.6) * np.sin(s / rng.uniform(6.0, 8.0) + rng.uniform(0.0, 6.3))
    bend = rng.uniform(-22.0, 22.0, 2)
    side = sway * np.minimum(np.abs(s) / 12.0, 1.0) + np.where(s > 0, *bend) * far**2
    c, n = np.cos(angle), np.sin(angle)
    return through_m + np.outer(s, [c, n]) + np.outer(side, [-n, c])


NODES = 193
TRACK_HALF_M = 1.7
BROOK_DEPTH_M = 0.9
WATER_DEPTH_M = 0.28
BROOK_FALL = 0.012
"""Metres down per metre along."""


def shape_ground(rng: np.random.Generator, plan: Plan) -> HeightField:
    """Returns the forest's ground; the height at the take-off spot is 0."""
    heights = hills(rng)
    plain = HeightField(heights_m=heights)
    xy = plain.node_grid()
    to_brook, at_brook = plan.brook.nearest(xy)
    bed = brook_profile(plan.brook, plain)
    valley = bed[at_brook] + BROOK_DEPTH_M + 0.05 * to_brook
    heights = valley + (heights - valley) * smoothstep(3.0, 15.0, to_brook)
    rough = hummocks(rng)
    heights = heights + rough * smoothstep(-2.0, 3.0, plan.clearing_distance(xy))
    for clearing in plan.clearings:
        heights = _clear(rng, heights, xy, clearing, rough)
    to_track, at_track = plan.track.nearest(xy)
    course = HeightField(heights_m=heights).at(plan.track.line_m)
    over, nearest = plan.brook.nearest(plan.track.line_m)
    bridge = bed[nearest] + BROOK_DEPTH_M + 0.2
    even = gaussian_filter1d(course, 7.0, mode="nearest")
    even = np.where(over < 6.0, np.maximum(even, bridge), even)
    level = gaussian_filter1d(even, 2.0, mode="nearest")[at_track]
    heights = level + (heights - level) * smoothstep(TRACK_HALF_M, TRACK_HALF_M + 4.5, to_track)
    heights = _lowered_to(heights, bed[at_brook], to_brook)
    return level_takeoff(heights, plan.frame.takeoff_xy_m)


def hills(rng: np.random.Generator) -> Array:
    """(NODES, NODES) metres: hills about 90 m apart with shoulders and gullies."""
    cell = 2.0 * HALF_M / (NODES - 1)
    shape = (NODES, NODES)
    large = rng.uniform(1.9, 2.5) * fractal_noise(rng, shape, 34.0 / cell, 1)
    small = rng.uniform(0.50, 0.70) * fractal_noise(rng, shape, 12.0 / cell, 2, 0.4)
    return np.asarray(large + small, np.float64)


def hummocks(rng: np.random.Generator) -> Array:
    """(NODES, NODES) metres: roots, hollows and tussocks of the forest floor."""
    cell = 2.0 * HALF_M / (NODES - 1)
    noise = fractal_noise(rng, (NODES, NODES), 2.6 / cell, 2, 0.6)
    return np.asarray(rng.uniform(0.09, 0.13) * noise, np.float64)


def brook_profile(brook: Course, terrain: HeightField) -> Array:
    """(N,) height of the bed along the brook: it always falls, and lies below the ground. Of the
    two ways to run it takes the one that cuts less."""
    inside = (np.abs(brook.line_m) < HALF_M).all(axis=1)
    ground = gaussian_filter1d(terrain.at(brook.line_m), 5.0, mode="nearest") - 1.2
    ground[~inside] = np.inf
    fall = BROOK_FALL * np.arange(len(ground))
    ahead = np.minimum.accumulate(ground + fall) - fall
    back = (np.minimum.accumulate(ground[::-1] + fall) - fall)[::-1]
    bed = ahead if ahead[inside].mean() > back[inside].mean() else back
    index = np.arange(len(bed))
    # Beyond the scene the bed goes on level, so that smoothing does not bend its ends.
    whole = np.interp(index, index[inside], bed[inside])
    return np.asarray(gaussian_filter1d(whole, 3.0, mode="nearest"))


def _lowered_to(heights: Array, bed: Array, to_brook: Array) -> Array:
    """The brook's channel: a bed 1.2 m wide between steep banks."""
    channel = bed + BROOK_DEPTH_M * smoothstep(0.6, 2.3, to_brook)
    return np.where(to_brook < 2.3, np.minimum(heights, channel), heights)


def _clear(
    rng: np.random.Generator, heights: Array, xy: Array, clearing: Clearing, rough: Array
) -> Array:
    """Evens the ground of a clearing: a plane of its kind's slope, with its kind's roughness."""
    slopes_deg = {"start": (0.0, 0.5), "meadow": (0.5, 2.4), "plot": (0.3, 1.8),
                  "slope": (11.0, 15.0), "stumps": (1.0, 3.5), "boulders": (1.0, 4.0)}  # fmt: skip
    roughness = {"start": 0.05, "meadow": 0.07, "plot": 0.06, "slope": 0.3, "stumps": 0.25,
                 "boulders": 0.55}  # fmt: skip
    distance = clearing.distance(xy)
    rel = xy - clearing.centre_xy_m
    inside = distance < 0.0
    # Downhill stays downhill: the plane turns with the ground that it replaces.
    gradient = np.linalg.lstsq(
        np.column_stack([rel[inside], np.ones(inside.sum())]), heights[inside], rcond=None
    )[0][:2]
    unit = gradient / max(float(np.hypot(*gradient)), 1e-6)
    slope = np.tan(np.deg2rad(rng.uniform(*slopes_deg[clearing.kind])))
    plane = float(heights[inside].mean()) + slope * (rel @ unit)
    plane = plane + roughness[clearing.kind] * rough
    return plane + (heights - plane) * smoothstep(-0.3, 6.5, distance)
