"""The steps of the calibration on geometry whose answers are known."""

from dataclasses import replace

import cv2
import numpy as np
import open3d as o3d
import pytest

from touchdown.experiments.api import CalibrationView, Chessboard
from touchdown.experiments.calibration.board_plane import (
    BoardPlane,
    difference_of_normals,
    find_board,
    fit_plane,
    ransac_plane,
)
from touchdown.experiments.calibration.calibrate import calibrate
from touchdown.experiments.calibration.chessboard import (
    LENS_PARAMETERS,
    CameraPlanes,
    board_corners,
    camera_planes,
    fit_camera,
)
from touchdown.experiments.calibration.extrinsics import agreeing_views, solve_extrinsics
from touchdown.sim.frames import Pose, so3_exp, so3_log
from touchdown.sim.typing import Array

BOARD = Chessboard()
MATRIX = np.array([[620.0, 0.0, 420.0], [0.0, 630.0, 235.0], [0.0, 0.0, 1.0]])
LENS = np.array([-0.08, 0.03, 0.0006, -0.0004, 0.0])
TRUE = Pose(so3_exp(np.array([0.02, -0.03, 0.4])), np.array([0.05, 0.08, -0.02]))


def _poses(count: int, seed: int = 1) -> list[Pose]:
    """Boards 2 to 3 m ahead, tilted about both axes."""
    rng = np.random.default_rng(seed)
    poses = []
    for k in range(count):
        angle = 2.4 * k
        tilt = rng.uniform(0.35, 0.8) * np.array([np.cos(angle), np.sin(angle), 0.0])
        place = np.array([*rng.uniform([-0.6, -0.3], [0.6, 0.3]), rng.uniform(2.0, 3.0)])
        poses.append(Pose(so3_exp(tilt), place))
    return poses


def _plane(pose: Pose) -> tuple[Array, float]:
    normal = -pose.rotation[:, 2]
    return normal, -float(normal @ pose.translation)


def _exact(count: int) -> tuple[CameraPlanes, list[BoardPlane]]:
    """Planes of boards in the camera frame, and points on them in the LIDAR's."""
    rng = np.random.default_rng(0)
    normals, distances, boards = [], [], []
    for pose in _poses(count):
        normal, distance = _plane(pose)
        spots = np.column_stack([rng.uniform(-0.5, 0.5, (200, 2)), np.zeros(200)])
        points = TRUE.inverse().apply(pose.apply(spots))
        in_lidar = fit_plane(points)
        normals.append(normal)
        distances.append(distance)
        boards.append(BoardPlane(normal=in_lidar[0], distance=in_lidar[1], points=points))
    covariance = 1e-12 * np.eye(4 * count)
    planes = CameraPlanes(
        normals=np.array(normals), distances=np.array(distances), covariance=covariance
    )
    return planes, boards


def _beams(count: int, rng: np.random.Generator) -> Array:
    """Unit directions all over 40 x 26 degrees."""
    slope = rng.uniform(-1.0, 1.0, (count, 2)) * np.tan(np.deg2rad([20.0, 13.0]))
    rays = np.column_stack([slope, np.ones(count)])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _cloud(board: Pose | None, seed: int, sigma_m: float = 0.02, floor_m: float = 5.0) -> Array:
    """Returns of a floor ahead and of a board before it, noise along the beams."""
    rng = np.random.default_rng(seed)
    rays = _beams(60_000, rng)
    ranges = floor_m / rays[:, 2]
    if board is not None:
        normal, distance = _plane(board)
        along = -distance / (rays @ normal)
        spots = board.inverse().apply(rays * along[:, None])
        hit = (np.abs(spots[:, :2]) < 0.5 * np.array(BOARD.size_m)).all(axis=1)
        ranges = np.where(hit & (along > 0.0), along, ranges)
    ranges = ranges + sigma_m * rng.standard_normal(len(rays))
    seen = np.isfinite(ranges)
    return rays[seen] * ranges[seen, None]


def test_normals_differ_at_an_edge_and_not_on_a_face() -> None:
    """A right-angled edge: the small neighbourhood of a point 0.15 from it is one face, the large
    one both."""
    u, v = (axis.ravel() for axis in np.meshgrid(np.arange(0.0, 1.0, 0.02), np.arange(0, 1, 0.02)))
    floor, wall = np.column_stack([u, v, 0 * u + 3]), np.column_stack([0 * u, v, 3 - u - 0.02])
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.concatenate([floor, wall])))
    difference = difference_of_normals(cloud, 0.1, 0.3)[: len(u)]
    inside = (np.abs(v - 0.5) < 0.15) & (u > 0.35) & (u < 0.65)
    beside = (np.abs(v - 0.5) < 0.15) & (np.abs(u - 0.15) < 0.01)
    assert difference[inside].max() < 1e-6 and difference[beside].min() > 0.05


def test_ransac_finds_the_larger_of_two_planes() -> None:
    rng = np.random.default_rng(5)
    many = np.column_stack([rng.uniform(-1, 1, (300, 2)), np.full(300, 2.0)])
    few = np.column_stack([rng.uniform(-1, 1, (200, 2)), rng.uniform(2.2, 3.0, 200)])
    normal, distance, inside = ransac_plane(np.concatenate([many, few]), 0.01, 200, rng)
    np.testing.assert_allclose(normal, [0.0, 0.0, -1.0], atol=1e-12)
    assert distance == pytest.approx(2.0) and inside[:300].all() and not inside[300:].any()


def test_a_board_before_a_floor_is_found() -> None:
    pose = Pose(so3_exp(np.array([0.5, 0.3, 0.2])), np.array([0.3, 0.05, 2.6]))
    found = find_board(_cloud(pose, 2), BOARD, np.random.default_rng(0))
    assert found is not None
    normal, distance = _plane(pose)
    assert np.rad2deg(np.arccos(found.normal @ normal)) < 0.1
    assert found.distance == pytest.approx(distance, abs=2e-3)


def test_no_board_is_found_where_there_is_none() -> None:
    assert find_board(_cloud(None, 3), BOARD, np.random.default_rng(0)) is None
    assert find_board(np.zeros((0, 3)), BOARD, np.random.default_rng(0)) is None


def test_noise_along_slanted_beams_does_not_turn_the_plane() -> None:
    """The plane of single returns is off by 0.1 degrees and more here, always to one side."""
    pose = Pose(so3_exp(np.array([0.0, 0.8, 0.0])), np.array([0.2, 0.0, 2.6]))
    normal, _ = _plane(pose)
    turns = []
    for seed in range(6):
        found = find_board(_cloud(pose, seed, 0.03, np.inf), BOARD, np.random.default_rng(0))
        assert found is not None
        turns.append(np.cross(normal, found.normal)[1])
    assert abs(np.rad2deg(np.mean(turns))) < 0.035


def _projected(poses: list[Pose]) -> list[Array]:
    still = np.zeros(3)
    corners = [pose.apply(board_corners(BOARD)) for pose in poses]
    return [
        cv2.projectPoints(points, still, still, MATRIX, LENS)[0].reshape(-1, 2)
        for points in corners
    ]


def test_exact_corners_give_the_exact_camera_and_planes() -> None:
    poses = _poses(12)
    fit = fit_camera(_projected(poses), BOARD, (848, 480))
    k = fit.camera
    np.testing.assert_allclose([k.fx, k.fy, k.cx, k.cy], [620, 630, 420, 235], atol=5e-3)
    np.testing.assert_allclose(k.distortion, LENS, atol=1e-3)
    planes = camera_planes(fit)
    for pose, normal, distance in zip(poses, planes.normals, planes.distances, strict=True):
        expected = _plane(pose)
        np.testing.assert_allclose(normal, expected[0], atol=1e-5)
        assert distance == pytest.approx(expected[1], abs=1e-4)


def test_covariance_of_the_camera_is_that_of_repeated_fits() -> None:
    rng = np.random.default_rng(8)
    poses = _poses(8)
    exact, sigma, errors, stated = _projected(poses), 0.1, [], np.zeros(4)
    for _ in range(25):
        noisy = [view + sigma * rng.standard_normal(view.shape) for view in exact]
        fit = fit_camera(noisy, BOARD, (848, 480))
        k = fit.camera
        errors.append(np.array([k.fx, k.fy, k.cx, k.cy]) - [620, 630, 420, 235])
        stated += np.diag(fit.covariance)[:4] / 25.0
    ratio = np.mean(np.square(errors), axis=0) / stated
    assert (ratio > 0.4).all() and (ratio < 2.0).all()  # chi-square of 25: 0.46 to 1.8 at 99.5 %


def test_covariance_of_planes_follows_from_that_of_poses() -> None:
    fit = fit_camera(_projected(_poses(3)), BOARD, (848, 480))
    step = 1e-6
    for axis in range(3):
        unit = np.zeros_like(fit.covariance)
        place = LENS_PARAMETERS + axis
        unit[place, place] = 1.0
        moved = fit.rotation_vectors.copy()
        moved[0, axis] += step
        base = camera_planes(replace(fit, covariance=unit))
        after = camera_planes(replace(fit, covariance=unit, rotation_vectors=moved))
        change = np.append(
            after.normals[0] - base.normals[0], after.distances[0] - base.distances[0]
        )
        slope = change / step
        np.testing.assert_allclose(base.covariance[:4, :4], np.outer(slope, slope), atol=1e-5)


def test_exact_planes_give_the_exact_pose_from_a_poor_start() -> None:
    planes, boards = _exact(12)
    start = Pose(so3_exp(np.array([0.2, -0.3, 0.1])) @ TRUE.rotation, TRUE.translation + 0.2)
    fit = solve_extrinsics(planes, boards, np.arange(12), start)
    assert np.linalg.norm(so3_log(fit.camera_from_lidar.rotation @ TRUE.rotation.T)) < 1e-9
    np.testing.assert_allclose(fit.camera_from_lidar.translation, TRUE.translation, atol=1e-9)
    assert fit.rms_m < 1e-9


@pytest.mark.parametrize("sensor", ["camera", "LIDAR"])
def test_covariance_of_the_extrinsics_is_that_of_repeated_fits(sensor: str) -> None:
    """Planes of the camera with errors of 1 mrad and 2 mm, returns with 1 cm along the normal."""
    rng, count = np.random.default_rng(9), 8
    exact, boards = _exact(count)
    spread = np.tile([1e-3, 1e-3, 1e-3, 2e-3], count)
    planes, noisy, squares, stated = exact, list(boards), np.zeros(6), np.zeros(6)
    for _ in range(25):
        if sensor == "camera":
            error = (spread * rng.standard_normal(spread.size)).reshape(-1, 4)
            planes = CameraPlanes(
                normals=exact.normals + error[:, :3], distances=exact.distances + error[:, 3],
                covariance=np.diag(spread**2),
            )  # fmt: skip
        else:
            noisy = [
                replace(b, points=b.points + 0.01 * rng.standard_normal((200, 1)) * b.normal)
                for b in boards
            ]
        fit = solve_extrinsics(planes, noisy, np.arange(count), TRUE)
        pose = fit.camera_from_lidar
        error = np.append(
            so3_log(pose.rotation @ TRUE.rotation.T), pose.translation - TRUE.translation
        )
        squares += error**2 / 25.0
        stated += np.diag(fit.covariance) / 25.0
    ratio = squares / stated
    assert (ratio > 0.4).all() and (ratio < 2.0).all()  # chi-square of 25: 0.46 to 1.8 at 99.5 %


def test_a_wrong_plane_is_left_out() -> None:
    planes, boards = _exact(8)
    wrong = boards[3]
    boards[3] = BoardPlane(
        normal=so3_exp(np.array([0.0, 0.4, 0.0])) @ wrong.normal,
        distance=wrong.distance + 0.5,
        points=wrong.points,
    )
    start, views = agreeing_views(planes, boards, np.random.default_rng(0))
    assert views.tolist() == [0, 1, 2, 4, 5, 6, 7]
    np.testing.assert_allclose(start.translation, TRUE.translation, atol=1e-9)


def test_two_views_and_boards_all_alike_are_refused() -> None:
    planes, boards = _exact(4)
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="only 2 views"):
        agreeing_views(planes.of_views([0, 1]), boards[:2], rng)
    with pytest.raises(ValueError, match="tilted too much alike"):
        agreeing_views(planes.of_views([0, 0, 0, 0]), [boards[0]] * 4, rng)


def test_images_without_a_board_are_refused_in_one_sentence() -> None:
    nothing = CalibrationView(rgb=np.zeros((480, 848, 3), np.uint8), points=np.zeros((0, 3)))
    with pytest.raises(ValueError, match=r"only 0 of 4 views.*needs 3 or more"):
        calibrate([nothing] * 4, BOARD)
