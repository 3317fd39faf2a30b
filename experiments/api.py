"""Outcomes of flights, parameters of referee, bias, calibration error and PX4, and what a
calibration takes and gives."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, ClassVar, Literal

import numpy as np
from annotated_types import Interval
from numpy.typing import NDArray

from touchdown.sim.api import CameraIntrinsics, Count, NotNegative, Positive, parameters
from touchdown.sim.frames import Pose


class Outcome(StrEnum):
    """The way a flight ended."""

    LANDED = "LANDED"
    TIPPED = "TIPPED"
    COLLIDED = "COLLIDED"
    TIMEOUT = "TIMEOUT"
    DIVERGED = "DIVERGED"
    NO_SITE = "NO_SITE"
    ABORTED = "ABORTED"
    GROUNDED = "GROUNDED"
    """the survey was over and the vehicle had not left the ground"""
    COMPLETED = "COMPLETED"
    """``fly``: the survey was flown to its end"""


@parameters
class RefereeParams:
    """Limits at which the referee ends a flight."""

    timeout_s: Positive = 300.0
    """simulated time after which the flight ends as TIMEOUT"""
    divergence_m: Positive = 20.0
    """position error at which the estimate counts as lost"""
    tip_tilt_deg: ClassVar[float] = 60.0
    """tilt on the ground from which on the vehicle counts as tipped over"""


@parameters
class BiasParams:
    """An offset ramped into the estimate after take-off. In a closed loop it displaces the vehicle
    by minus the bias."""

    xy_m: tuple[float, float] = (0.0, 0.0)
    """offset east and north"""
    ramp_s: ClassVar[float] = 5.0
    """time over which the offset grows to its full size"""


@parameters
class StartParams:
    """Knowledge of the take-off pose that estimators are given."""

    attitude_known: bool = True
    """False: position and heading only; roll and pitch are for the estimator to find"""
    tilt_sigma_deg: Annotated[float, Interval(gt=0.0, le=30.0)] = 3.0
    """standard deviation of roll and pitch on the ground, for estimators that must find them"""


@parameters
class CalibrationErrorParams:
    """Standard deviations of the errors of the nominal calibration, drawn from the seed. Those of
    camera_from_lidar and of the lens are unused in flights with a calibration file; the others
    remain."""

    rotation_sigma_deg: NotNegative = 0.03
    """of camera_from_lidar, about each axis"""
    translation_sigma_m: NotNegative = 0.003
    """of camera_from_lidar, along each axis"""
    focal_sigma: NotNegative = 5e-4
    """relative, of each focal length"""
    center_sigma_px: NotNegative = 0.0
    """of either coordinate of the principal point"""
    distortion_sigma_px: NotNegative = 0.0
    """of the largest displacement in the image that the distortion's error causes"""
    imu_camera_rotation_sigma_deg: NotNegative = 0.0
    """of the camera's mount against the IMU, about each axis"""
    imu_camera_translation_sigma_m: NotNegative = 0.0
    """of the camera's mount against the IMU, along each axis"""
    imu_lidar_rotation_sigma_deg: NotNegative = 0.0
    """of the LIDAR's mount against the IMU, about each axis; with a calibration file it follows the
    camera's mount instead"""
    imu_lidar_translation_sigma_m: NotNegative = 0.0
    """of the LIDAR's mount against the IMU, along each axis, likewise"""
    imu_sheet_of_profile: bool = False
    """estimators are given the IMU's data sheet of the profile, whatever else ``imu.*`` says"""
    readout_fraction: NotNegative = 0.0
    """relative, of the camera's readout time"""
    lever_sigma_m: NotNegative = 0.0
    """of the places of the satellite antenna and the rangefinder on the body, along each axis"""


@parameters
class Px4Params:
    """PX4's SITL where ``control.controller`` is ``px4``."""

    path: str | None = None
    """PX4's SITL: its build folder, or the program px4 in it; none: that of the environment
    variable ``TOUCHDOWN_PX4``"""
    connect: bool = False
    """wait for a PX4 that somebody else starts, instead of starting one"""
    port: Annotated[int, Interval(ge=4560, le=4659)] = 4560
    """TCP port on which the simulator waits for PX4: 4560 and the number of its instance; taken
    ones are passed over, but with ``connect``"""
    aid: Literal["none", "gps"] = "none"
    """what PX4 is given beside the estimate: ``none``, or ``gps``, the satellite receiver"""
    odometry_hz: Count = 50
    """rate at which the estimate is sent"""
    setpoint_hz: ClassVar[int] = 50
    """rate at which setpoints are sent"""
    start_s: Positive = 60.0
    """wall time for PX4 to connect, and then to answer for the first time"""
    answer_s: Positive = 10.0
    """wall time for the answer of one step"""
    arm_s: Positive = 60.0
    """simulated time for PX4 to arm"""
    parameters: tuple[str, ...] = ()
    """further parameters of PX4, NAME=NUMBER each"""
    ulog: bool = False
    """keep PX4's own log of the flight, ``px4.ulg``"""


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
    points: NDArray[np.float64]
    """(N, 3) returns in the LIDAR frame, metres"""


@dataclass(frozen=True, kw_only=True, slots=True)
class CalibrationResult:
    """Intrinsics and extrinsics from chessboards. Covariances follow from the normal equations;
    that of the extrinsics includes the errors of the camera's planes."""

    camera: CameraIntrinsics
    camera_covariance: NDArray[np.float64]
    """(9, 9) of fx, fy, cx, cy (pixels), k1, k2, p1, p2, k3"""
    camera_from_lidar: Pose
    extrinsic_covariance: NDArray[np.float64]
    """(6, 6) of a small rotation (rad) applied on the left, then of the translation (m)"""
    reprojection_rms_px: float
    plane_rms_m: float
    """of the board's LIDAR points about the camera's planes"""
    used: tuple[int, ...]
    """indices of the views that were used"""
    refused: Mapping[int, str]
    """reasons for rejecting the other views"""
    corners: Mapping[int, NDArray[np.float64]]
    """(rows * columns, 2) pixels of the views whose board the camera found"""
    board_points: Mapping[int, NDArray[np.float64]]
    """(N, 3) means of the returns from the board in cells of 5 cm, LIDAR frame, of the views that
    were used"""
