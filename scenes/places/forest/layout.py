"""Plan of the clearings, the track and the brook."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from touchdown.scenes.api import Array
from touchdown.scenes.authoring.plane import left_of
from touchdown.scenes.authoring.plots import Plot, SurveyFrame, draw_frame

HALF_M = 64.0
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
