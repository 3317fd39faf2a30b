"""Depth of features without LIDAR returns nearby.

**A plane that most returns around lie in.** Still water reflects the laser away: returns come from
right below only, while the camera sees ripples all over the image. If most recent returns lie in
one plane, and none below it, the features around are assumed to lie in it as well. Features that do
not are outliers, which the gate of the visual update removes.

**Level ground, then parallax**, while the LIDAR is silent. The ground that the rangefinder's beam
hits is where a new keyframe's features are assumed to be, with an error of a good fraction of the
distance: trees and roofs stand on it. Each later image then moves a feature along its ray to where
it is seen (inverse depth by a scalar Kalman filter each, as in Forster et al., SVO, ICRA 2014).
Errors of tracking repeat from image to image, so that an assumed depth never counts as known better
than to a floor.

**The range for the scale.** Parallax shows depths in units of the way since a keyframe. The
rangefinder measures one depth in metres, whose ratio to the depth of the landmarks around the spot
that the beam meets is a measurement of the length of that way: of the pose now against that of the
keyframe. Relief does not matter, as both see the same roof or crown.
"""

from typing import NamedTuple
from zlib import crc32

import numpy as np

from touchdown.estimator.api import LivoParams
from touchdown.estimator.filtering.error_state import CLONE_DIM, POSITION, Frame, Pinhole
from touchdown.estimator.filtering.eskf import Eskf
from touchdown.estimator.filtering.keyframes import Keyframe, bearing_rays
from touchdown.estimator.filtering.landmark_depth import RecentReturns
from touchdown.estimator.filtering.reprojection import LandmarkViews, PixelNoise, depth_corrections
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array, Indices

_MIN_RETURNS = 150
_CELL = 0.02
"""side of the image cells, normalised units; one return per cell counts, so that area, not the
density of returns, decides"""
_TRIALS = 60
_VIEW_MARGIN = 1.5
"""returns are gathered within so many half widths of the image"""
_THICKNESS_M = 0.08
"""four standard deviations of a range"""
_MIN_DISTANCE_M = 20.0
"""distance to the plane below which unevenness of that size moves features by more than the
tracking error"""
_MIN_FRACTION = 0.5
"""fraction of the image's returns that must lie in the plane"""
_MAX_BELOW = 0.03
"""fraction of those returns that may lie beyond it: objects stand on the ground or float on the
water"""
_MIN_SPREAD = 0.05
"""standard deviation of the returns along the plane's narrower direction, relative to its distance:
the plane must be determined up to the edge of the image"""


def common_plane(points: Array) -> Array | None:
    """Returns the lowest plane ``n . P = 1``, n (3,), that most of (N, 3) points in the camera
    frame lie in; None if there is none or it is not determined. Random sample consensus (Fischler
    and Bolles 1981) with the same draws every time, then least squares."""
    if len(points) < _MIN_RETURNS:
        return None
    rng = np.random.default_rng(crc32(b"plane_extension"))
    triples = points[rng.integers(0, len(points), (_TRIALS, 3))]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    offsets = np.einsum("ij,ij->i", normals, triples[:, 0])
    near = np.abs(points @ normals.T - offsets) < _THICKNESS_M
    inside = points[near[:, int(np.argmax(near.sum(axis=0)))]]
    for _ in range(2):
        if len(inside) < max(_MIN_RETURNS, _MIN_FRACTION * len(points)):
            return None
        centre = inside.mean(axis=0)
        values, vectors = np.linalg.eigh(np.cov((inside - centre).T))
        normal = vectors[:, 0] * np.sign(vectors[:, 0] @ centre)
        distance = float(normal @ centre)
        beyond = points @ normal - distance
        inside = points[np.abs(beyond) < _THICKNESS_M]
    if distance < _MIN_DISTANCE_M or np.sqrt(max(values[1], 0.0)) < _MIN_SPREAD * distance:
        return None
    if float((beyond > _THICKNESS_M).mean()) > _MAX_BELOW:
        return None
    return np.asarray(normal / distance, dtype=np.float64)


def extend_plane(
    keyframe: Keyframe, recent: RecentReturns, camera_from_odom: Pose, camera: CameraIntrinsics
) -> None:
    """Assigns the plane of the returns around to the features without one."""
    missing = np.flatnonzero(~keyframe.valid)
    points = recent.points().astype(np.float64)
    if len(points) == 0 or len(missing) == 0:
        return
    seen = camera_from_odom.apply(points)
    depth = np.maximum(seen[:, 2], 1e-3)
    near = (seen[:, 2] > 0.1) & (
        np.abs(seen[:, 0] / depth) < _VIEW_MARGIN * 0.5 * camera.width / camera.fx
    )
    near &= np.abs(seen[:, 1] / depth) < _VIEW_MARGIN * 0.5 * camera.height / camera.fy
    seen = seen[near]
    cells = np.floor(seen[:, :2] / (_CELL * seen[:, 2:])).astype(np.int64)
    # one number a cell sorts much faster than rows
    _, first = np.unique((cells[:, 0] << 32) + cells[:, 1], return_index=True)
    plane = common_plane(seen[np.sort(first)])
    if plane is None:
        return
    facing = bearing_rays(keyframe.pixels[missing], camera) @ plane > 1e-3
    keyframe.valid[missing[facing]] = True
    keyframe.planes[missing[facing]] = plane
    keyframe.measure_depth(camera)


_MIN_HEIGHT_M = 0.5
"""height of the camera above the ground; below it, the beam's error would be much of the depth"""
_STEEPEST = 0.2
"""cosine between a ray and the vertical: flatter rays meet level ground far away, if at all"""
_MIN_DEPTH_RATIO = 0.2
"""fraction of its depth that a feature keeps in one step"""


def assume_level_ground(
    keyframe: Keyframe,
    camera_from_odom: Pose,
    ground_m: float,
    camera: CameraIntrinsics,
    fraction: float,
) -> None:
    """Assigns the plane z = ``ground_m`` of the odometry frame to the features without one, with a
    standard deviation of ``fraction`` of their distance."""
    missing = np.flatnonzero(~keyframe.valid)
    height = float(camera_from_odom.inverse().translation[2]) - ground_m
    if height < _MIN_HEIGHT_M:
        return
    plane = -camera_from_odom.rotation[:, 2] / height
    rays = bearing_rays(keyframe.pixels[missing], camera)
    lengths = np.linalg.norm(rays, axis=1)
    met = rays @ plane * height > _STEEPEST * lengths
    which = missing[met]
    keyframe.valid[which] = keyframe.assumed[which] = True
    keyframe.planes[which] = plane
    keyframe.sigmas[which] = fraction * lengths[met] / (rays[met] @ plane)
    keyframe.measure_depth(camera)


def move_along_rays(
    keyframe: Keyframe,
    which: Indices,
    views: LandmarkViews,
    poses: tuple[Frame, Frame],
    twist: Array,
    camera: tuple[Pose, Pinhole],
    floor: float,
    noise: PixelNoise,
) -> None:
    """Moves the assumed ones among the features ``which`` (N,) to where their ``views`` show them.

    ``poses``: odom_from_imu now and at the keyframe; ``twist`` (6,): of the IMU now; ``camera``:
    imu_from_camera and the lens, as estimated; ``floor``: of the standard deviation, relative to
    the keyframe's depth.
    """
    chosen = np.flatnonzero(keyframe.assumed[which])
    if len(chosen) == 0:
        return
    part, sigmas = which[chosen], keyframe.sigmas[which[chosen]]
    pixels, rows, landmarks, jacobians, _ = (of[chosen] for of in views)
    mount, lens = camera
    arms = landmarks - mount.translation
    relative = sigmas / np.linalg.norm(arms, axis=1)
    moved, left = depth_corrections(
        LandmarkViews(pixels, rows, landmarks, jacobians, arms * relative[:, None]),
        *poses, twist, Frame.of(mount.inverse()), lens, noise,
    ).T  # fmt: skip
    keyframe.planes[part] /= np.maximum(1.0 + moved * relative, _MIN_DEPTH_RATIO)[:, None]
    minimum = np.minimum(sigmas, floor * keyframe.depth_m)
    keyframe.sigmas[part] = np.maximum(sigmas * np.sqrt(left), minimum)


_MIN_DEPTH_M = 0.5
_MAD = 1.4826
"""standard deviation of normal noise in its median absolute deviation"""


class SeenGround(NamedTuple):
    """Landmarks of assumed depth that the present image shows."""

    keyframe: int
    way: Array  # (3,) m, odometry frame, from the keyframe to the present
    points: Array  # (N, 3) in the present camera frame


def update_with_range(eskf: Eskf, seen: list[SeenGround], spot: Array, params: LivoParams) -> bool:
    """Corrects pose and clone of the keyframe with the longest way by the depth of the ``spot``
    (3,), camera frame; False if nothing is near enough or it does not fit (``range_scale_*``)."""
    if spot[2] < _MIN_DEPTH_M:
        return False
    known = [
        (ground, ratios) for ground in seen if len(ratios := _ratios(ground, spot, params)) > 0
    ]
    if not known:
        return False
    (keyframe, way, _), ratios = max(known, key=lambda pair: float(np.linalg.norm(pair[0].way)))
    ratio = float(np.median(ratios))
    scatter = _MAD * float(np.median(np.abs(ratios - ratio)))
    variance = params.range_scale_sigma**2 + scatter * scatter
    touched = eskf.touched([keyframe])
    row = np.zeros(len(touched))
    row[POSITION] = way / (way @ way)
    row[len(row) - CLONE_DIM :][POSITION] = -row[POSITION]
    expected = row @ eskf.prior(touched).spread @ row + variance
    if ratio * ratio > params.range_scale_gate**2 * expected:
        return False
    information = np.outer(row, row) / variance
    eskf.apply(touched, information, row * (ratio / variance), eskf.gains(0.0))
    return True


def _ratios(ground: SeenGround, spot: Array, params: LivoParams) -> Array:
    """Logarithms (N,) of the depth of the spot in that of the landmarks around it; none where they
    are few or the way is short."""
    points = ground.points[ground.points[:, 2] > _MIN_DEPTH_M]
    aside = points[:, :2] / points[:, 2:] - spot[:2] / spot[2]
    near = points[np.hypot(aside[:, 0], aside[:, 1]) < params.range_scale_radius]
    min_m = params.range_scale_way * float(spot[2])
    if len(near) < params.range_scale_landmarks or float(np.linalg.norm(ground.way)) < min_m:
        return np.zeros(0)
    return np.log(spot[2] / near[:, 2])
