"""Roads of any course: rectangles in road coordinates, and wear."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.authoring.ground import Canvas, Ground

Array = NDArray[np.float64]


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
    return np.array([
        way.point(along[0], across[0]), way.point(along[1], across[0]),
        way.point(along[1], across[1]), way.point(along[0], across[1]),
    ])  # fmt: skip


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
        turn = np.linspace(0.0, 2.0 * np.pi, 20, endpoint=False)
        ring = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
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
        turn = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
        radius = rng.uniform(0.08, 0.35) * rng.uniform(0.7, 1.2, 12)
        blot = np.stack([radius * np.cos(turn), radius * np.sin(turn)], axis=-1)
        canvas.soil(centre + blot, int(rng.integers(40, 110)))


def _crack(canvas: Canvas, way: Way, rng: np.random.Generator, along: float, across: float) -> None:
    steps = int(rng.integers(10, 36))
    heading = rng.uniform(0.0, 2.0 * np.pi) + np.cumsum(rng.normal(0.0, 0.35, steps))
    path = np.cumsum(0.22 * np.stack([np.cos(heading), np.sin(heading)], axis=-1), axis=0)
    limit = 0.5 * way.width_m - 0.1
    lateral = np.clip(across + path[:, 1], -limit, limit)
    line = np.array([way.point(along + a, c) for a, c in zip(path[:, 0], lateral, strict=True)])
    canvas.trace(line, 0.03 if rng.random() < 0.7 else 0.07, int(rng.integers(130, 230)))
