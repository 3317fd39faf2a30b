"""Tracks in soft ground: prints of feet, grooves of skis, runners and wheels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from touchdown.scenes.api import Array
from touchdown.scenes.authoring.ground import Canvas, Ground
from touchdown.scenes.authoring.micro_relief import MicroRelief
from touchdown.scenes.authoring.plane import unit

_SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
_TURN = np.linspace(0.0, 2.0 * np.pi, 14, endpoint=False)
OVAL = unit(_TURN)


def placed(at: Array, heading: float, local: Array) -> Array:
    """(N, 2) local points turned by ``heading`` and moved to ``at`` (2,)."""
    c, s = np.cos(heading), np.sin(heading)
    return at + local @ np.array([[c, s], [-s, c]])


def wander(rng: np.random.Generator, ends_m: Array, sway_m: float) -> Array:
    """(N, 2) a smooth way from one end to the other, (2, 2), a point every 0.1 m or so."""
    span = ends_m[1] - ends_m[0]
    share = np.linspace(0.0, 1.0, max(8, int(np.hypot(*span) / 0.1)))
    return sidled(rng, ends_m[0] + share[:, None] * span, sway_m)


def sidled(rng: np.random.Generator, line_m: Array, sway_m: float) -> Array:
    """A line (N, 2) that sways to both sides of another and shares its ends."""
    span = line_m[-1] - line_m[0]
    side = np.array([-span[1], span[0]]) / np.hypot(*span)
    share = np.linspace(0.0, 1.0, len(line_m))
    off = np.zeros(len(share))
    for order in range(1, 5):
        off += rng.normal(0.0, sway_m / order) * np.sin(order * np.pi * share)
    return line_m + off[:, None] * side


def footprints(
    rng: np.random.Generator,
    canvas: Canvas,
    fine: MicroRelief,
    line_m: Array,
    material: Ground | None,
) -> None:
    """Presses a walker's prints along a line, left and right in turn, 0.7 m a step; their ground is
    ``material``, or stays what it is."""
    steps = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line_m, axis=0), axis=1))])
    left = 1.0
    for at in np.arange(0.3, steps[-1] - 0.3, 0.68):
        at += rng.normal(0.0, 0.04)
        where = np.array([np.interp(at, steps, line_m[:, k]) for k in (0, 1)])
        ahead = np.array([np.interp(at + 0.3, steps, line_m[:, k]) for k in (0, 1)])
        heading = float(np.arctan2(*(ahead - where)[::-1])) - 0.10 * left + rng.normal(0.0, 0.05)
        foot = where + placed(np.zeros(2), heading, np.array([0.0, 0.13 * left]))
        depth = rng.uniform(0.06, 0.10)
        fine.press(placed(foot, heading, OVAL * [0.20, 0.10]), -0.012)
        fine.press(placed(foot, heading, OVAL * [0.165, 0.058]), depth)
        # The foot drags snow out of its print.
        fine.press(placed(foot, heading, np.array([0.24, 0.0]) + OVAL * [0.07, 0.03]), 0.02)
        if material is not None:
            canvas.fill(placed(foot, heading, OVAL * [0.15, 0.055]), material)
        left = -left


def parallel(line_m: Array, off_m: float) -> Array:
    """The line moved to its left."""
    way = np.gradient(line_m, axis=0)
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
    return line_m + off_m * np.stack([-way[:, 1], way[:, 0]], axis=-1)


@dataclass(frozen=True, kw_only=True, slots=True)
class Gauge:
    """A pair of skis, runners or wheels, in metres."""

    apart_m: float
    width_m: float
    depth_m: float


SKIS = Gauge(apart_m=0.22, width_m=0.085, depth_m=0.03)
SLEDGE = Gauge(apart_m=0.42, width_m=0.07, depth_m=0.035)
WHEELS = Gauge(apart_m=1.55, width_m=0.27, depth_m=0.07)


def runners(
    canvas: Canvas, fine: MicroRelief, line_m: Array, gauge: Gauge, material: Ground
) -> None:
    """Draws a pair of grooves."""
    for side in (-0.5, 0.5):
        groove = parallel(line_m, side * gauge.apart_m)
        fine.groove(groove, gauge.width_m, gauge.depth_m)
        canvas.track(groove, gauge.width_m, material)


def vehicle_track(
    rng: np.random.Generator, canvas: Canvas, fine: MicroRelief, line_m: Array, material: Ground
) -> None:
    """The ruts of a vehicle with lugged tyres."""
    runners(canvas, fine, line_m, WHEELS, material)
    for side in (-0.5, 0.5):
        rut = parallel(line_m, side * WHEELS.apart_m)
        way = np.gradient(rut, axis=0)
        for index in range(0, len(rut), 2):
            heading = float(np.arctan2(way[index, 1], way[index, 0]))
            lug = placed(rut[index], heading + 0.5 * side, _SQUARE * [0.028, 0.11])
            fine.press(lug, WHEELS.depth_m + rng.uniform(0.005, 0.02))
