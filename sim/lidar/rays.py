"""Rays of a LIDAR's pulses, and the tracks of the bodies that send and meet them."""

from typing import NamedTuple

import numpy as np
from numba import njit

from touchdown.sim.frames import Pose
from touchdown.sim.geometry.ray_target import Hits, RayTarget
from touchdown.sim.moving import BodyTrack
from touchdown.sim.typing import Array, Float32, Indices, Int32, Uint32


class Track(NamedTuple):
    """World poses of one body at ascending instants: (M,), (M, 3), (M, 3, 3)."""

    times_s: Array
    positions: Array
    rotations: Array

    @staticmethod
    def of(body: BodyTrack) -> "Track":
        return Track(
            np.ascontiguousarray(body.times_s, dtype=np.float64),
            np.ascontiguousarray(body.positions, dtype=np.float64),
            rotations_of(np.ascontiguousarray(body.quats_wxyz, dtype=np.float64)),
        )

    def mounted(self, mount: Pose) -> "Track":
        """The track of something at the pose ``mount`` on the body."""
        return Track(
            self.times_s,
            self.positions + self.rotations @ mount.translation,
            np.ascontiguousarray(self.rotations @ mount.rotation),
        )


class Rays(NamedTuple):
    """World rays (N, 6) with the instants (N,), range noise (N,) and random bits (N,) of each."""

    rays: Float32
    times: Array
    range_noise: Float32
    bits: Uint32

    @staticmethod
    def of(count: int) -> "Rays":
        """Memory for so many rays."""
        noise, bits = np.empty(count, np.float32), np.empty(count, np.uint32)
        return Rays(np.empty((count, 6), np.float32), np.empty(count), noise, bits)

    def part(self, start: int, end: int) -> "Rays":
        """The rays from ``start`` to ``end``, in the same memory."""
        rows = slice(start, end)
        return Rays(self.rays[rows], self.times[rows], self.range_noise[rows], self.bits[rows])

    def move(self, rows: Indices, start: int) -> None:
        """Moves ``rows`` (K,) to the rows from ``start`` on."""
        for values in self:
            values[start : start + len(rows)] = values[rows]


@njit(cache=True, nogil=True, error_model="numpy")
def rotations_of(quats_wxyz: Array) -> Array:
    """(M, 4) unit quaternions -> (M, 3, 3)."""
    out = np.empty((quats_wxyz.shape[0], 3, 3))
    for k in range(quats_wxyz.shape[0]):
        w, x, y, z = quats_wxyz[k]
        out[k, 0, 0], out[k, 0, 1], out[k, 0, 2] = (
            1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        )  # fmt: skip
        out[k, 1, 0], out[k, 1, 1], out[k, 1, 2] = (
            2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        )  # fmt: skip
        out[k, 2, 0], out[k, 2, 1], out[k, 2, 2] = (
            2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
        )  # fmt: skip
    return out


Movers = list[tuple[RayTarget, Track]]
"""Moving bodies with their tracks over a scan"""


@njit(cache=True, nogil=True, error_model="numpy")
def ground_cells(
    rays: Float32, hits: Hits, ground_geom: int, frame: Array, rows: int, cols: int
) -> Int32:
    """Flat indices (N,) of the cells of the ground's raster that the rays (N, 6) hit, -1 beyond it
    and elsewhere; the ground as in ``sim.lidar.raycast_scene.OpticalTable``."""
    distance, geom, _ = hits
    out = np.empty(rays.shape[0], dtype=np.int32)
    for i in range(rays.shape[0]):
        d = distance[i] if geom[i] == ground_geom else np.float32(0.0)
        col = np.int32(np.floor((rays[i, 0] + d * rays[i, 3] - frame[0]) * frame[2]))
        row = np.int32(np.floor((rays[i, 1] + d * rays[i, 4] - frame[1]) * frame[2]))
        inside = (geom[i] == ground_geom) & (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
        out[i] = row * np.int32(cols) + col if inside else np.int32(-1)
    return out
