"""Shapes and turns in the plane, and random choices."""

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


def unit_ball(rings: int, sectors: int) -> Array:
    """(rings * sectors, 3) points of the unit sphere, ring by ring from the pole above."""
    polar = np.repeat(np.linspace(0.0, np.pi, rings), sectors)
    turn = np.tile(np.linspace(0.0, 2.0 * np.pi, sectors, endpoint=False), rings)
    return np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], -1)


def wavy(bearing: Array, amplitude: Array, phase: Array) -> Array:
    """(...) at bearings in radians, about 1: an outline whose k-th wave, of (K,), goes round k + 2
    times."""
    order = np.arange(len(amplitude)) + 2
    return 1.0 + np.cos(np.multiply.outer(bearing, order) + phase) @ amplitude


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
