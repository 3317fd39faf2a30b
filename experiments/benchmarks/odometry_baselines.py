"""Reference implementations of LIDAR odometry on logged scans: KISS-ICP and small_gicp.

Both run over a grid of settings, receive the scans alone and start at the true pose of their first
scan. A constant-velocity model predicts and, with ``deskew``, corrects each scan by the times of
its points; the pose is then that of the end of the scan, else that of its middle.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.errors import UsageError
from touchdown.sim.frames import Pose, so3_log

Array = NDArray[np.float64]

LOST_M = 10.0
"""Distance from the truth at which a run ends as lost."""

GRIDS: dict[str, dict[str, tuple[Any, ...]]] = {
    "kiss_icp": {
        "voxel_m": (0.5, 1.0, 2.0),
        "initial_threshold_m": (0.5, 2.0),
        "deskew": (True, False),
        "start": ("lift-off", "survey"),
    },
    "small_gicp": {
        "downsampling_m": (0.25, 0.5, 1.0),
        "voxel_m": (0.5, 1.0, 2.0),
        "deskew": (True, False),
        "start": ("lift-off", "survey"),
    },
}
"""Settings of each method, of which all combinations run. ``start``: begin of the odometry, from
which its errors count, so that a method that cannot follow the climb is not judged by it. All other
settings are the defaults of the packages."""

MAP_SCANS = 1000
"""Scans after which the map of small_gicp drops an untouched voxel: more than a survey has, so that
revisited ground is still in it."""
_MAX_ITERATIONS = 100
"""Iterations of KISS-ICP per scan. Its default is 500, which only scans reach that do not
converge."""
_MIN_RETURNS, _MIN_POINTS = 100, 20
"""Least points of a usable scan, before and after downsampling: near the ground there are few."""


@dataclass(frozen=True, slots=True)
class ScanPoints:
    """The returns of one scan: (N, 3) float32 metres, LIDAR frame; (N,) float32 fraction of the
    scan's span, 0 to 1; and its span in seconds."""

    points: NDArray[np.float32]
    fractions: NDArray[np.float32]
    start_s: float
    end_s: float


@dataclass(slots=True)
class OdometryTrack:
    """Result of a method with one setting: times (N,) s and positions (N, 3) of the body, world."""

    method: str
    setting: dict[str, Any]
    times_s: list[float] = field(default_factory=list)
    positions: list[Array] = field(default_factory=list)
    cpu_s: float = 0.0
    data_s: float = 0.0
    """duration of the scans that took ``cpu_s``"""
    lost_s: float | None = None
    """time at which it was lost"""


def require_references() -> None:
    """Raises UsageError unless the packages are installed."""
    try:
        import kiss_icp  # noqa: F401
        import small_gicp  # noqa: F401
    except ImportError as error:
        raise UsageError(
            f"{error.name} is not installed; pip install -c constraints.txt -e '.[bench]' "
            "installs what the comparison needs"
        ) from error


def settings(method: str) -> Iterator[dict[str, Any]]:
    """Yields all combinations of a method's grid."""
    grid = GRIDS[method]
    for values in itertools.product(*grid.values()):
        yield dict(zip(grid, values, strict=True))


class KissIcp:
    """KISS-ICP (Vizzo et al. 2023), one thread."""

    def __init__(self, voxel_m: float, initial_threshold_m: float, deskew: bool) -> None:
        from kiss_icp.config import KISSConfig
        from kiss_icp.kiss_icp import KissICP

        config = KISSConfig()
        config.data.deskew = deskew
        config.mapping.voxel_size = voxel_m
        config.registration.max_num_threads = 1
        config.registration.max_num_iterations = _MAX_ITERATIONS
        config.adaptive_threshold.initial_threshold = initial_threshold_m
        self._odometry = KissICP(config)

    def register(self, points: Array, fractions: Array) -> Array:
        # It divides by the span of the times, and aborts where that is 0.
        self._odometry.register_frame(points, fractions if np.ptp(fractions) > 0.0 else np.zeros(0))
        return np.asarray(self._odometry.last_pose)


class SmallGicp:
    """Scan-to-map VGICP of small_gicp (Koide 2024), one thread: each scan against a map of
    Gaussian voxels."""

    def __init__(self, downsampling_m: float, voxel_m: float, deskew: bool) -> None:
        import small_gicp

        self._lib = small_gicp
        self._downsampling, self._deskew = downsampling_m, deskew
        self._map = small_gicp.GaussianVoxelMap(voxel_m)
        self._map.set_lru(horizon=MAP_SCANS, clear_cycle=10)
        self._pose, self._step = np.eye(4), np.eye(4)

    def register(self, points: Array, fractions: Array) -> Array:
        if self._deskew:
            points = deskew_by_step(points, fractions, self._step)
        cloud = self._lib.voxelgrid_sampling(points, self._downsampling, num_threads=1)
        if cloud.size() < _MIN_POINTS:
            self._pose = self._pose @ self._step
            return self._pose
        self._lib.estimate_covariances(cloud, num_neighbors=10, num_threads=1)
        if self._map.size():
            guess = self._pose @ self._step
            found = self._lib.align(self._map, cloud, guess, num_threads=1)
            pose = np.asarray(found.T_target_source)
            self._step = np.linalg.inv(self._pose) @ pose
            self._pose = pose
        self._map.insert(cloud, self._pose)
        return self._pose


ODOMETRY: dict[str, Callable[..., KissIcp | SmallGicp]] = {
    "kiss_icp": KissIcp, "small_gicp": SmallGicp,
}  # fmt: skip
"""Methods whose ``register`` takes points (N, 3) with times (N,) in 0 to 1 and returns the (4, 4)
pose of a scan in the frame of the first one."""


def deskew_by_step(points: Array, fractions: Array, step: Array) -> Array:
    """(N, 3) points in the frame at the end of the scan, for the motion ``step`` (4, 4,
    previous_from_this scan) at constant velocity; small angles."""
    missing = (fractions - 1.0)[:, None]
    rotation = so3_log(step[:3, :3])
    return np.asarray(points + missing * (step[:3, 3] + np.cross(rotation, points)))


def run_reference(
    method: str,
    setting: dict[str, Any],
    scans: Sequence[ScanPoints],
    true_pose: Callable[[float], Pose],
    body_from_lidar: Pose,
    survey_s: float,
) -> OdometryTrack:
    """Runs one setting over scans from lift-off on.

    ``true_pose(time_s)``: ``world_from_body``, for the start and the distance at which the run is
    lost. ``survey_s``: begin of the survey.
    """
    track = OdometryTrack(method, setting)
    own = {name: value for name, value in setting.items() if name != "start"}
    odometry = ODOMETRY[method](**own)
    lidar_from_body = body_from_lidar.inverse()
    world_from_first: Pose | None = None
    for scan in scans:
        time_s = scan.end_s if setting["deskew"] else 0.5 * (scan.start_s + scan.end_s)
        true = true_pose(time_s)
        if world_from_first is None:
            early = setting["start"] == "survey" and scan.start_s < survey_s
            if early or len(scan.points) < _MIN_RETURNS:
                continue
            world_from_first = true @ body_from_lidar
        points, fractions = scan.points.astype(np.float64), scan.fractions.astype(np.float64)
        began = time.process_time()
        pose = odometry.register(points, fractions)
        track.cpu_s += time.process_time() - began
        track.data_s += scan.end_s - scan.start_s
        first_from_scan = Pose(pose[:3, :3], pose[:3, 3])
        estimated = world_from_first @ first_from_scan @ lidar_from_body
        track.times_s.append(time_s)
        track.positions.append(estimated.translation)
        if not np.linalg.norm(estimated.translation - true.translation) <= LOST_M:
            track.lost_s = time_s
            break
    return track
