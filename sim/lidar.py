"""A scanning LIDAR on a moving vehicle: pulses, returns, noise and intensity.

Every pulse is cast from the pose of its own instant. Whether it comes back follows from a link
budget through the manufacturer's range limits; water reflects like the rough mirror it is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from scenes.api import Scene
from sim import lidar_kernels as kernels
from sim.api import LidarParams, LidarScan
from sim.frames import Pose, matrices_from_quats_wxyz, quat_wxyz_from_matrix
from sim.lidar_scene import Hits, LidarScene, RayTarget
from sim.livox import pattern

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]

MovingTrack = Pose | tuple[Array, Array]
"""A moving body during a scan: one pose, or (positions (M, 3), quats_wxyz (M, 4)) at the same
instants as the vehicle's own track."""

_MOST_PASSES = 5
"""Porous surfaces that one pulse may cross (each crown counts twice: in and out)."""
_STEP_BEHIND_M = 1e-3


@dataclass(frozen=True, slots=True)
class _Track:
    """World poses of one body at ascending instants: (M,), (M, 3), (M, 4) wxyz, neighbouring
    quaternions in the same hemisphere."""

    times_s: Array
    positions: Array
    quats_wxyz: Array

    @staticmethod
    def of(times_s: Array, positions: Array, quats_wxyz: Array) -> _Track:
        quats = np.array(quats_wxyz, dtype=np.float64)
        flips = np.sum(quats[1:] * quats[:-1], axis=1) < 0.0
        quats[1:] *= np.where(np.cumsum(flips) % 2 == 1, -1.0, 1.0)[:, None]
        return _Track(
            np.array(times_s, dtype=np.float64), np.array(positions, dtype=np.float64), quats
        )


class LidarSensor:
    """Simulates the LIDAR that ``params.preset`` names in ``scene``.

    ``scan`` is a pure function of its arguments, the scene and the seed: it may run in any thread
    beside the physics. Raises ValueError for an unknown preset.
    """

    def __init__(self, scene: Scene, params: LidarParams, seed: int) -> None:
        self._pattern = pattern(params.preset)
        self._params = params
        self._seed = seed
        self._scene = LidarScene(scene)

    def scan(
        self,
        start_tick: int,
        end_tick: int,
        tick_hz: int,
        body_times_s: Array,
        body_positions: Array,
        body_quats_wxyz: Array,
        body_from_lidar: Pose,
        moving_poses: Mapping[str, MovingTrack],
    ) -> LidarScan:
        """All pulses fired in (start_tick, end_tick].

        The vehicle's track: body_times_s (M,) seconds, ascending, covering the scan (a pose per
        tick, both ends included); body_positions (M, 3) world metres; body_quats_wxyz (M, 4)
        world_from_body. ``moving_poses`` by body name; a body left out stays at its rest pose.

        Raises ValueError when the track does not cover the scan or a name is not a moving body's.
        """
        rate = self._pattern.point_rate_hz
        first = start_tick * rate // tick_hz + 1
        count = end_tick * rate // tick_hz + 1 - first
        start_s = start_tick / tick_hz
        times = np.arange(first, first + count) / rate
        self._check_track(body_times_s, start_s, end_tick / tick_hz)
        nominal = self._pattern.directions(first, count)
        normals, bits = self._draw(start_tick, count)
        track = _lidar_track(body_times_s, body_positions, body_quats_wxyz, body_from_lidar)
        rays = np.empty((count, 6), dtype=np.float32)
        kernels.aim(
            nominal,
            normals,
            np.deg2rad(self._params.angle_sigma_deg),
            times,
            track.times_s,
            track.positions,
            track.quats_wxyz,
            rays,
        )
        movers = self._movers(body_times_s, moving_poses)
        hits = self._penetrate(rays, times, movers, bits)
        ranges, intensity = self._receive(rays, hits, normals, bits)
        return LidarScan(
            start_tick=start_tick,
            end_tick=end_tick,
            start_time_s=start_s,
            end_time_s=end_tick / tick_hz,
            directions=_frozen(nominal),
            ranges=_frozen(ranges),
            time_offsets=_frozen((times - start_s).astype(np.float32)),
            intensity=_frozen(intensity),
        )

    def _draw(self, start_tick: int, count: int) -> tuple[Float32, NDArray[np.uint32]]:
        """Four normal deviates (beam angle twice, range, signal) and 32 random bits a pulse."""
        rng = np.random.default_rng([self._seed, crc32(b"lidar"), start_tick])
        normals = rng.standard_normal((count, 4), dtype=np.float32)
        return normals, rng.integers(0, 2**32, size=count, dtype=np.uint32)

    def _movers(
        self, times_s: Array, poses: Mapping[str, MovingTrack]
    ) -> list[tuple[RayTarget, _Track]]:
        unknown = sorted(set(poses) - set(self._scene.moving))
        if unknown:
            raise ValueError(
                f"'{unknown[0]}' is not a moving body of the scene: name one of "
                f"{', '.join(sorted(self._scene.moving)) or 'none (the scene is static)'}"
            )
        movers = []
        for name, target in self._scene.moving.items():
            motion = poses.get(name, self._scene.rest_poses[name])
            if isinstance(motion, Pose):
                positions = motion.translation[None]
                quats = quat_wxyz_from_matrix(motion.rotation)[None]
                movers.append((target, _Track.of(times_s[:1], positions, quats)))
            else:
                movers.append((target, _Track.of(times_s, *motion)))
        return movers

    def _penetrate(
        self,
        rays: Float32,
        times: Array,
        movers: list[tuple[RayTarget, _Track]],
        bits: NDArray[np.uint32],
    ) -> Hits:
        """Nearest hits of (N, 6) world rays behind the porous surfaces that they pass."""
        porosity = self._scene.optics.porosity
        hits = self._cast(rays, times, movers)
        if not porosity.any():
            return hits
        passing = kernels.passing(hits.geom, hits.cosine, bits, porosity)
        for _ in range(_MOST_PASSES):
            if not passing.size:
                break
            travelled = hits.distance[passing] + np.float32(_STEP_BEHIND_M)
            onward = rays[passing]
            onward[:, :3] += travelled[:, None] * onward[:, 3:]
            behind = self._cast(onward, times[passing], movers)
            hits.distance[passing] = behind.distance + travelled
            hits.geom[passing] = behind.geom
            hits.cosine[passing] = behind.cosine
            again = kernels.passing(behind.geom, behind.cosine, bits[passing], porosity)
            passing = passing[again]
        hits.geom[passing] = -1
        return hits

    def _cast(self, rays: Float32, times: Array, movers: list[tuple[RayTarget, _Track]]) -> Hits:
        """Nearest hits over the static scene and every moving body."""
        if self._scene.static is not None:
            hits = self._scene.static.cast(rays)
        else:
            count = len(rays)
            hits = Hits(
                np.full(count, np.inf, dtype=np.float32),
                np.full(count, -1, dtype=np.int32),
                np.zeros(count, dtype=np.float32),
            )
        for target, track in movers:
            chosen, local = kernels.rays_near(
                rays,
                times,
                track.times_s,
                track.positions,
                track.quats_wxyz,
                track.positions + matrices_from_quats_wxyz(track.quats_wxyz) @ target.center,
                target.radius,
            )
            if not chosen.size:
                continue
            found = target.cast(local)
            nearer = found.distance < hits.distance[chosen]
            where = chosen[nearer]
            hits.distance[where] = found.distance[nearer]
            hits.geom[where] = found.geom[nearer]
            hits.cosine[where] = found.cosine[nearer]
        return hits

    def _receive(
        self, rays: Float32, hits: Hits, normals: Float32, bits: NDArray[np.uint32]
    ) -> tuple[Float32, NDArray[np.uint8]]:
        optics = self._scene.optics
        ranges = np.empty(len(rays), dtype=np.float32)
        intensity = np.empty(len(rays), dtype=np.uint8)
        kernels.receive(
            rays,
            hits.distance,
            hits.geom,
            hits.cosine,
            normals,
            bits,
            optics.reflectivity,
            optics.water,
            optics.ground_geom,
            optics.ground_origin_xy_m,
            optics.ground_cell_m,
            optics.ground_reflectivity,
            optics.ground_water,
            self._params.range_sigma_m,
            self._params.min_range_m,
            self._params.max_range_m,
            ranges,
            intensity,
        )
        return ranges, intensity

    @staticmethod
    def _check_track(times_s: Array, start_s: float, end_s: float) -> None:
        if len(times_s) == 0 or times_s[0] > start_s + 1e-9 or times_s[-1] < end_s - 1e-9:
            raise ValueError(
                f"the body track must cover the scan from {start_s:.4f} s to {end_s:.4f} s: "
                "give a pose at every tick, both ends included"
            )


def _lidar_track(
    times_s: Array, positions: Array, quats_wxyz: Array, body_from_lidar: Pose
) -> _Track:
    """World poses of the LIDAR from those of the body."""
    body = _Track.of(times_s, positions, quats_wxyz)
    levers = matrices_from_quats_wxyz(body.quats_wxyz) @ body_from_lidar.translation
    mount = quat_wxyz_from_matrix(body_from_lidar.rotation)
    return _Track(
        body.times_s, body.positions + levers, kernels.quat_products(body.quats_wxyz, mount)
    )


def _frozen(array: np.ndarray) -> np.ndarray:
    array.setflags(write=False)
    return array
