"""Interface of the estimators: estimates, maps, protocols and parameters.

Loads with numpy alone, so that an external estimator can be written against it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from touchdown.sim.api import FORBID_EXTRA, CameraIntrinsics, Observation, SensorNeeds
from touchdown.sim.frames import Pose

Array = NDArray[np.float64]

LEAST_CONTRAST = 2.5
"""standard deviation of each channel's levels below which an image holds noise only"""


def some_pixels(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Returns a subsample of an image (H, W, 3) for `image_defect`, a copy."""
    return np.ascontiguousarray(rgb[::8, ::8])


def image_defect(pixels: NDArray[np.uint8], before: NDArray[np.uint8]) -> str:
    """Returns the defect of an image, from its pixels (h, w, 3) and those of the image ``before``;
    "" if there is none. Noise makes identical images impossible."""
    channels = np.ascontiguousarray(pixels.reshape(-1, 3).T)  # in a row each, a third of the time
    if float(channels.std(axis=1).max()) < LEAST_CONTRAST:
        return "no contrast"
    return "the same as the one before" if np.array_equal(pixels, before) else ""


@dataclass(frozen=True, kw_only=True, slots=True)
class PoseTrack:
    """Odometry poses over a span of time, for deskewing a scan."""

    times_s: Array
    """(N,) strictly ascending"""
    positions_odom: Array
    """(N, 3) of the body origin, odom frame"""
    quats_wxyz: Array
    """(N, 4) odom_from_body"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Estimate:
    """State estimate at ``time_s``: the time of the newest observation, reached by IMU propagation
    from the newest scan or image.

    Control uses ``odom_from_body``, which never jumps; ``world_from_odom`` moves at a bounded rate
    when loop closures correct the past. ``world_from_body`` composes both.
    """

    tick: int
    time_s: float
    odom_from_body: Pose
    world_from_odom: Pose
    velocity_odom: Array
    """(3,) m/s"""
    angular_velocity_body: Array
    """(3,) rad/s, bias removed"""
    acceleration_odom: Array
    """(3,) m/s^2, gravity removed"""
    position_covariance: Array
    """(3, 3) m^2, world frame"""
    rotation_covariance: Array
    """(3, 3) rad^2, body frame"""
    healthy: bool = True
    scan_track: PoseTrack | None = None
    """Best poses that span the scans in this observation, if the estimator provides them; otherwise
    the mapper interpolates the causal estimates."""
    diagnostics: Mapping[str, float] = field(default_factory=dict)
    """Named scalars for the recording (features tracked, residuals, degenerate directions...)."""
    events: tuple[str, ...] = ()
    """Messages about the time since the last update: a rejected message and the reason, a sensor
    dropout, a degenerate direction."""

    @property
    def world_from_body(self) -> Pose:
        """Pose of the body in the world frame."""
        return self.world_from_odom @ self.odom_from_body


class Estimator(Protocol):
    """``update`` is called once a control step with the arrived messages; it must be deterministic
    and must not modify its input."""

    needs: SensorNeeds

    def update(self, obs: Observation) -> Estimate: ...


@dataclass(frozen=True, kw_only=True, slots=True)
class GridMap:
    """A square-celled elevation map in the ODOM frame. Cell (row, col) covers
    ``x in [x0 + col*c, x0 + (col+1)*c), y in [y0 + row*c, y0 + (row+1)*c)``. Unseen cells: count 0
    and NaN heights. All arrays (rows, cols[, 3]); they are the mapper's own: read, never write.
    """

    origin_xy_m: Array
    """(2,) lower left corner x0, y0"""
    cell_m: float
    count: NDArray[np.float32]
    """returns that fell into the cell (recent ones weigh more)"""
    height_m: NDArray[np.float32]
    """mean height of the returns"""
    height_std_m: NDArray[np.float32]
    min_height_m: NDArray[np.float32]
    max_height_m: NDArray[np.float32]
    rgb: NDArray[np.float32]
    """0..255; NaN where no image ever covered a return"""
    intensity: NDArray[np.float32]
    """mean LIDAR intensity 0..255"""
    missing: NDArray[np.float32]
    """pulses without return that were expected to hit this cell, at the height of its
    surroundings"""
    last_seen_s: NDArray[np.float32]


@dataclass(frozen=True, kw_only=True, slots=True)
class MapView:
    """The mapper's state as views without copies. ``version`` increases with every scan integrated.
    ``fine`` covers a window below the vehicle at low height; None above it."""

    version: int
    coarse: GridMap
    fine: GridMap | None


class Mapper(Protocol):
    """``update`` is called once a control step with the arrived messages and the estimate."""

    needs: SensorNeeds

    def update(self, obs: Observation, estimate: Estimate) -> MapView: ...


@dataclass(frozen=True, kw_only=True, slots=True)
class Chessboard:
    """A chessboard on a plate. Its frame: origin in the middle, x along the columns, y down the
    rows, z away from the viewer."""

    columns: int = 11
    """inner corners along x"""
    rows: int = 8
    """inner corners along y; one count is odd and one even, so that the orientation is
    unambiguous"""
    square_m: float = 0.09
    margin_m: float = 0.06
    """white rim of the plate around the squares"""

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the plate."""
        return (
            (self.columns + 1) * self.square_m + 2.0 * self.margin_m,
            (self.rows + 1) * self.square_m + 2.0 * self.margin_m,
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class CalibrationView:
    """One placement of the board, seen by camera and LIDAR."""

    rgb: NDArray[np.uint8]
    """(H, W, 3)"""
    points: Array
    """(N, 3) returns in the LIDAR frame, metres"""


@dataclass(frozen=True, kw_only=True, slots=True)
class CalibrationResult:
    """Intrinsics and extrinsics from chessboards. Covariances follow from the normal equations;
    that of the extrinsics includes the errors of the camera's planes."""

    camera: CameraIntrinsics
    camera_covariance: Array
    """(9, 9) of fx, fy, cx, cy (pixels), k1, k2, p1, p2, k3"""
    camera_from_lidar: Pose
    extrinsic_covariance: Array
    """(6, 6) of a small rotation (rad) applied on the left, then of the translation (m)"""
    reprojection_rms_px: float
    plane_rms_m: float
    """of the board's LIDAR points about the camera's planes"""
    used: tuple[int, ...]
    """indices of the views that were used"""
    refused: Mapping[int, str]
    """reasons for rejecting the other views"""
    corners: Mapping[int, Array]
    """(rows * columns, 2) pixels of the views whose board the camera found"""
    board_points: Mapping[int, Array]
    """(N, 3) means of the returns from the board in cells of 5 cm, LIDAR frame, of the views that
    were used"""


# ------------------------------------------------------------------------------- parameters


@dataclass(frozen=True, kw_only=True, slots=True)
class MapperParams:
    """Bounded memory: the grids' extents and cells set it, not the flight's duration."""

    __pydantic_config__ = FORBID_EXTRA

    enabled: bool = True
    """false: no map, and no LIDAR unless the estimator needs it; for surveys only"""
    cell_m: float = 0.2
    extent_m: float = 160.0
    """side of the square coarse grid, centred on the take-off spot"""
    fine_cell_m: float = 0.05
    fine_extent_m: float = 24.0
    fine_below_m: float = 14.0
    """height above ground below which the fine grid is filled"""
    fine_recentre_m: float = 6.0
    """the fine window follows once the vehicle is this far from its centre"""
    count_cap: float = 200.0
    """effective number of returns per cell; older ones fade"""
    extreme_memory_s: float = 60.0
    """time constant with which unconfirmed extremes decay"""
    missing_min_reach_m: float = 1.5
    missing_max_reach_m: float = 60.0
    """a pulse without return counts as missing only where the ground is expected within these"""


@dataclass(frozen=True, kw_only=True, slots=True)
class LivoParams:
    """LIDAR-inertial-visual odometry (``estimator/livo/estimator.py``)."""

    __pydantic_config__ = FORBID_EXTRA

    camera_hz: int = 10
    voxel_m: float = 1.0
    """side of the plane map's voxels"""
    map_voxels: int = 131072
    """capacity of the plane map, a power of two; it never grows"""
    voxel_points: int = 150
    """a voxel ignores further returns after so many: the oldest carry the least drift"""
    scan_points: int = 2000
    """returns of a scan that are matched, spread evenly"""
    scan_tilt_sigma_deg: float = 1.0
    """information floor: errors of a scan as a whole, beside those of its points and of the
    keyframes that the map is anchored to"""
    scan_height_sigma_m: float = 0.01
    scan_lateral_sigma_m: float = 0.3
    scan_yaw_sigma_deg: float = 0.5
    anchor_height_m: float = 0.004
    """height error shared by all planes and landmarks of a keyframe"""
    depth_sigma_m: float = 0.02
    """of a landmark along its ray"""
    use_lidar: bool = True
    """scans correct the pose; if false, they still give depth to features"""
    use_vision: bool = True
    """images correct the pose"""
    use_closures: bool = True
    """images are tracked from keyframes older than the last few: those of neighbouring strips and
    of revisited ground"""
    loose: bool = False
    """loose coupling: each sensor measures the pose against a map without errors; if false, pose
    and map are estimated jointly"""
    use_calibration: bool = True
    """the LIDAR's mount, the lens and the camera's clock are estimated online"""
    calibrate_above_m: float = 15.0
    """height above ground from which mount and lens are estimated; lower, the range noise is a
    large share of a depth, and its effect on a keyframe would be attributed to the calibration"""
    mount_turn_sigma_deg: float = 0.03
    """prior of the calibration errors: LIDAR relative to camera and IMU"""
    mount_shift_sigma_m: float = 0.003
    focal_sigma: float = 5e-4
    center_sigma_px: float = 0.1
    camera_clock_sigma_s: float = 0.005
    """prior of the offset of the camera's clock from the IMU's; 0: no offset"""
    use_degeneracy: bool = True
    """scans do not correct degenerate directions, such as lateral motion over level ground"""
    weak_sigma_m: float = 0.1
    """a direction with a larger standard deviation than this counts as degenerate"""
    weak_sigma_deg: float = 0.3
    """the same for rotation"""
    keyframes: int = 40
    """capacity; beyond it the most redundant one is marginalised"""
    track_keyframes: int = 3
    """keyframes that each image is tracked from"""
    features: int = 220
    """corners of a keyframe"""
    pixel_sigma: float = 0.3
    """standard deviation of a tracked corner, its landmark's error included"""
    correction_time_s: float = 0.15
    """a correction of the filter reaches control over this time"""


@dataclass(frozen=True, kw_only=True, slots=True)
class PaperParams:
    """LIDAR-camera positioning of Zou, Sun and Kong 2024 (``estimator/paper``)."""

    __pydantic_config__ = FORBID_EXTRA

    camera_hz: int = 10
    edge_model: str = "shipped"
    """``shipped``, the path of a structured edge model for OpenCV, or ``gradient`` for edges from
    colour gradients"""
    use_lidar_pose: bool = True
    """scans correct the pose (Algorithm 1)"""
    use_camera_pose: bool = True
    """images correct the pose (PnP)"""
    use_colour_smoothness: bool = True
    """f_c contributes to the choice of edge and planar points (Eq. 7)"""
    use_bundle: bool = True
    """bundle adjustment of the newest keyframes"""
    use_closures: bool = True
    """loop closures correct the map"""
    colour_weight: float = 0.012
    """lambda of Eq. 7"""
    edge_threshold: float = 0.006
    """f_s above which a return may be an edge point, below which a planar one"""
    edge_points: int = 400
    planar_cells: tuple[int, int] = (56, 28)
    """columns and rows of the view's sectors; each gives one planar point"""
    edge_voxel_m: float = 0.3
    planar_voxel_m: float = 0.6
    map_voxels: int = 131072
    """capacity of each feature map, a power of two; it never grows"""
    edge_sigma_m: float = 0.15
    plane_sigma_m: float = 0.04
    keyframe_distance_m: float = 2.0
    keyframe_period_s: float = 0.5
    """images further apart than either are matched to the map"""
    sift_features: int = 350
    brisk_features: int = 300
    sift_sigma_px: float = 1.0
    brisk_sigma_px: float = 0.8
    max_keyframes: int = 160
    bundle_keyframes: int = 8
    depth_sigma_m: float = 0.05
    """of a landmark's depth by Eq. 12"""
    recent_keyframes: int = 12
    """newest keyframes, whose landmarks give the odometry"""
    correction_time_s: float = 0.15
    """a correction of the filter reaches control over this time"""
    closure_speed_mps: float = 0.1
    """fastest motion of the odometry frame when closures correct the past"""
    closure_rate_deg_s: float = 0.5


@dataclass(frozen=True, kw_only=True, slots=True)
class GpsEstimatorParams:
    """GPS, IMU, magnetometer and barometer (``estimator/baselines/gps.py``)."""

    __pydantic_config__ = FORBID_EXTRA

    follow_period_s: float = 0.3
    """time constant with which the position follows the fixes"""
    heading_sigma_deg: float = 5.0
    """of one reading of the magnetometer, ten a second"""
    baro_sigma_m: float = 0.5
    """of one reading of the barometer, its drift included"""
    correction_time_s: float = 0.15
    """a correction of the filter reaches control over this time"""


@dataclass(frozen=True, kw_only=True, slots=True)
class OpticalFlowParams:
    """Optical flow, rangefinder, IMU, magnetometer and barometer
    (``estimator/baselines/optical_flow.py``)."""

    __pydantic_config__ = FORBID_EXTRA

    camera_hz: int = 10
    features: int = 60
    """corners of an image"""
    window_pixels: int = 64
    """side of the central part of the image that they are taken from"""
    pixel_sigma: float = 0.3
    """of the flow of one corner"""
    floor_sigma_m: float = 0.01
    """error floor of a displacement, however many corners it is made of"""
    scale_sigma: float = 0.05
    """the same as a share of the displacement, for ground that is not level"""
    ground_memory_s: float = 0.2
    """time constant of the ground's height below the rangefinder"""
    heading_sigma_deg: float = 2.0
    """of one reading of the magnetometer, ten a second"""
    baro_sigma_m: float = 0.5
    """of one reading of the barometer, its drift included"""
    drift_share: float = 0.005
    """standard deviation that each metre flown adds to the filter's own"""
    correction_time_s: float = 0.15
    """a correction of the filter reaches control over this time"""


@dataclass(frozen=True, kw_only=True, slots=True)
class HybridFlowParams:
    """Dense optical flow and phase correlation with GPS
    (``estimator/baselines/hybrid_flow.py``)."""

    __pydantic_config__ = FORBID_EXTRA

    camera_hz: int = 10
    side_pixels: int = 256
    """of the levelled image, a power of two"""
    pixel_sigma: float = 0.3
    """of one flow vector of the levelled image"""
    floor_sigma_m: float = 0.01
    """error floor of a displacement, however many vectors it is made of"""
    scale_sigma: float = 0.05
    """the same as a share of the displacement, for ground that is not level"""
    ground_memory_s: float = 0.5
    """time constant of the ground's height below the rangefinder"""
    heading_sigma_deg: float = 5.0
    """of one reading of the magnetometer, ten a second"""
    baro_sigma_m: float = 0.5
    """of one reading of the barometer, its drift included"""
    wander_period_s: float = 60.0
    """correlation time of the receiver's error"""
    drift_density: float = 0.03
    """m/sqrt(s): random walk of the odometry, from which the receiver's error is separated"""
    correction_time_s: float = 0.15
    """a correction of the filter reaches control over this time"""


@dataclass(frozen=True, kw_only=True, slots=True)
class StereoParams:
    """Visual odometry on the stereo pair and the IMU (``estimator/baselines/stereo.py``)."""

    __pydantic_config__ = FORBID_EXTRA

    camera_hz: int = 10
    features: int = 220
    """corners of a keyframe"""
    pixel_sigma: float = 1.5
    """of a corner tracked from the keyframe, the error of its depth included"""
    disparity_sigma: float = 0.15
    """pixels, of one corner"""
    track_sigma: float = 1.0
    """pixels, of a corner tracked from the keyframe, in the update of its depth by parallax"""
    keyframe_share: float = 0.55
    """of a keyframe's corners: with fewer in view a new one is made"""
    disparity_floor_sigma: float = 0.02
    """pixels, error shared by all disparities of a pair"""
    relief_sigma_m: float = 2.0
    """standard deviation of the heights of objects on the ground"""
    ground_density: float = 0.3
    """m/sqrt(s): random walk of the mean height of the ground in view"""
    drift_share: float = 0.003
    """standard deviation that each metre flown adds to the filter's own"""
    correction_time_s: float = 0.15
    """a correction of the filter reaches control over this time"""
