"""States, IMU buffers, points and planes for tests of the filter and its updates."""

from typing import Any

import numpy as np

from touchdown.estimator.api import LivoParams
from touchdown.estimator.filtering.anchors import Anchors
from touchdown.estimator.filtering.camera_model import Shutter
from touchdown.estimator.filtering.deskew import PlacedScan
from touchdown.estimator.filtering.error_state import Frame
from touchdown.estimator.filtering.eskf import Eskf
from touchdown.estimator.filtering.imu_propagation import ImuBuffer, NavState
from touchdown.estimator.filtering.landmark_depth import RecentReturns
from touchdown.estimator.filtering.plane_map import PlaneMatches
from touchdown.estimator.filtering.reprojection import MountedCamera
from touchdown.estimator.livo.scan_update import PlaneEquations, Returns, ScanNoise, plane_equations
from touchdown.estimator.livo.visual import VisualFrontEnd
from touchdown.sim.api import GRAVITY_MPS2, CameraIntrinsics, ImuParams
from touchdown.sim.frames import BODY_FROM_DOWNWARD_OPTICAL, Pose, so3_exp

STEP_S = 0.005
CAMERA = CameraIntrinsics(width=424, height=240, fx=310.0, fy=315.0, cx=211.5, cy=119.5)
IMU_FROM_CAMERA = Pose(BODY_FROM_DOWNWARD_OPTICAL, np.array([0.07, 0.02, -0.13]))


def random_state(rng: np.random.Generator) -> NavState:
    return NavState(
        0, so3_exp(rng.normal(0.0, 0.5, 3)), rng.normal(0.0, 10.0, 3), rng.normal(0.0, 3.0, 3),
        rng.normal(0.0, 1e-3, 3), rng.normal(0.0, 1e-2, 3),
    )  # fmt: skip


def filled_buffer(rng: np.random.Generator, count: int) -> ImuBuffer:
    buffer = ImuBuffer(ImuParams(), STEP_S)
    for i in range(count):
        force = np.array([0.0, 0.0, GRAVITY_MPS2]) + rng.normal(0.0, 1.0, 3)
        buffer.push(3 * (i + 1), rng.normal(0.0, 0.5, 3), force, False)
    return buffer


def front_end(shutter: Shutter | None = None, **params: float) -> VisualFrontEnd:
    """Of a few keyframes, whose depths are exact."""
    few = {"keyframes": 4, "track_keyframes": 2, "features": 150, "pixel_sigma": 0.5}
    exact = {"depth_sigma_m": 0.0, "anchor_height_m": 0.0}
    return VisualFrontEnd(
        MountedCamera(CAMERA, IMU_FROM_CAMERA), LivoParams(**{**few, **exact, **params}),
        shutter or Shutter(), open_ticks=1200,
    )  # fmt: skip


def ground_returns(noise_m: float = 0.01) -> RecentReturns:
    rng = np.random.default_rng(6)
    recent = RecentReturns(scans=1, per_scan=60_000)
    xy = rng.uniform(-15.0, 15.0, (60_000, 2))
    recent.add(np.column_stack([xy, rng.normal(0.0, noise_m, 60_000)]))
    return recent


def add_keyframe(vision: VisualFrontEnd, eskf: Eskf, *view: Any, **more: Any) -> bool:
    """Makes an image a keyframe, as `livo` does; True if it can be one."""
    keyframe = vision.new_keyframe(eskf, *view, **more)
    if keyframe is not None:
        vision.append(eskf, keyframe, vision.surplus(eskf))
    return keyframe is not None


def state_at(rotation: np.ndarray, position: np.ndarray) -> NavState:
    return NavState(0, rotation, position, np.zeros(3), np.zeros(3), np.zeros(3))


def placed(points: np.ndarray, beams: np.ndarray | None = None) -> PlacedScan:
    """Returns a scan of given (N, 3) points; ``beams``: by default the points."""
    return PlacedScan(points, points if beams is None else beams, np.arange(len(points)))


def plane_information(
    points: np.ndarray, beams: np.ndarray, rotation: np.ndarray, position: np.ndarray,
    found: np.ndarray, normals: np.ndarray, centres: np.ndarray, variances: np.ndarray,
    *noise: float,
) -> PlaneEquations:  # fmt: skip
    """Returns the normal equations for planes without anchors and a fixed calibration."""
    none = np.full(len(points), -1, dtype=np.int16)
    planes = PlaneMatches(found, normals, centres, variances, np.zeros_like(centres), none)
    anchors = Anchors().frames([], np.zeros(0), np.zeros(0, np.int64))
    return plane_equations(
        Returns(points, beams), Frame(rotation, position), planes, anchors, 0, 0, ScanNoise(*noise)
    )


def room_points(rng: np.random.Generator, walls: bool) -> np.ndarray:
    """Ground of 30 x 30 m, and two walls that stand on it."""
    ground = np.column_stack([rng.uniform(-15, 15, (20_000, 2)), np.zeros(20_000)])
    if not walls:
        return ground
    east = np.column_stack([np.full(3000, 6.3), rng.uniform(-5, 5, 3000), rng.uniform(0, 5, 3000)])
    side = np.column_stack([rng.uniform(-5, 5, 3000), np.full(3000, -7.4), rng.uniform(0, 5, 3000)])
    return np.vstack([ground, east, side])
