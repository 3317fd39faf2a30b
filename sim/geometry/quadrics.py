"""Exact intersections of rays with MuJoCo's round shapes and planes.

An acceleration structure holds triangles that wrap these shapes; what it finds is settled here, in
double precision. A ray that starts inside a shape meets it where it leaves, as in MuJoCo.
"""

import math
from typing import NamedTuple

import mujoco
import numpy as np
from numba import njit
from numpy.typing import NDArray

from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array, Float32, Indices, Int32, Uint32

_OTHER, _PLANE, _ELLIPSOID, _CYLINDER, _CAPSULE = range(5)
_KINDS = {
    mujoco.mjtGeom.mjGEOM_PLANE: _PLANE,
    mujoco.mjtGeom.mjGEOM_SPHERE: _ELLIPSOID,
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: _ELLIPSOID,
    mujoco.mjtGeom.mjGEOM_CYLINDER: _CYLINDER,
    mujoco.mjtGeom.mjGEOM_CAPSULE: _CAPSULE,
}
_MISS = np.uint32(0xFFFFFFFF)
_LARGEST_GAP_M = 1e-3
"""Where a ray runs further between wrapping and shape, another surface may lie in between."""


class ShapeTable(NamedTuple):
    """Shapes by MuJoCo geom id, in the frame that rays are given in."""

    kind: NDArray[np.int8]
    """(G,) 0 for what its triangles describe exactly"""
    rotation: Array
    """(G, 3, 3)"""
    center: Array
    """(G, 3) metres"""
    size: Array
    """(G, 3) semi-axes; radius and half length"""

    @staticmethod
    def empty(geom_count: int) -> "ShapeTable":
        return ShapeTable(
            np.zeros(geom_count, dtype=np.int8),
            np.zeros((geom_count, 3, 3)),
            np.zeros((geom_count, 3)),
            np.ones((geom_count, 3)),
        )

    def add(self, model: mujoco.MjModel, geom_id: int, frame_from_geom: Pose) -> None:
        """Enters a geom, if it is one of the shapes."""
        kind = mujoco.mjtGeom(int(model.geom_type[geom_id]))
        size = np.array(model.geom_size[geom_id])
        self.kind[geom_id] = _KINDS.get(kind, _OTHER)
        self.rotation[geom_id] = frame_from_geom.rotation
        self.center[geom_id] = frame_from_geom.translation
        self.size[geom_id] = size[0] if kind == mujoco.mjtGeom.mjGEOM_SPHERE else size


@njit(cache=True, nogil=True, error_model="numpy")
def settle(
    rays: Float32,
    rows: Indices,
    travelled: Float32,
    wrapped_distance: Float32,
    triangle: Uint32,
    normal: Float32,
    geom_of_triangle: Int32,
    shapes: ShapeTable,
    hits: tuple[Float32, Int32, Float32],
    again: Indices,
) -> int:
    """True hits of rays (K, 6) from those on triangles. Those that are nearer than what is known go
    to ``rows`` (K,) of ``hits`` (see ``sim.geometry.ray_target.Hits``), with what the rays have
    ``travelled`` (K,) already. Returns the number of those that have to be cast on, which pass
    between a shape and its wrapping, and puts them to the front of ``again`` (K,)."""
    kinds, rotations, centers, sizes = shapes
    distance, geom, cosine = hits
    count = 0
    local = np.empty(6)
    for i in range(rays.shape[0]):
        if triangle[i] == _MISS:
            continue
        g, row = geom_of_triangle[triangle[i]], rows[i]
        kind = kinds[g]
        if kind == _OTHER:
            if wrapped_distance[i] + travelled[i] < distance[row]:
                distance[row], geom[row] = wrapped_distance[i] + travelled[i], g
                cosine[row] = -(
                    normal[i, 0] * rays[i, 3]
                    + normal[i, 1] * rays[i, 4]
                    + normal[i, 2] * rays[i, 5]
                )
            continue
        for r in range(3):
            local[r] = 0.0
            local[3 + r] = 0.0
            for c in range(3):
                local[r] += rotations[g, c, r] * (rays[i, c] - centers[g, c])
                local[3 + r] += rotations[g, c, r] * rays[i, 3 + c]
        met, facing = _meet(kind, local, sizes[g])
        if met >= 0.0 and np.float32(met) + travelled[i] < distance[row]:
            distance[row], geom[row], cosine[row] = np.float32(met) + travelled[i], g, facing
        if met >= 0.0 and met - wrapped_distance[i] <= _LARGEST_GAP_M:
            continue
        # What is known lies before all that is still to come.
        if distance[row] > wrapped_distance[i] + travelled[i]:
            again[count] = i
            count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def rays_behind(
    rays: Float32, chosen: Indices, distance: Float32, onward: Float32, travelled: Float32
) -> None:
    """Fills ``onward`` (K, 6): the ``chosen`` (K,) rays, which start ``distance`` (K,) further on;
    adds it to what they have ``travelled`` (K,)."""
    for k in range(chosen.shape[0]):
        travelled[k] += distance[k]
        for c in range(3):
            onward[k, c] = rays[chosen[k], c] + distance[k] * rays[chosen[k], 3 + c]
            onward[k, 3 + c] = rays[chosen[k], 3 + c]


@njit(cache=True, forceinline=True, error_model="numpy")
def _meet(kind: int, ray: Array, size: Array) -> tuple[float, float]:
    """Distance at which a ray (6,) in the shape's frame meets it first (-1: never), and the cosine
    between the outward normal there and the way back."""
    if kind == _PLANE:
        if ray[5] == 0.0:
            return -1.0, 0.0
        t = -ray[2] / ray[5]
        return (t, -ray[5]) if t >= 0.0 else (-1.0, 0.0)
    if kind == _ELLIPSOID:
        return _meet_ellipsoid(ray, 0.0, size)
    # MuJoCo's cylinders and capsules stand along z.
    radius, half = size[0], size[1]
    best, facing = -1.0, 0.0
    a = ray[3] * ray[3] + ray[4] * ray[4]
    b = ray[0] * ray[3] + ray[1] * ray[4]
    c = ray[0] * ray[0] + ray[1] * ray[1] - radius * radius
    root = b * b - a * c
    if a > 1e-14 and root >= 0.0:
        for sign in (-1.0, 1.0):
            t = (-b + sign * math.sqrt(root)) / a
            if t >= 0.0 and abs(ray[2] + t * ray[5]) <= half:
                best, facing = t, -(b + t * a) / radius
                break
    for side in (-1.0, 1.0):
        if kind == _CYLINDER:
            if ray[5] == 0.0:
                continue
            t = (side * half - ray[2]) / ray[5]
            x, y = ray[0] + t * ray[3], ray[1] + t * ray[4]
            if t >= 0.0 and x * x + y * y <= radius * radius and (best < 0.0 or t < best):
                best, facing = t, -side * ray[5]
        else:
            ball = np.array([radius, radius, radius])
            t, cos = _meet_ellipsoid(ray, side * half, ball, side)
            if t >= 0.0 and (best < 0.0 or t < best):
                best, facing = t, cos
    return best, facing


@njit(cache=True, forceinline=True, error_model="numpy")
def _meet_ellipsoid(
    ray: Array, z: float, semi_axes: Array, half: float = 0.0
) -> tuple[float, float]:
    """As `_meet`, for an ellipsoid centred at (0, 0, z); ``half`` +1 or -1: only the part of it
    above or below its centre counts."""
    ox, oy, oz = ray[0] / semi_axes[0], ray[1] / semi_axes[1], (ray[2] - z) / semi_axes[2]
    dx, dy, dz = ray[3] / semi_axes[0], ray[4] / semi_axes[1], ray[5] / semi_axes[2]
    a = dx * dx + dy * dy + dz * dz
    b = ox * dx + oy * dy + oz * dz
    # From the nearest point to the centre, so that a small shape far away loses no digits.
    nx, ny, nz = ox - b / a * dx, oy - b / a * dy, oz - b / a * dz
    root = 1.0 - (nx * nx + ny * ny + nz * nz)
    if root < 0.0:
        return -1.0, 0.0
    reach = math.sqrt(root / a)
    for sign in (-1.0, 1.0):
        t = -b / a + sign * reach
        if t < 0.0 or half * (oz + t * dz) < 0.0:
            continue
        gx = (ox + t * dx) / semi_axes[0]
        gy = (oy + t * dy) / semi_axes[1]
        gz = (oz + t * dz) / semi_axes[2]
        length = math.sqrt(gx * gx + gy * gy + gz * gz)
        return t, -(gx * ray[3] + gy * ray[4] + gz * ray[5]) / length
    return -1.0, 0.0
