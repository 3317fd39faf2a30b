"""LIDAR positioning: smoothness around each return, edge and planar points, Algorithm 1, and growth
of the feature maps.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from touchdown.estimator.api import Zou2024Params
from touchdown.estimator.filtering.deskew import PlacedScan
from touchdown.estimator.filtering.error_state import Frame
from touchdown.estimator.filtering.inertial_filter import InertialFilter
from touchdown.estimator.filtering.landmark_depth import RecentReturns
from touchdown.estimator.filtering.online_calibration import corrected_mount
from touchdown.estimator.zou2024.depth_field import scan_colour_smoothness
from touchdown.estimator.zou2024.feature_map import FeatureMap
from touchdown.estimator.zou2024.registration import (
    FeatureMaps,
    ScanFeatures,
    ScanPose,
    register_scan,
)
from touchdown.estimator.zou2024.relative_pose import update_with_scan
from touchdown.sim.api import CameraIntrinsics, LidarScan, SensorRig
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array, Float32, Indices, Mask

_REACH = 5
"""neighbours on each side along the track of one laser"""


@njit(cache=True)
def lidar_smoothness(
    points: Array, pulses: Indices, lasers: int, max_gap: int
) -> tuple[Array, Mask]:
    """Eq. 6: ``f_l = |sum_j (p_i - p_j)| / (|S| |p_i|)`` of (N, 3) points, seen from the sensor.

    ``pulses`` (N,): ascending number of each return's pulse in its scan; pulse k belongs to laser
    ``k mod lasers``, and S are the up to five returns before and five after on the same laser's
    track, none more than ``max_gap`` of its pulses away. The extraction lost the norm around the
    sum; it is that of Zhang and Singh's LOAM, which the paper cites. NaN where fewer than six
    neighbours exist.

    Also returns which points border on something nearer: an outline that moves with the viewpoint,
    no edge of the surface it lies on (N,).
    """
    count, reach = points.shape[0], max_gap * lasers
    scores = np.full(count, np.nan)
    shadowed = np.zeros(count, dtype=np.bool_)
    order, starts = _by_laser(pulses, lasers)
    x, y, z = points[:, 0][order], points[:, 1][order], points[:, 2][order]
    number, ranges = pulses[order], np.sqrt(x * x + y * y + z * z)
    for laser in range(lasers):
        first, end = starts[laser], starts[laser + 1]
        for at in range(first, end):
            tx, ty, tz, used, own = 0.0, 0.0, 0.0, 0, ranges[at]
            for j in range(max(at - _REACH, first), min(at + _REACH + 1, end)):
                if j == at or abs(number[j] - number[at]) > reach:
                    continue
                tx, ty, tz = tx + x[at] - x[j], ty + y[at] - y[j], tz + z[at] - z[j]
                used += 1
                if abs(j - at) == 1 and ranges[j] < 0.97 * own - 0.15:
                    shadowed[order[at]] = True
            if used >= 6:
                scores[order[at]] = np.sqrt(tx * tx + ty * ty + tz * tz) / (used * own)
    return scores, shadowed


@njit(cache=True)
def _by_laser(pulses: Indices, lasers: int) -> tuple[Indices, Indices]:
    """Indices (N,) of the returns, those of one laser after another, and where each one's start."""
    starts = np.zeros(lasers + 1, np.int64)
    for pulse in pulses:
        starts[pulse % lasers + 1] += 1
    starts = np.cumsum(starts)
    cursor, order = starts.copy(), np.empty(pulses.shape[0], np.int64)
    for i in range(pulses.shape[0]):
        order[cursor[pulses[i] % lasers]] = i
        cursor[pulses[i] % lasers] += 1
    return order, starts


def fused_smoothness(f_l: Array, f_c: Array, weight: float) -> Array:
    """Eq. 7: ``f_s = f_l + lambda f_c``. Where no image covers a return (``f_c`` NaN) there is
    nothing to fuse and ``f_s = f_l``."""
    return f_l + weight * np.where(np.isnan(f_c), 0.0, f_c)


@dataclass(frozen=True, slots=True)
class FeaturePoints:
    """Indices of the chosen returns."""

    edges: Indices
    planes: Indices


def sort_out_features(
    scores: Array,
    shadowed: Mask,
    directions: Array,
    *,
    cells: tuple[int, int],
    edges: int,
    edge_threshold: float,
) -> FeaturePoints:
    """Edge points (largest f_s) and planar points (smallest f_s), spread over the view.

    ``scores`` (N,) f_s, NaN to leave out; ``directions`` (N, 2) x / z and y / z in the sensor.
    The view is cut into ``cells`` (columns, rows); every cell gives its smallest score as planar
    and its largest as edge candidate; planar scores must lie below ``edge_threshold``, those of
    edges above it, and of these the ``edges`` largest stay. Returns in shadow are neither.
    """
    usable = np.flatnonzero(np.isfinite(scores) & ~shadowed)
    if len(usable) == 0:
        return FeaturePoints(usable, usable)
    planes, candidates = _extremes(scores, usable, directions, cells)
    planes = planes[scores[planes] <= edge_threshold]
    candidates = candidates[scores[candidates] > edge_threshold]
    strongest = np.argsort(-scores[candidates], kind="stable")[:edges]
    return FeaturePoints(np.sort(candidates[strongest]), np.sort(planes))


@njit(cache=True)
def _extremes(
    scores: Array, usable: Indices, directions: Array, cells: tuple[int, int]
) -> tuple[Indices, Indices]:
    """Of the ``usable`` returns, those with the smallest and the largest score of each sector."""
    low, high = directions[usable[0]].copy(), directions[usable[0]].copy()
    for i in usable:
        for a in range(2):
            low[a], high[a] = min(low[a], directions[i, a]), max(high[a], directions[i, a])
    columns, rows = cells
    scale_x, scale_y = columns / max(high[0] - low[0], 1e-9), rows / max(high[1] - low[1], 1e-9)
    minimum = np.full(columns * rows, -1, np.int64)
    maximum = minimum.copy()
    for i in usable:
        column = min(int((directions[i, 0] - low[0]) * scale_x), columns - 1)
        sector = min(int((directions[i, 1] - low[1]) * scale_y), rows - 1) * columns + column
        if minimum[sector] < 0 or scores[i] < scores[minimum[sector]]:
            minimum[sector] = i
        if maximum[sector] < 0 or scores[i] >= scores[maximum[sector]]:
            maximum[sector] = i
    return minimum[minimum >= 0], maximum[maximum >= 0]


_LASERS = 6
"""number of lasers of the Horizon, firing in turn"""
_LONGEST_GAP = 8
_TURN_SIGMA, _LATERAL_SIGMA_M = np.radians(0.5), 0.3
"""information floor of a scan, and of each clone's part of the map: errors of their points that do
not average out"""
_ALL_ROUND = 0.1
"""fraction of it for a LIDAR that looks all round: walls on all sides show the whole pose"""
_MIN_RETURNS = 200
_NONE = np.zeros(0, dtype=np.int64)


def sees_all_round(beams_lidar: Array | Float32) -> bool:
    """True if beams (N, 3) along the axes of the LIDAR do not all go its way."""
    return bool((beams_lidar[:, 2] <= 0.0).any())


def view_of(beams_lidar: Array) -> Array:
    """(N, 2) directions of beams (N, 3): x / z and y / z of a LIDAR that looks along z, azimuth and
    elevation of one that looks all round."""
    if not sees_all_round(beams_lidar):
        return beams_lidar[:, :2] / beams_lidar[:, 2:]
    level = np.hypot(beams_lidar[:, 0], beams_lidar[:, 1])
    azimuth = np.arctan2(beams_lidar[:, 1], beams_lidar[:, 0])
    return np.column_stack([azimuth, np.arctan2(beams_lidar[:, 2], level)])


def scan_features(
    beams: Array,
    beams_lidar: Array,
    points_camera: Array,
    pulses: Indices,
    energy: Float32 | None,
    camera: CameraIntrinsics,
    params: Zou2024Params,
) -> tuple[FeaturePoints, Array]:
    """Edge and planar points of a scan by Eqs. 6 to 8, and f_c (N,) of every return, NaN where no
    image covers it.

    ``beams`` (N, 3): from the sensor to each return; ``beams_lidar``: the same along the axes of
    the LIDAR; ``points_camera``: the returns in the camera's frame; ``pulses`` (N,): as
    ``lidar_smoothness`` takes them.
    """
    f_l, shadowed = lidar_smoothness(beams, pulses, _LASERS, _LONGEST_GAP)
    f_c = np.full(len(beams), np.nan)
    if energy is not None:
        f_c = scan_colour_smoothness(energy, points_camera, camera)
    features = sort_out_features(
        fused_smoothness(f_l, f_c, params.colour_weight), shadowed,
        view_of(beams_lidar), cells=params.planar_cells,
        edges=params.edge_points, edge_threshold=params.edge_threshold,
    )  # fmt: skip
    return features, f_c


class LidarPositioning:
    """Edge and planar maps, and the correction of the filter by each scan."""

    def __init__(
        self, rig: SensorRig, params: Zou2024Params, inertial: InertialFilter, recent: RecentReturns
    ) -> None:
        self._rig = rig
        self._params = params
        self._filter = inertial
        self._recent = recent
        self.maps = FeatureMaps(
            edges=FeatureMap(params.edge_voxel_m, params.map_voxels, reach=2),
            planes=FeatureMap(params.planar_voxel_m, params.map_voxels),
        )
        self._camera_from_imu = inertial.imu_from_camera.inverse()
        self.diagnostics: dict[str, float] = {}

    def take(self, scan: LidarScan, energy: Float32 | None, seen_from: Pose | None = None) -> bool:
        """Registers a scan that ends at the filter's time; ``energy``: of the image nearest in time
        or None; ``seen_from``: odom_from_imu of that image, None for that of the scan. False if the
        scan could not be used."""
        eskf = self._filter.eskf
        mount = corrected_mount(self._filter.imu_from_lidar, eskf.state.calibration)
        placed = self._filter.place_scan(scan, mount, check_blind_zone=True)
        if placed is None:
            return False
        points = placed.points
        self.diagnostics = {"scan_returns": float(len(points))}
        if len(points) >= _MIN_RETURNS:
            chosen = self._features(placed, energy, seen_from)
            features = ScanFeatures(points[chosen.edges], points[chosen.planes], mount.translation)
            if self._params.use_lidar_pose:
                height = float(np.median(scan.ranges[placed.pulses]))
                all_round = sees_all_round(scan.directions[placed.pulses])
                self._correct(features, height, _ALL_ROUND if all_round else 1.0)
            self.maps.insert(features, eskf)
        self._recent.add(points, Frame.of(eskf.state.pose))
        return True

    def _features(
        self, scan: PlacedScan, energy: Float32 | None, seen_from: Pose | None
    ) -> FeaturePoints:
        camera_from_imu = self._camera_from_imu
        if seen_from is not None:
            pose = self._filter.eskf.state.pose
            camera_from_imu = camera_from_imu @ seen_from.inverse() @ pose
        in_camera = camera_from_imu.apply(scan.points)
        in_lidar = scan.beams @ self._filter.imu_from_lidar.rotation
        return scan_features(
            scan.beams, in_lidar, in_camera, scan.pulses, energy, self._rig.camera, self._params
        )[0]

    def _correct(self, features: ScanFeatures, height_m: float, floored: float) -> None:
        params, eskf = self._params, self._filter.eskf
        result = register_scan(
            features, self.maps, eskf.state.pose, self._filter.pose_information(),
            edge_sigma_m=params.edge_sigma_m, plane_sigma_m=params.plane_sigma_m,
            anchors=self.maps.anchors.frames(eskf.clones, eskf.state.calibration, _NONE),
        )  # fmt: skip
        if result is None:
            return
        floor = floored * np.repeat([_TURN_SIGMA, _LATERAL_SIGMA_M], 3)
        floor[5] = params.scan_height_sigma_m
        fraction = params.scan_calibration_gain * (height_m >= params.calibrate_above_m)
        update_with_scan(
            self._filter.eskf, result, features.lever, self.maps.anchors,
            np.array([params.edge_sigma_m, params.plane_sigma_m]), floor, fraction,
        )  # fmt: skip
        self._filter.trail.follow(self._filter.eskf.state)
        self._report(result)

    def _report(self, result: ScanPose) -> None:
        self.diagnostics |= {
            "lidar_edges": float(result.edges),
            "lidar_planes": float(result.planes),
            "lidar_rms_m": result.rms_m,
            "lidar_converged": float(result.converged),
            "lidar_weak_directions": float(result.weak.shape[1]),
            "map_edges": float(self.maps.edges.used),
            "map_planes": float(self.maps.planes.used),
        }
