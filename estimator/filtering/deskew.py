"""Screening, deskewing and thinning of LIDAR scans for the estimators.

The mapper deskews by a kernel of its own (``estimator/mapping/kernels.py``): it keeps pulses
without return, accepts tracks of any spacing and computes in float32, so that a shared kernel
would change its maps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from touchdown.estimator.filtering.error_state import Frame, Frames
from touchdown.sim.api import LidarParams, LidarScan
from touchdown.sim.frames import Pose

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]
Indices = NDArray[np.int64]

_BLIND_SIGMAS = 4.0
_BLIND_SHARE = 0.05


@dataclass(frozen=True, slots=True)
class PlacedScan:
    """Valid returns of one scan in the IMU frame at the end of the scan."""

    points: Array
    """(K, 3) m"""
    beams: Array
    """(K, 3) m, from the sensor to the point"""
    pulses: Indices
    """(K,) indices of the pulses in the scan, ascending"""

    def __len__(self) -> int:
        return len(self.points)

    def select(self, chosen: Indices) -> PlacedScan:
        """Returns the subset with the given indices."""
        return PlacedScan(self.points[chosen], self.beams[chosen], self.pulses[chosen])


def screen_scan(scan: LidarScan, lidar: LidarParams, *, check_blind_zone: bool = False) -> Indices:
    """Returns the indices (K,) of the pulses with a valid return: a finite range between
    ``min_range_m`` and ``max_range_m`` and a time within the scan.

    ``check_blind_zone``: returns no pulses if more than a twentieth of the ranges lie within four
    standard deviations of ``min_range_m``. There the sensor reports too long a range for some
    pulses and none for others, and a map started from such a scan lies too low.
    """
    pulses = _valid_pulses(scan.ranges, scan.time_offsets, lidar.min_range_m, lidar.max_range_m)
    if check_blind_zone and len(pulses):
        blind = lidar.min_range_m + _BLIND_SIGMAS * lidar.range_sigma_m
        if np.count_nonzero(scan.ranges[pulses] < blind) > _BLIND_SHARE * len(pulses):
            return pulses[:0]
    return pulses


def place_scan(
    scan: LidarScan,
    pulses: Indices,
    imu_from_lidar: Pose,
    rotations: Array,
    positions: Array,
    step_s: float,
) -> PlacedScan:
    """Deskews the given ``pulses`` (K,) of a scan into the IMU frame at its end.

    ``rotations`` (M + 1, 3, 3) and ``positions`` (M + 1, 3): odom_from_imu every ``step_s`` from
    the start of the scan to its end.
    """
    shot = _Pulses(scan.directions, scan.ranges, scan.time_offsets, pulses)
    track = Frames(rotations, positions)
    points, beams = _deskew(shot, Frame.of(imu_from_lidar), track, step_s)
    return PlacedScan(points, beams, pulses)


@njit(cache=True)
def _valid_pulses(
    ranges: Float32, time_offsets: Float32, min_range: float, max_range: float
) -> Indices:
    """Returns the indices (K,); comparisons with NaN are false."""
    chosen = np.empty(ranges.shape[0], dtype=np.int64)
    count = 0
    for i in range(ranges.shape[0]):
        if ranges[i] >= min_range and ranges[i] <= max_range and time_offsets[i] >= 0.0:
            chosen[count] = i
            count += 1
    return chosen[:count]


class _Pulses(NamedTuple):
    """Pulses of a scan, and the indices of those to be used."""

    directions: Float32  # (N, 3)
    ranges: Float32  # (N,) m
    time_offsets: Float32  # (N,) s after the first pose
    chosen: Indices  # (K,)


@njit(cache=True)
def _deskew(
    shot: _Pulses, imu_from_lidar: Frame, track: Frames, step_s: float
) -> tuple[Array, Array]:
    """Returns points (K, 3) and beams (K, 3), see ``place_scan``."""
    directions, ranges, time_offsets, pulses = shot
    lidar_rotation, lidar_position = imu_from_lidar
    rotations, positions = track
    count = pulses.shape[0]
    last = rotations.shape[0] - 1
    relative_r = np.empty((last + 1, 3, 3))
    relative_p = np.empty((last + 1, 3))
    spins = np.zeros((last + 1, 3))
    for m in range(last + 1):
        relative_r[m] = rotations[last].T @ rotations[m]
        relative_p[m] = rotations[last].T @ (positions[m] - positions[last])
    for m in range(last):
        # within 5 ms the rotation is a few milliradians: its first order is exact to 1e-8 rad
        rotation = rotations[m].T @ rotations[m + 1]
        spins[m, 0] = 0.5 * (rotation[2, 1] - rotation[1, 2])
        spins[m, 1] = 0.5 * (rotation[0, 2] - rotation[2, 0])
        spins[m, 2] = 0.5 * (rotation[1, 0] - rotation[0, 1])
    points = np.empty((count, 3))
    beams = np.empty((count, 3))
    for kept in range(count):
        i = pulses[kept]
        r = ranges[i]
        at = time_offsets[i] / step_s
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
    return points, beams


@njit(cache=True)
def moved(points: Array, chosen: Indices, frame: Frame) -> Array:
    """Returns the ``chosen`` (K,) of (N, 3) points, rotated and translated, (K, 3)."""
    out = np.empty((chosen.shape[0], 3))
    for k in range(chosen.shape[0]):
        x, y, z = points[chosen[k], 0], points[chosen[k], 1], points[chosen[k], 2]
        for a in range(3):
            r = frame.rotation[a]
            out[k, a] = r[0] * x + r[1] * y + r[2] * z + frame.translation[a]
    return out


@njit(cache=True)
def thin_out(points: Array, cell: float, table_bits: int) -> NDArray[np.int64]:
    """Returns the indices of one point per occupied cube of side ``cell`` (the first), ascending.

    ``points`` (N, 3). Cubes are hashed into 2**table_bits buckets; distinct cubes rarely collide.
    """
    size = 1 << table_bits
    taken = np.zeros(size, dtype=np.bool_)
    chosen = np.empty(points.shape[0], dtype=np.int64)
    count, scale = 0, 1.0 / cell
    for i in range(points.shape[0]):
        ix = np.int64(np.floor(points[i, 0] * scale))
        iy = np.int64(np.floor(points[i, 1] * scale))
        iz = np.int64(np.floor(points[i, 2] * scale))
        mixed = (ix * 73856093) ^ (iy * 19349669) ^ (iz * 83492791)
        slot = (mixed ^ (mixed >> 15)) & (size - 1)
        if not taken[slot]:
            taken[slot] = True
            chosen[count] = i
            count += 1
    return chosen[:count]
