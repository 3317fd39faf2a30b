"""Rays of a LIDAR's pulses, and the tracks of the bodies that send and meet them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from touchdown.sim.frames import Pose
from touchdown.sim.geometry.ray_target import RayTarget
from touchdown.sim.lidar import beams
from touchdown.sim.moving import BodyTrack
from touchdown.sim.typing import Array, Float32, Indices, Uint32


@dataclass(frozen=True, slots=True)
class Track:
    """World poses of one body at ascending instants: (M,), (M, 3), (M, 3, 3)."""

    times_s: Array
    positions: Array
    rotations: Array

    @staticmethod
    def of(body: BodyTrack) -> Track:
        return Track(
            np.ascontiguousarray(body.times_s, dtype=np.float64),
            np.ascontiguousarray(body.positions, dtype=np.float64),
            beams.rotations_of(np.ascontiguousarray(body.quats_wxyz, dtype=np.float64)),
        )

    def mounted(self, mount: Pose) -> Track:
        """The track of something at the pose ``mount`` on the body."""
        return Track(
            self.times_s,
            self.positions + self.rotations @ mount.translation,
            np.ascontiguousarray(self.rotations @ mount.rotation),
        )


@dataclass(frozen=True, slots=True)
class Rays:
    """World rays (N, 6) with the instants (N,), range noise (N,) and random bits (N,) of each."""

    rays: Float32
    times: Array
    range_noise: Float32
    bits: Uint32

    def at(self, rows: Indices) -> Rays:
        return Rays(self.rays[rows], self.times[rows], self.range_noise[rows], self.bits[rows])

    @staticmethod
    def joined(*groups: Rays) -> Rays:
        return Rays(
            np.concatenate([group.rays for group in groups]),
            np.concatenate([group.times for group in groups]),
            np.concatenate([group.range_noise for group in groups]),
            np.concatenate([group.bits for group in groups]),
        )


Movers = list[tuple[RayTarget, Track]]
"""Moving bodies with their tracks over a scan"""
