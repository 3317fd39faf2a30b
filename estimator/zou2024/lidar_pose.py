"""LIDAR positioning: features of a scan, Algorithm 1, and growth of the feature maps."""

from __future__ import annotations

import numpy as np

from touchdown.estimator.api import Zou2024Params
from touchdown.estimator.filtering.deskew import PlacedScan
from touchdown.estimator.filtering.error_state import Frame
from touchdown.estimator.filtering.inertial_filter import InertialFilter
from touchdown.estimator.filtering.information import lateral_strength
from touchdown.estimator.filtering.landmark_depth import RecentReturns
from touchdown.estimator.filtering.online_calibration import corrected_mount
from touchdown.estimator.typing import Array, Float32, Indices
from touchdown.estimator.zou2024.depth_field import scan_colour_smoothness
from touchdown.estimator.zou2024.feature_map import FeatureMap
from touchdown.estimator.zou2024.registration import (
    FeatureMaps,
    ScanFeatures,
    ScanPose,
    register_scan,
)
from touchdown.estimator.zou2024.relative_pose import update_with_scan
from touchdown.estimator.zou2024.smoothness import (
    FeaturePoints,
    fused_smoothness,
    lidar_smoothness,
    sort_out_features,
)
from touchdown.sim.api import CameraIntrinsics, LidarScan, SensorRig
from touchdown.sim.frames import Pose

_LASERS = 6
"""number of lasers of the Horizon, firing in turn"""
_LONGEST_GAP = 8
_TURN_SIGMA, _LATERAL_SIGMA_M = np.radians(0.5), 0.3
"""information floor of a scan, and of each clone's part of the map: errors of their points that do
not average out"""
_MIN_RETURNS = 200
_NONE = np.zeros(0, dtype=np.int64)


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
        beams_lidar[:, :2] / beams_lidar[:, 2:], cells=params.planar_cells,
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
                self._correct(features, height)
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

    def _correct(self, features: ScanFeatures, height_m: float) -> None:
        params, eskf = self._params, self._filter.eskf
        result = register_scan(
            features, self.maps, eskf.state.pose, self._filter.pose_information(),
            edge_sigma_m=params.edge_sigma_m, plane_sigma_m=params.plane_sigma_m,
            anchors=self.maps.anchors.frames(eskf.clones, eskf.state.calibration, _NONE),
        )  # fmt: skip
        if result is None:
            return
        floor = np.repeat([_TURN_SIGMA, _LATERAL_SIGMA_M], 3)
        floor[5] = params.scan_height_sigma_m
        share = params.scan_calibration_gain * (height_m >= params.calibrate_above_m)
        update_with_scan(
            self._filter.eskf, result, features.lever, self.maps.anchors,
            np.array([params.edge_sigma_m, params.plane_sigma_m]), floor, share,
        )  # fmt: skip
        self._filter.trail.follow(self._filter.eskf.state)
        self._report(result)

    def _report(self, result: ScanPose) -> None:
        strength = lateral_strength(result.information)
        self.diagnostics |= {
            "lidar_edges": float(result.edges),
            "lidar_planes": float(result.planes),
            "lidar_rms_m": result.rms_m,
            "lidar_converged": float(result.converged),
            "lidar_lateral_weakest": float(strength[0]),
            "lidar_weak_directions": float(result.weak.shape[1]),
            "map_edges": float(self.maps.edges.used),
            "map_planes": float(self.maps.planes.used),
        }
