"""Poses that the filter has passed, and screening, deskewing and thinning of LIDAR scans."""

import copy
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from touchdown.estimator.api import PoseTrack
from touchdown.estimator.filtering.error_state import Frame
from touchdown.estimator.filtering.imu_propagation import NavState
from touchdown.estimator.filtering.vectors import along, turned, turned_back, xyz
from touchdown.sim.api import LidarScan, LidarSheet
from touchdown.sim.frames import (
    Pose,
    TimedPose,
    interpolate_pose,
    matrix_from_quat_wxyz,
    quat_wxyz_from_matrix,
)
from touchdown.sim.typing import Array, Float32, Indices

_STEPS = 128


class ScanPath(NamedTuple):
    """odom_from_imu at M >= 2 instants that span a scan."""

    times: Array  # (M,) s after the scan's start
    rotations: Array  # (M, 3, 3)
    positions: Array  # (M, 3) m
    now: int  # index of the filter's pose: that at the last IMU sample of the scan


class Trail:
    """odom_from_imu at the last IMU ticks: ``ticks`` (N,), ``rotations`` (N, 3, 3), ``positions``
    (N, 3)."""

    def __init__(self, state: NavState) -> None:
        self.ticks = np.array([state.tick], np.int64)
        self.rotations = state.rotation[None]
        self.positions = state.position[None]

    def extend(self, ticks: Array, rotations: Array, positions: Array) -> None:
        """Adds the poses passed by the newest propagation."""
        whole = ticks.astype(np.int64)
        self.ticks = np.concatenate([self.ticks, whole])[-_STEPS:]
        self.rotations = np.concatenate([self.rotations, rotations])[-_STEPS:]
        self.positions = np.concatenate([self.positions, positions])[-_STEPS:]

    def follow(self, state: NavState) -> None:
        """Moves the whole trail rigidly so that it ends at the filter's state."""
        rotation = state.rotation @ self.rotations[-1].T
        self.positions = (self.positions - self.positions[-1]) @ rotation.T + state.position
        self.rotations = rotation @ self.rotations

    def reaching(self, state: NavState) -> "Trail":
        """Returns the trail with one pose more, without changing it."""
        longer = copy.copy(self)
        longer.extend(np.array([state.tick]), state.rotation[None], state.position[None])
        return longer

    def start_of(self, scan: LidarScan, imu_ticks: int) -> int | None:
        """Returns the index of the last pose at or before the scan's start, if the trail ends at
        the scan's end or less than ``imu_ticks`` after it."""
        first = int(np.searchsorted(self.ticks, scan.start_tick, side="right")) - 1
        spans = 0 <= first < len(self.ticks) - 1
        return first if spans and 0 <= self.ticks[-1] - scan.end_tick < imu_ticks else None

    def track(self, first: int, imu_from_body: Pose, tick_hz: int) -> PoseTrack:
        """Returns the body's poses from index ``first`` on."""
        bodies = self.rotations[first:] @ imu_from_body.rotation
        return PoseTrack(
            times_s=self.ticks[first:] / tick_hz,
            positions_odom=self.positions[first:]
            + self.rotations[first:] @ imu_from_body.translation,
            quats_wxyz=np.array([quat_wxyz_from_matrix(rotation) for rotation in bodies]),
        )

    def pose_at(self, tick: int) -> Pose:
        """odom_from_imu at ``tick``, as far as the trail reaches."""
        at = float(np.interp(tick, self.ticks, np.arange(len(self.ticks))))
        first = min(int(at), max(len(self.ticks) - 2, 0))
        last = min(first + 1, len(self.ticks) - 1)
        ends = [Pose(self.rotations[k], self.positions[k]) for k in (first, last)]
        return interpolate_pose(ends[0], ends[1], at - first)


_BLIND_SIGMAS = 4.0
_BLIND_FRACTION = 0.05
_W, _X, _Y, _Z = range(4)
"""components of a quaternion"""
_KNOT_EVERY = 64


class Track(NamedTuple):
    """Timed poses of a body, M >= 2, ascending."""

    times: Array  # (M,) s
    positions: Array  # (M, 3) m
    quats_wxyz: Array  # (M, 4)

    @classmethod
    def of(cls, track: PoseTrack) -> "Track":
        """The track of an estimator, as the kernel takes it."""
        parts = track.times_s, track.positions_odom, track.quats_wxyz
        return cls(*(np.ascontiguousarray(part, np.float64) for part in parts))


def track_of(poses: list[TimedPose]) -> PoseTrack:
    """The track through two poses or more."""
    return PoseTrack(
        times_s=np.array([entry.time_s for entry in poses]),
        positions_odom=np.array([entry.pose.translation for entry in poses]),
        quats_wxyz=np.array([quat_wxyz_from_matrix(entry.pose.rotation) for entry in poses]),
    )


def pose_on(track: PoseTrack, time_s: float) -> Pose:
    """The pose at ``time_s`` on a track; its ends hold beyond it."""
    index = int(np.clip(np.searchsorted(track.times_s, time_s) - 1, 0, track.times_s.size - 2))
    span = track.times_s[index + 1] - track.times_s[index]
    first, second = (
        Pose(matrix_from_quat_wxyz(track.quats_wxyz[k]), track.positions_odom[k])
        for k in (index, index + 1)
    )
    fraction = float(np.clip((time_s - track.times_s[index]) / span, 0.0, 1.0))
    return interpolate_pose(first, second, fraction)


@dataclass(frozen=True, slots=True)
class PlacedScan:
    """Valid returns of one scan in the IMU frame at the last IMU sample of the scan."""

    points: Array
    """(K, 3) m"""
    beams: Array
    """(K, 3) m, from the sensor to the point"""
    pulses: Indices
    """(K,) indices of the pulses in the scan, ascending"""

    def __len__(self) -> int:
        return len(self.points)

    def select(self, chosen: Indices) -> "PlacedScan":
        """Returns the subset with the given indices."""
        return PlacedScan(self.points[chosen], self.beams[chosen], self.pulses[chosen])


def screen_scan(scan: LidarScan, lidar: LidarSheet, *, check_blind_zone: bool = False) -> Indices:
    """Returns the indices (K,) of the pulses with a valid return: a finite range between
    ``min_range_m`` and ``max_range_m`` and a time within the scan.

    ``check_blind_zone``: returns no pulses if more than a twentieth of the ranges lie within four
    standard deviations of ``min_range_m``. There the sensor reports too long a range for some
    pulses and none for others, and a map started from such a scan lies too low.
    """
    within = (scan.ranges >= lidar.min_range_m) & (scan.ranges <= lidar.max_range_m)
    pulses = np.flatnonzero(within & (scan.time_offsets >= 0.0))  # false for NaN
    if check_blind_zone and len(pulses):
        blind = lidar.min_range_m + _BLIND_SIGMAS * lidar.range_sigma_m
        if np.count_nonzero(scan.ranges[pulses] < blind) > _BLIND_FRACTION * len(pulses):
            return pulses[:0]
    return pulses


def place_scan(
    scan: LidarScan, pulses: Indices, imu_from_lidar: Pose, path: ScanPath
) -> PlacedScan:
    """Deskews the given ``pulses`` (K,) of a scan into the IMU frame at ``path.now``."""
    turn, place = path.rotations[path.now].T, path.positions[path.now]
    quats = np.array([quat_wxyz_from_matrix(rotation) for rotation in turn @ path.rotations])
    track = Track(path.times, (path.positions - place) @ turn.T, quats)
    origins, beams = _deskewed(scan, pulses, 0.0, track, imu_from_lidar)
    return PlacedScan(origins + beams, beams, pulses)


def deskewed_points(
    scan: LidarScan, pulses: Indices, track: PoseTrack, body_from_lidar: Pose
) -> Array:
    """Returns the returns of the given ``pulses`` (K,) of a scan, (K, 3), in the frame of the track
    of the body."""
    origins, beams = _deskewed(scan, pulses, scan.start_time_s, Track.of(track), body_from_lidar)
    return origins + beams


def _deskewed(
    scan: LidarScan, pulses: Indices, start_time: float, track: Track, mount: Pose
) -> tuple[Float32, Array]:
    """Origins, and beams as long as their ranges, of the given pulses."""
    aims, offsets = scan.directions[pulses], scan.time_offsets[pulses]
    for part in (aims, offsets):  # as those of messages are, for which `deskew` is compiled
        part.setflags(write=False)
    origins, directions = deskew(aims, offsets, start_time, track, Frame.of(mount))
    return origins, (scan.ranges[pulses, None] * directions).astype(np.float64)


@njit(cache=True, error_model="numpy")
def _lerp_pose(track: Track, index: int, time: float, mount: Frame) -> tuple[int, Frame]:
    """Returns the entry of the track before ``time``, from ``index`` on, and the pose then of what
    sits at ``mount`` on the body: straight line and normalised quaternion lerp."""
    times, positions, quats = track
    while index < times.shape[0] - 2 and times[index + 1] < time:
        index += 1
    span = times[index + 1] - times[index]
    f = 0.0 if span <= 0.0 else (time - times[index]) / span
    f = min(max(f, 0.0), 1.0)
    start = xyz(positions[index])
    place = along(start, f, along(xyz(positions[index + 1]), -1.0, start))
    dot = 0.0
    for k in range(4):
        dot += quats[index, k] * quats[index + 1, k]
    g = f if dot >= 0.0 else -f
    w = (1.0 - f) * quats[index, _W] + g * quats[index + 1, _W]
    x = (1.0 - f) * quats[index, _X] + g * quats[index + 1, _X]
    y = (1.0 - f) * quats[index, _Y] + g * quats[index + 1, _Y]
    z = (1.0 - f) * quats[index, _Z] + g * quats[index + 1, _Z]
    s = 2.0 / (w * w + x * x + y * y + z * z)
    r, mounted = np.empty((3, 3)), np.empty((3, 3))
    r[0, 0], r[0, 1], r[0, 2] = 1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)
    r[1, 0], r[1, 1], r[1, 2] = s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x)
    r[2, 0], r[2, 1], r[2, 2] = s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y)
    for k in range(3):
        mounted[k, 0], mounted[k, 1], mounted[k, 2] = turned_back(mount.rotation, xyz(r[k]))
    return index, Frame(mounted, np.array(along(place, 1.0, turned(r, xyz(mount.translation)))))


@njit(cache=True, error_model="numpy")
def deskew(
    directions: Float32, time_offsets: Float32, start_time: float, track: Track, mount: Frame
) -> tuple[Float32, Float32]:
    """Returns origin and direction of every pulse, (N, 3) float32, in the frame of the ``track``,
    from the pose of its own instant.

    ``directions`` (N, 3) float32, LIDAR frame; ``time_offsets`` (N,) float32 seconds, ascending;
    ``mount``: of the LIDAR on the body. Times outside the track take its nearest end.
    """
    # Exact poses at knots, with the mount in them; between two, a quarter of a millisecond apart,
    # straight lines differ from the turn by less than 1e-6 even at 10 rad/s.
    origins, beams = np.empty_like(directions), np.empty_like(directions)
    count = directions.shape[0]
    if count == 0:
        return origins, beams
    index, second = _lerp_pose(track, 0, start_time + time_offsets[0], mount)
    for knot in range(0, count, _KNOT_EVERY):
        end, first = min(knot + _KNOT_EVERY, count - 1), second
        index, second = _lerp_pose(track, index, start_time + time_offsets[end], mount)
        span = time_offsets[end] - time_offsets[knot]
        per_span = 1.0 / span if span > 0.0 else 0.0
        r, q = first.rotation, second.rotation
        for i in range(knot, min(knot + _KNOT_EVERY, count)):
            f = (time_offsets[i] - time_offsets[knot]) * per_span
            dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
            for k in range(3):
                start = first.translation[k]
                origins[i, k] = start + f * (second.translation[k] - start)
                r0 = r[k, 0] + f * (q[k, 0] - r[k, 0])
                r1 = r[k, 1] + f * (q[k, 1] - r[k, 1])
                r2 = r[k, 2] + f * (q[k, 2] - r[k, 2])
                beams[i, k] = r0 * dx + r1 * dy + r2 * dz
    return origins, beams


@njit(cache=True, error_model="numpy")
def moved(points: Array, chosen: Indices, frame: Frame) -> Array:
    """Returns the ``chosen`` (K,) of (N, 3) points, rotated and translated, (K, 3)."""
    out = np.empty((chosen.shape[0], 3))
    for k in range(chosen.shape[0]):
        x, y, z = points[chosen[k], 0], points[chosen[k], 1], points[chosen[k], 2]
        for a in range(3):
            r = frame.rotation[a]
            out[k, a] = r[0] * x + r[1] * y + r[2] * z + frame.translation[a]
    return out


@njit(cache=True, error_model="numpy")
def thin_out(points: Array, cell: float, table_bits: int) -> Indices:
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
