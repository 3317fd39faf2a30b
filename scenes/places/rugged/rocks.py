"""Rocks by the size-frequency law of planetary landing sites, half-buried, of three shapes.

Rocks of diameter D and larger cover the fraction F(D) = k exp(-q D) of the ground, with
q = 1.79 + 0.152 / k (Golombek and Rapp, JGR 102, 1997; Golombek et al., JGR 108, 2003). Rocks as
high as half their diameter are half-buried balls.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from touchdown.scenes.api import Array
from touchdown.scenes.authoring.meshes import MeshData
from touchdown.scenes.authoring.relief import HALF_M

SMALLEST_M, LARGEST_M = 0.1, 4.0
ROUND, SLAB, ANGULAR = range(3)
_HEIGHTS = np.array([0.5, 0.3, 0.55])
"""over the ground, of a rock's diameter, by shape; the first as half a ball, the others assumed"""
_FACETS = 5


class Rocks(NamedTuple):
    """N rocks."""

    xy_m: Array
    """(N, 2) world"""
    diameter_m: Array
    """(N,) of the circle of the same area"""
    aspect: Array
    """(N,) length over width"""
    heading: Array
    """(N,) radians, of the length"""
    shape: NDArray[np.int64]
    """(N,)"""
    height_m: Array
    """(N,) over the ground"""
    turn: Array
    """(N,) radians, of facets and tilt"""

    def only(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> "Rocks":
        """Those chosen by a mask or by indices."""
        return self._replace(**{name: getattr(self, name)[chosen] for name in self._fields})


def covered_fraction(k: float, diameter_m: Array) -> Array:
    """F(D), the fraction of the ground that rocks of ``diameter_m`` (...) and larger cover."""
    return np.asarray(k * np.exp(-(1.79 + 0.152 / k) * diameter_m), np.float64)


def draw_rocks(rng: np.random.Generator, k: float, area_m2: float, density: Array) -> Rocks:
    """Returns rocks of 0.1 to 4 m by the law. density: (n, n), proportional to the number of rocks
    over the square of the scene."""
    if k <= 0.0:
        return _rocks(rng, np.zeros(0), density)
    edges = np.geomspace(SMALLEST_M, LARGEST_M, 400)
    middle = np.sqrt(edges[:-1] * edges[1:])
    counts = -np.diff(covered_fraction(k, edges)) * area_m2 / (0.25 * np.pi * middle**2)
    number = rng.poisson(counts.sum())
    reached = np.concatenate([[0.0], np.cumsum(counts)]) / counts.sum()
    return _rocks(rng, np.interp(rng.uniform(0.0, 1.0, number), reached, edges), density)


def _rocks(rng: np.random.Generator, diameter: Array, density: Array) -> Rocks:
    count, size = len(diameter), len(density)
    weight = np.cumsum(density.ravel())
    cells = np.searchsorted(weight, rng.uniform(0.0, weight[-1], count))
    spots = np.stack([cells % size, cells // size], axis=-1) + rng.uniform(0.0, 1.0, (count, 2))
    shape = rng.choice(3, count, p=[0.35, 0.25, 0.40])
    return Rocks(
        xy_m=spots * (2.0 * HALF_M / size) - HALF_M,
        diameter_m=diameter,
        aspect=rng.uniform(1.0, 1.7, count),
        heading=rng.uniform(0.0, 2.0 * np.pi, count),
        shape=shape,
        height_m=_HEIGHTS[shape] * diameter * rng.uniform(0.8, 1.15, count),
        turn=rng.uniform(0.0, 2.0 * np.pi, count),
    )


def heap(rocks: Rocks, nodes: int) -> Array:
    """(nodes, nodes) metres that rocks rise over the ground at the nodes of the scene's square. A
    rock narrower than two cells stands on the nearest node."""
    out = np.zeros((nodes, nodes))
    _heap(
        out, 2.0 * HALF_M / (nodes - 1), HALF_M, rocks.xy_m, rocks.diameter_m, rocks.aspect,
        rocks.heading, rocks.shape, rocks.height_m, rocks.turn,
    )  # fmt: skip
    return out


@njit(cache=True, error_model="numpy")
def _heap(
    out: Array, cell: float, half: float, xy: Array, diameter: Array, aspect: Array, heading: Array,
    shape: NDArray[np.int64], height: Array, turn: Array,
) -> None:  # fmt: skip
    last = out.shape[0] - 1
    for k in range(diameter.size):
        x, y = (xy[k, 0] + half) / cell, (xy[k, 1] + half) / cell
        if diameter[k] < 2.0 * cell:
            x, y = np.round(x), np.round(y)
        length = 0.5 * diameter[k] * np.sqrt(aspect[k]) / cell
        width = length / aspect[k]
        c, s = np.cos(heading[k]), np.sin(heading[k])
        for row in range(max(int(y - length), 0), min(int(y + length) + 1, last) + 1):
            for col in range(max(int(x - length), 0), min(int(x + length) + 1, last) + 1):
                u = (c * (col - x) + s * (row - y)) / length
                v = (c * (row - y) - s * (col - x)) / width
                rise = height[k] * _profile(shape[k], u, v, turn[k])
                if rise > out[row, col]:
                    out[row, col] = rise


@njit(cache=True, error_model="numpy")
def _profile(shape: int, u: float, v: float, turn: float) -> float:
    """Height at (u, v) in half axes over the greatest height."""
    r2 = u * u + v * v
    if r2 >= 1.0:
        return 0.0
    if shape == 0:
        return np.sqrt(1.0 - r2)
    tilt = 0.22 * (u * np.cos(turn) + v * np.sin(turn))
    if shape == 1:
        return min(1.0, 3.2 * (1.0 - np.sqrt(r2))) * (0.8 + tilt)
    low = 0.92 + 0.5 * tilt
    for k in range(_FACETS):
        angle = turn + 2.0 * np.pi * (k + 0.3 * np.sin(3.0 * turn + k)) / _FACETS
        low = min(low, 1.9 * (1.02 - u * np.cos(angle) - v * np.sin(angle)))
    return max(low, 0.0)


def boulder_mesh(rng: np.random.Generator, rocks: Rocks, index: int, uv_m: float) -> MeshData:
    """Returns the convex body of one rock, so that what is seen is what is touched; its middle lies
    in the ground at the origin and its length along +x. ``uv_m``: metres a texture."""
    shape, diameter = int(rocks.shape[index]), float(rocks.diameter_m[index])
    count, exponent = ((46, 2.2), (26, 5.0), (15, 2.6))[shape]
    points = rng.normal(size=(count, 3))
    points /= ((np.abs(points) ** exponent).sum(axis=1) ** (1.0 / exponent))[:, None]
    stretch = np.sqrt(rocks.aspect[index])
    points[:, :2] *= 0.5 * diameter * np.array([stretch, 1.0 / stretch])
    points[:, 2] *= float(rocks.height_m[index]) / points[:, 2].max()
    points[:, :2] *= 0.5 * diameter * np.sqrt(np.pi / ConvexHull(points[:, :2]).volume)
    hull = ConvexHull(points)
    corners = points[hull.simplices]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outward = corners.mean(axis=1) - points.mean(axis=0)
    inward = (normal * outward).sum(axis=1) < 0.0
    corners[inward] = corners[inward, ::-1]
    flat = np.abs(normal[:, 2]) > 0.6 * np.linalg.norm(normal, axis=1)
    aside = np.stack([corners[..., 0] + corners[..., 1], corners[..., 2]], axis=-1)
    uv = np.where(flat[:, None, None], corners[..., :2], aside) / uv_m + rng.uniform(size=2)
    faces = np.arange(3 * len(corners)).reshape(-1, 3)
    return MeshData(
        vertices=corners.reshape(-1, 3), faces=faces.astype(np.int32), uv=uv.reshape(-1, 2)
    )
