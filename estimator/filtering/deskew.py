"""Undoes the vehicle's motion during a scan, and thins the scan out evenly."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]


@njit(cache=True)
def deskew(
    directions: Float32,
    ranges: Float32,
    time_offsets: Float32,
    lidar_rotation: Array,
    lidar_position: Array,
    rotations: Array,
    positions: Array,
    step_s: float,
    min_range: float,
    max_range: float,
) -> tuple[Array, Array]:
    """Points of one scan as seen from its end.

    ``directions`` (N, 3), ``ranges`` (N,), ``time_offsets`` (N,) s after the first pose;
    ``lidar_rotation``, ``lidar_position``: imu_from_lidar; ``rotations`` (M + 1, 3, 3) and
    ``positions`` (M + 1, 3): odom_from_imu every ``step_s`` over the scan. Returns points (K, 3) in
    the IMU frame of the last pose and beams (K, 3), sensor to point in the same frame. Pulses
    without a valid return (0, NaN, out of range) are left out.
    """
    count = ranges.shape[0]
    last = rotations.shape[0] - 1
    relative_r = np.empty((last + 1, 3, 3))
    relative_p = np.empty((last + 1, 3))
    spins = np.zeros((last + 1, 3))
    for m in range(last + 1):
        relative_r[m] = rotations[last].T @ rotations[m]
        relative_p[m] = rotations[last].T @ (positions[m] - positions[last])
    for m in range(last):
        # within 5 ms the turn is a few milliradians: its first order is exact to 1e-8 rad
        turn = rotations[m].T @ rotations[m + 1]
        spins[m, 0] = 0.5 * (turn[2, 1] - turn[1, 2])
        spins[m, 1] = 0.5 * (turn[0, 2] - turn[2, 0])
        spins[m, 2] = 0.5 * (turn[1, 0] - turn[0, 1])
    points = np.empty((count, 3))
    beams = np.empty((count, 3))
    kept = 0
    for i in range(count):
        r = ranges[i]
        if not (r >= min_range and r <= max_range):
            continue
        at = time_offsets[i] / step_s
        if not (at >= 0.0):
            continue
        m = min(int(at), last - 1)
        f = at - m
        x, y, z = directions[i, 0] * r, directions[i, 1] * r, directions[i, 2] * r
        bx = lidar_rotation[0, 0] * x + lidar_rotation[0, 1] * y + lidar_rotation[0, 2] * z
        by = lidar_rotation[1, 0] * x + lidar_rotation[1, 1] * y + lidar_rotation[1, 2] * z
        bz = lidar_rotation[2, 0] * x + lidar_rotation[2, 1] * y + lidar_rotation[2, 2] * z
        sx, sy, sz = f * spins[m, 0], f * spins[m, 1], f * spins[m, 2]
        qx, qy, qz = bx + lidar_position[0], by + lidar_position[1], bz + lidar_position[2]
        ux, uy, uz = qx + sy * qz - sz * qy, qy + sz * qx - sx * qz, qz + sx * qy - sy * qx
        dx, dy, dz = bx + sy * bz - sz * by, by + sz * bx - sx * bz, bz + sx * by - sy * bx
        rot = relative_r[m]
        for k in range(3):
            moved = relative_p[m, k] + f * (relative_p[m + 1, k] - relative_p[m, k])
            points[kept, k] = rot[k, 0] * ux + rot[k, 1] * uy + rot[k, 2] * uz + moved
            beams[kept, k] = rot[k, 0] * dx + rot[k, 1] * dy + rot[k, 2] * dz
        kept += 1
    return points[:kept], beams[:kept]


@njit(cache=True)
def thin_out(points: Array, cell: float, table_bits: int) -> NDArray[np.int64]:
    """Indices of one point per occupied cube of side ``cell`` (the first in time), in order.

    ``points`` (N, 3); a table of 2**table_bits buckets, so distinct cubes may (rarely) share one.
    """
    size = 1 << table_bits
    taken = np.zeros(size, dtype=np.bool_)
    chosen = np.empty(points.shape[0], dtype=np.int64)
    count = 0
    for i in range(points.shape[0]):
        ix = np.int64(np.floor(points[i, 0] / cell))
        iy = np.int64(np.floor(points[i, 1] / cell))
        iz = np.int64(np.floor(points[i, 2] / cell))
        mixed = (ix * 73856093) ^ (iy * 19349669) ^ (iz * 83492791)
        slot = (mixed ^ (mixed >> 15)) & (size - 1)
        if not taken[slot]:
            taken[slot] = True
            chosen[count] = i
            count += 1
    return chosen[:count]


def clear_of_blind_zone(
    points: Array, beams: Array, min_range_m: float, range_sigma_m: float
) -> tuple[Array, Array]:
    """(N, 3) points and beams of a scan, or none of them if more than a twentieth come from the
    brink of what the sensor measures: there it gives too long a range for some pulses and none for
    others, so that a map begun with them lies too low."""
    if len(beams):
        closest = float(np.quantile(np.linalg.norm(beams, axis=1), 0.05))
        if closest < min_range_m + 4.0 * range_sigma_m:
            return points[:0], beams[:0]
    return points, beams
