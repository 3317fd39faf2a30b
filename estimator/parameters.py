"""Parameters of mapper and estimators; part of `estimator.api`: import them from there."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

from annotated_types import Interval

from touchdown.sim.api import Count, CountOrZero, Fraction, NotNegative, Positive, parameters

HEIGHT_BIN_M = 0.02
"""width of a bin of `estimator.api.GridMap.histogram`"""
HEIGHT_BINS = 32


@parameters
class MapperParams:
    """Bounded memory: the grids' extents and cells set it, not the flight's duration."""

    mapper: str = "grid"
    """what makes the map: ``grid``, or MODULE:FUNCTION of an external mapper"""
    enabled: bool = True
    """false: no map, and no LIDAR unless the estimator needs it; for surveys only"""
    cell_m: Positive = 0.2
    """side of a cell of the coarse grid"""
    extent_m: Positive = 160.0
    """side of the square coarse grid, centred on the take-off spot"""
    fine_cell_m: Positive = 0.05
    """side of a cell of the fine grid"""
    fine_extent_m: Positive = 24.0
    """side of the square fine grid, which follows the vehicle"""
    fine_below_m: NotNegative = 14.0
    """height above ground below which the fine grid is filled"""
    fine_recentre_m: ClassVar[float] = 6.0
    """the fine window follows once the vehicle is this far from its centre"""
    count_cap: Positive = 200.0
    """effective number of returns per cell; older ones fade"""
    extreme_memory_s: Positive = 60.0
    """time constant with which unconfirmed extremes decay"""
    missing_min_reach_m: ClassVar[float] = 1.5
    """nearest expected ground for which a pulse without return counts as missing"""
    missing_max_reach_m: Positive = 60.0
    """a pulse without return counts as missing only where the ground is expected within these"""


@parameters
class FlownImuParams:
    """Noise of the IMU on the flying vehicle, where above that of the data sheet: what `zou2024`
    and the baselines assume. ``livo`` has its own."""

    gyro_density: NotNegative = 0.0
    """rad/s/sqrt(Hz) of the gyroscope"""
    accel_density: NotNegative = 0.0
    """m/s^2/sqrt(Hz) of the accelerometer"""
    gyro_bias_walk: NotNegative = 0.0
    """rad/s^2/sqrt(Hz): what scale, alignment and g-sensitivity add to the bias"""
    accel_bias_walk: NotNegative = 0.0
    """m/s^3/sqrt(Hz), likewise"""


@parameters
class CalibrationPriors:
    """Errors of the given calibration that are estimated online, as the baselines assume them;
    ``livo`` and ``zou2024`` have their own. The lens is not among them: the scale of flow and of
    disparities is less exact, and a shift of the principal point looks as a rotation."""

    use_calibration: bool = True
    """they are part of the filter's state"""
    prior_scale: Positive = 1.0
    """factor of all priors of calibration errors"""
    camera_clock_sigma_s: NotNegative = 0.005
    """prior of the offset of the camera's clock from the IMU's; 0: no offset"""
    camera_rotation_sigma_deg: NotNegative = 0.0
    """prior of the rotation of the camera relative to the IMU"""
    camera_translation_sigma_m: NotNegative = 0.0
    """prior of the camera's translation relative to the IMU"""
    imu_scale_sigma: NotNegative = 0.0
    """prior of the relative scale errors of gyroscope and accelerometer"""
    gyro_misalignment_sigma_deg: NotNegative = 0.0
    """prior of the misalignment of each axis of the gyroscope towards each of the two others"""
    gyro_g_sigma: NotNegative = 0.0
    """prior of the gyroscope's response to specific force, rad/s per m/s^2"""


@dataclass(frozen=True, kw_only=True, slots=True)
class CalibratedParams(CalibrationPriors):
    """Errors of scans and of the given calibration, which are part of the filter's state."""

    calibrate_above_m: NotNegative = 15.0
    """height above ground from which mount and lens are estimated; lower, the range noise is a
    large fraction of a depth, and its effect on a keyframe would be attributed to the
    calibration"""
    scan_calibration_gain: Fraction = 1.0
    """fraction of its correction that a scan applies to mounts and lens (partial-update
    Schmidt-Kalman filter, Brink 2017); 0: they only widen the covariance"""
    image_calibration_gain: Fraction = 0.0
    """fraction of its correction that an image applies to mounts and lens"""
    ground_sigma_m: NotNegative = 0.0
    """error that all ranges to the ground share, by plants and range bias, in the reported height:
    no measurement shows it"""
    scan_height_sigma_m: NotNegative = 0.01
    """information floor: height error of a scan, beside those of its points and of the keyframes
    that the map is anchored to"""
    mount_rotation_sigma_deg: NotNegative = 0.03
    """prior of the calibration errors: LIDAR relative to camera and IMU"""
    mount_translation_sigma_m: NotNegative = 0.003
    """prior of the LIDAR's translation relative to camera and IMU"""
    focal_sigma: NotNegative = 5e-4
    """prior of the relative error of the focal length"""
    center_sigma_px: NotNegative = 0.1
    """prior of the error of the principal point"""


@dataclass(frozen=True, kw_only=True, slots=True)
class LivoParams(CalibratedParams):
    """LIDAR-inertial-visual odometry (``estimator/livo/estimator.py``)."""

    gyro_density: NotNegative = 0.0
    """noise as in ``FlownImuParams``"""
    accel_density: NotNegative = 0.0
    """noise as in ``FlownImuParams``"""
    gyro_bias_walk: NotNegative = 0.0
    """noise as in ``FlownImuParams``"""
    accel_bias_walk: NotNegative = 0.0
    """noise as in ``FlownImuParams``"""
    camera_hz: Count = 5
    """image rate; a divisor of the camera's clock. At 10 a flight costs a quarter more, and
    positions are no better within their spread"""
    voxel_m: Positive = 1.0
    """side of the plane map's voxels"""
    map_voxels: ClassVar[int] = 131072
    """capacity of the plane map, a power of two; it never grows"""
    voxel_points: ClassVar[int] = 150
    """a voxel ignores further returns after so many"""
    map_open_s: Positive = 0.3
    """scans enter the map for so long after a keyframe: later ones have drifted against it"""
    image_open_s: Positive = 0.5
    """scans enter an image of intensity for so long after a keyframe: its cells need more
    returns"""
    anchor_spacing: Positive = 0.45
    """horizontal distance from the newest keyframe relative to the height, beyond which the map is
    given another part where images fail: a scan covers half the height along the flight"""
    anchor_climb: Positive = 0.3
    """vertical distance that counts as ``anchor_spacing`` does; both by 21 replays without
    images"""
    anchor_turn_deg: ClassVar[float] = 20.0
    """rotation since the newest keyframe that counts as ``anchor_spacing`` does"""
    plane_sigma_m: NotNegative = 0.003
    """error of any plane of the map, beside the scatter of its returns"""
    scan_points: Count = 2000
    """returns of a scan that are matched, spread evenly"""
    scan_tilt_sigma_deg: NotNegative = 1.0
    """information floor: errors of a scan as a whole, beside those of its points and of the
    keyframes that the map is anchored to"""
    scan_lateral_sigma_m: NotNegative = 0.3
    """information floor: error of a scan's horizontal position"""
    scan_yaw_sigma_deg: NotNegative = 0.5
    """information floor: error of a scan's heading"""
    anchor_height_m: NotNegative = 0.004
    """height error shared by all planes and landmarks of a keyframe"""
    depth_sigma_m: NotNegative = 0.02
    """standard deviation of a landmark along its ray"""
    depth_shared_sigma_m: NotNegative = 0.0
    """standard deviation of an error in height that all landmarks of a keyframe share, such as the
    bias of the ranges. Needs ``use_calibration``"""
    assumed_depth_fraction: NotNegative = 0.4
    """standard deviation, relative to their distance, of features that are assumed to lie on level
    ground below the rangefinder, as new ones are while no scans come"""
    assumed_depth_floor: ClassVar[float] = 0.16
    """least standard deviation of an assumed depth, relative to it, however long parallax has shown
    it"""
    range_scale_sigma: Positive = 0.01
    """while no scans come, the rangefinder scales the way since a keyframe: relative error of its
    range as the depth of the landmarks around, by relief; chosen on five replays without LIDAR.
    The next four are assumed"""
    range_scale_radius: Positive = 0.1
    """rad about the rangefinder's beam, within which landmarks count as around"""
    range_scale_landmarks: ClassVar[int] = 4
    """fewest landmarks there"""
    range_scale_way: ClassVar[float] = 0.1
    """shortest way over the depth: with a shorter one parallax is noise"""
    range_scale_gate: ClassVar[float] = 3.0
    """standard deviations between range and depth, beyond which beam and landmarks are not on the
    same surface"""
    ground_memory_s: ClassVar[float] = 1.0
    """time constant of the ground's height below the rangefinder"""
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
    use_degeneracy: bool = True
    """scans do not correct degenerate directions, such as lateral motion over level ground"""
    weak_sigma_m: NotNegative = 0.1
    """a direction with a larger standard deviation than this counts as degenerate"""
    weak_sigma_deg: NotNegative = 0.3
    """a rotation with a larger standard deviation than this counts as degenerate"""
    use_intensity: bool = False
    """measure the pose by the intensities of scans where no image does"""
    intensity_after_s: NotNegative = 0.5
    """time without such an image from which on they do; 0: beside images, too"""
    dark_height_sigma_m: NotNegative = 0.05
    """least ``scan_height_sigma_m`` while they do; by eight replays without images"""
    keyframes: Count = 40
    """capacity; beyond it the most redundant one is marginalised"""
    track_keyframes: Count = 3
    """keyframes that each image is tracked from"""
    track_scale: Annotated[float, Interval(gt=0.0, lt=1.0)] = 0.25
    """least ratio of the distances from which keyframe and image see the ground, and of its
    inverse: in a climb, few keyframes in a row lead from the start to survey height. Chosen on
    seven replays"""
    features: Count = 220
    """corners of a keyframe"""
    pixel_sigma: NotNegative = 0.3
    """standard deviation of a tracked corner, its landmark's error included"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Zou2024Params(CalibratedParams):
    """LIDAR-camera positioning of Zou, Sun and Kong 2024 (``estimator/zou2024``)."""

    camera_hz: Count = 10
    """image rate; a divisor of the camera's clock"""
    edge_model: str = "shipped"
    """``shipped``, the path of a structured edge model for OpenCV, or ``gradient`` for edges from
    colour gradients"""
    use_lidar_pose: bool = True
    """scans correct the pose (Algorithm 1)"""
    use_camera_pose: bool = True
    """images correct the pose (PnP)"""
    use_colour_smoothness: bool = True
    """f_c contributes to the choice of edge and planar points (Eq. 7)"""
    use_geodesic_depth: bool = True
    """the returns around a landmark are weighed by the edges between (Eq. 12); if false, by their
    distance in the image alone"""
    use_bundle: bool = True
    """bundle adjustment of the newest keyframes"""
    use_closures: bool = True
    """loop closures correct the map"""
    colour_weight: ClassVar[float] = 0.012
    """lambda of Eq. 7"""
    edge_threshold: ClassVar[float] = 0.006
    """f_s above which a return may be an edge point, below which a planar one"""
    edge_points: Count = 400
    """edge points kept of a scan"""
    planar_cells: tuple[Count, Count] = (56, 28)
    """columns and rows of the view's sectors; each gives one planar point"""
    edge_voxel_m: ClassVar[float] = 0.3
    """voxel side of the map of edge points"""
    planar_voxel_m: ClassVar[float] = 0.6
    """voxel side of the map of planar points"""
    map_voxels: ClassVar[int] = 131072
    """capacity of each feature map, a power of two; it never grows"""
    edge_sigma_m: ClassVar[float] = 0.15
    """standard deviation of a point-to-line distance"""
    plane_sigma_m: ClassVar[float] = 0.04
    """standard deviation of a point-to-plane distance"""
    keyframe_distance_m: NotNegative = 3.0
    """distance after which an image is matched with the map"""
    keyframe_period_s: Positive = 0.5
    """images further apart than either are matched to the map"""
    sift_features: CountOrZero = 600
    """SIFT features of a keyframe; with more of both kinds five replays over the forest in `ideal`
    err less, four surveys in `field` more"""
    brisk_features: CountOrZero = 500
    """BRISK features of a keyframe"""
    sift_sigma_px: NotNegative = 1.4
    """standard deviation of a SIFT feature, which is found at a quarter of the image's size;
    assumed"""
    brisk_sigma_px: ClassVar[float] = 0.8
    """standard deviation of a BRISK feature"""
    max_keyframes: Count = 160
    """keyframes kept; the map is bounded"""
    bundle_keyframes: ClassVar[int] = 8
    """youngest keyframes that are adjusted together"""
    depth_sigma_m: NotNegative = 0.05
    """standard deviation of a landmark's depth by Eq. 12"""
    recent_keyframes: Count = 20
    """newest keyframes, whose landmarks give the odometry"""
    loop_threshold: Fraction = 0.11
    """probability of a revisit, 1 - p(new location), from which the best hypothesis is verified;
    ``Rtabmap/LoopThr`` of RTAB-Map"""
    loop_inliers: ClassVar[int] = 20
    """landmarks that agree with the pose of a revisit, at least; ``Vis/MinInliers`` of RTAB-Map"""
    short_term_locations: Count = 10
    """newest locations, one a second, that are not loop candidates; ``Mem/STMSize`` of RTAB-Map"""
    rehearsal_similarity: ClassVar[float] = 0.6
    """fraction of common words from which two locations in a row are one;
    ``Mem/RehearsalSimilarity`` of RTAB-Map"""
    loop_words: ClassVar[int] = 20000
    """visual words of each kind, beyond which locations go to long-term memory. RTAB-Map limits the
    time of an update (``Rtabmap/TimeThr``), which would differ from run to run"""
    closure_speed_mps: ClassVar[float] = 0.1
    """fastest motion of the odometry frame when closures correct the past"""
    closure_rate_deg_s: ClassVar[float] = 0.5
    """fastest rotation of the odometry frame when closures correct the past"""


@parameters
class NavigationParams:
    """What the baselines with magnetometer and barometer have."""

    heading_sigma_deg: Positive = 5.0
    """standard deviation of one reading of the magnetometer, ten a second"""
    baro_sigma_m: NotNegative = 0.5
    """standard deviation of one reading of the barometer, its drift included"""


@dataclass(frozen=True, kw_only=True, slots=True)
class GpsEstimatorParams(NavigationParams):
    """GPS, IMU, magnetometer and barometer (``estimator/baselines/gps.py``)."""

    follow_period_s: Positive = 0.3
    """time constant with which the position follows the fixes"""


@dataclass(frozen=True, kw_only=True, slots=True)
class FlowParams(NavigationParams):
    """What the two by optical flow have."""

    camera_hz: Count = 10
    """image rate; a divisor of the camera's clock"""
    pixel_sigma: NotNegative = 0.3
    """standard deviation of the flow of one corner, or of one vector of the levelled image"""
    floor_sigma_m: Positive = 0.01
    """error floor of a displacement, however many of them it is made of"""
    scale_sigma: Positive = 0.05
    """error of a displacement as a fraction of it, for ground that is not level"""
    ground_memory_s: ClassVar[float] = 0.5
    """time constant of the ground's height below the rangefinder"""


@dataclass(frozen=True, kw_only=True, slots=True)
class OpticalFlowParams(FlowParams):
    """Optical flow, rangefinder, IMU, magnetometer and barometer
    (``estimator/baselines/optical_flow.py``)."""

    features: Count = 60
    """corners of an image"""
    window_pixels: Count = 64
    """side of the central part of the image that they are taken from"""
    ground_memory_s: ClassVar[float] = 0.2
    """time constant of the ground's height below the rangefinder"""
    heading_sigma_deg: Positive = 2.0
    """standard deviation of one reading of the magnetometer, ten a second"""
    drift_fraction: ClassVar[float] = 0.005
    """standard deviation that each metre flown adds to the filter's own"""


@dataclass(frozen=True, kw_only=True, slots=True)
class HybridFlowParams(FlowParams):
    """Dense optical flow and phase correlation with GPS
    (``estimator/baselines/optical_flow.py``)."""

    side_pixels: ClassVar[int] = 256
    """side of the levelled image, a power of two"""
    wander_period_s: Positive = 60.0
    """correlation time of the receiver's error"""
    drift_density: Positive = 0.03
    """m/sqrt(s): random walk of the odometry, from which the receiver's error is separated"""


@parameters
class StereoParams:
    """Visual odometry on the stereo pair and the IMU (``estimator/baselines/stereo.py``)."""

    camera_hz: Count = 10
    """image rate; a divisor of the camera's clock"""
    features: Count = 220
    """corners of a keyframe"""
    pixel_sigma: NotNegative = 1.5
    """standard deviation of a corner tracked from the keyframe, the error of its depth included"""
    disparity_sigma: NotNegative = 0.15
    """pixels, of one corner"""
    track_sigma: ClassVar[float] = 1.0
    """pixels, of a corner tracked from the keyframe, in the update of its depth by parallax"""
    keyframe_fraction: ClassVar[float] = 0.55
    """fraction of a keyframe's corners: with fewer in view a new one is made"""
    disparity_floor_sigma: NotNegative = 0.02
    """pixels, error shared by all disparities of a pair"""
    relief_sigma_m: NotNegative = 2.0
    """standard deviation of the heights of objects on the ground"""
    ground_density: NotNegative = 0.3
    """m/sqrt(s): random walk of the mean height of the ground in view"""
    drift_fraction: ClassVar[float] = 0.003
    """standard deviation that each metre flown adds to the filter's own"""
