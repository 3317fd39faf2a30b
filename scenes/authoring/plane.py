"""Shapes and turns in the plane, and random choices."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from touchdown.scenes.api import Array

Item = TypeVar("Item")

SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
"""Corners, counter-clockwise"""


def unit(angle: float | Array) -> Array:
    """(..., 2) unit vectors at angles (...) in radians."""
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def left_of(angle: float) -> Array:
    """(2,) unit vector to the left of an angle in radians."""
    return np.array([-np.sin(angle), np.cos(angle)])


def unit_circle(steps: int) -> Array:
    """(steps, 2) points of the unit circle, counter-clockwise."""
    return unit(np.linspace(0.0, 2.0 * np.pi, steps, endpoint=False))


def level_ring(steps: int, radius: float, z: float) -> Array:
    """(steps, 3) points of a circle about the origin at a height."""
    return np.column_stack([radius * unit_circle(steps), np.full(steps, z)])


def rotated(points: Array, angle: float) -> Array:
    """(..., 2) points turned about the origin."""
    c, s = np.cos(angle), np.sin(angle)
    return points @ np.array([[c, s], [-s, c]])


def draw_heading(rng: np.random.Generator) -> float:
    """Any direction, radians."""
    return float(rng.uniform(0.0, 2.0 * np.pi))


def pick(rng: np.random.Generator, items: Sequence[Item]) -> Item:
    """One of ``items``, all as likely."""
    return items[int(rng.integers(len(items)))]
