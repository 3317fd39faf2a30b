"""The paper's positioning on small known problems: registration, landmarks, PnP, bundle adjustment,
dictionary and pose graph."""

import cv2
import numpy as np
import pytest

from touchdown.estimator.filtering.error_state import Frames
from touchdown.estimator.zou2024.bundle import reprojection_errors, solve_pnp
from touchdown.estimator.zou2024.closures import Closures, Edge, PoseGraph, level_transform
from touchdown.estimator.zou2024.feature_map import FeatureMap, Seen
from touchdown.estimator.zou2024.place_recognition import MemoryLimits
from touchdown.estimator.zou2024.registration import FeatureMaps, ScanFeatures, register_scan
from touchdown.estimator.zou2024.visual_map import BRISK, SIFT, LandmarkDetector, match_near, spread
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose, rotation_from_yaw, so3_exp, so3_log

CAMERA = CameraIntrinsics(width=640, height=480, fx=500.0, fy=520.0, cx=320.0, cy=240.0)
DOWN = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.05, 0.0, -0.1]))
STILL = Frames.of([Pose.identity()])
LOOSE = np.diag([1e2, 1e2, 1e2, 1e-2, 1e-2, 1e-2])


def room(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points on floor and two walls (3 count, 3), and along two edges (2 count, 3)."""
    u, v, zero = rng.uniform(0, 6, (3, count)), rng.uniform(0, 6, (3, count)), np.zeros(count)
    planes = np.concatenate(
        [
            np.column_stack([u[0], v[0], zero]),
            np.column_stack([zero, u[1], v[1]]),
            np.column_stack([u[2], zero, v[2]]),
        ]
    )
    s = rng.uniform(0, 6, (2, count))
    edges = np.concatenate(
        [np.column_stack([s[0], zero + 6, zero]), np.column_stack([zero + 6, zero + 6, s[1]])]
    )
    return planes, edges


def room_maps() -> FeatureMaps:
    planes, edges = room(np.random.default_rng(0), 4000)
    plane_map, edge_map = FeatureMap(0.5, 1 << 12), FeatureMap(0.3, 1 << 10, reach=2)
    plane_map.insert(planes)
    edge_map.insert(edges)
    return FeatureMaps(edges=edge_map, planes=plane_map)


def test_algorithm_1_finds_the_pose_despite_outliers() -> None:
    rng = np.random.default_rng(1)
    maps = room_maps()
    planes, edges = room(rng, 300)
    planes[::10, 2] += 0.25
    truth = Pose(so3_exp(np.array([0.02, -0.01, 0.03])), np.array([0.1, -0.08, 0.05]))
    guess = Pose(np.eye(3), np.zeros(3))
    back = truth.inverse()
    result = register_scan(
        ScanFeatures(back.apply(edges), back.apply(planes)), maps,
        guess, 1e-3 * np.eye(6), edge_sigma_m=0.05, plane_sigma_m=0.02,
    )  # fmt: skip
    assert result is not None and result.edges > 200 and result.planes > 400
    np.testing.assert_allclose(result.pose.translation, truth.translation, atol=0.012)
    assert np.linalg.norm(so3_log(result.pose.rotation.T @ truth.rotation)) < 4e-3


def test_algorithm_1_needs_matches() -> None:
    empty = FeatureMap(0.5, 1 << 8)
    features = ScanFeatures(np.zeros((100, 3)), np.zeros((100, 3)))
    maps, sigmas = FeatureMaps(empty, empty), {"edge_sigma_m": 0.1, "plane_sigma_m": 0.1}
    assert register_scan(features, maps, Pose.identity(), np.eye(6), **sigmas) is None


def test_feature_map_returns_the_five_nearest_in_order_and_keeps_its_size() -> None:
    grid = FeatureMap(1.0, 1 << 4)
    line = np.column_stack([np.arange(9) + 0.5, np.full(9, 0.5), np.full(9, 0.5)])
    grid.insert(line[:5])
    found, *_ = grid.nearest(np.array([[2.4, 0.5, 0.5], [20.0, 0.0, 0.0]]))
    # the voxels around reach three of the five
    assert found.tolist() == [False, False]
    for dy in (0.0, 1.0):
        grid.insert(line[:5] + [0.0, dy, 0.0])
    found, near, *_ = grid.nearest(np.array([[2.4, 0.5, 0.5]]))
    assert found[0]
    distances = np.linalg.norm(near[0] - [2.4, 0.5, 0.5], axis=1)
    np.testing.assert_allclose(distances[:2], [0.1, 0.9])
    assert (np.diff(distances) >= 0).all()
    # the owner of them all has been moved by 0.3 m since
    grid, aside = FeatureMap(1.0, 1 << 4), Pose(np.eye(3), np.array([0.3, 0.0, 0.0]))
    grid.insert(np.repeat(line[:3], 2, axis=0) * [1.0, 1.0, 1.0], Seen(np.zeros(3), 0, STILL))
    grid.insert(line[:3] + [0.0, 1.0, 0.0], Seen(np.zeros(3), 0, STILL))
    _, near, *_ = grid.nearest(np.array([[1.4, 0.5, 0.5]]), Frames.of([aside]))
    np.testing.assert_allclose(near[0, :2], [[1.8, 0.5, 0.5], [0.8, 0.5, 0.5]])
    grid.insert(np.random.default_rng(0).uniform(0, 100, (500, 3)))
    assert grid.used <= 0.7 * 16 + 1


def texture(seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).uniform(0, 255, (60, 80)).astype(np.float32)
    smooth = cv2.resize(noise, (640, 480), interpolation=cv2.INTER_CUBIC)
    return np.clip(smooth, 0, 255).astype(np.uint8)


def test_landmarks_are_found_again_after_a_shift() -> None:
    detector = LandmarkDetector(300, 300)
    shifted = np.roll(texture(), (12, 20), axis=(0, 1))
    first, second = detector(texture()), detector(shifted)
    for kind in (SIFT, BRISK):
        assert len(first[kind]) > 150
        matched = match_near(
            kind, second[kind].pixels, second[kind].descriptors,
            first[kind].pixels + [20.0, 12.0], first[kind].descriptors, 8.0,
        )  # fmt: skip
        good = np.flatnonzero(matched >= 0)
        offset = second[kind].pixels[good] - first[kind].pixels[matched[good]]
        assert len(good) > 80 and np.abs(np.median(offset, axis=0) - [20.0, 12.0]).max() < 0.1
        assert len(np.unique(matched[good])) == len(good)


def test_a_spot_is_a_landmark_at_its_centre() -> None:
    centres = np.array([[90.25 * i, 80.5 * j] for i in range(1, 7) for j in range(1, 6)])
    v, u = np.mgrid[0:480, 0:640]
    away = (u[..., None] - centres[:, 0]) ** 2 + (v[..., None] - centres[:, 1]) ** 2
    image = (40 + 180 * np.exp(-away / (2 * 8.0**2)).sum(axis=-1)).astype(np.uint8)
    found = LandmarkDetector(300, 0)(image)[SIFT].pixels
    offsets = found[:, None] - centres
    nearest = np.linalg.norm(offsets, axis=2).argmin(axis=1)
    near = offsets[np.arange(len(found)), nearest]
    near = near[np.linalg.norm(near, axis=1) < 8.0]
    assert len(near) >= 30 and np.abs(np.median(near, axis=0)).max() < 0.3


def test_a_black_image_has_no_landmarks() -> None:
    features = LandmarkDetector(100, 100)(np.zeros((480, 640), np.uint8))
    assert [len(f) for f in features] == [0, 0]
    assert features[0].descriptors.shape == (0, 128) and features[1].descriptors.shape == (0, 64)


def test_spread_takes_the_best_of_every_cell_first() -> None:
    pixels = np.array([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0], [50.0, 1.0]])
    responses = np.array([1.0, 9.0, 8.0, 0.5])
    assert spread(pixels, responses, (64, 32), 32, 2).tolist() == [1, 3]
    assert spread(pixels, responses, (64, 32), 32, 3).tolist() == [1, 2, 3]
    assert len(spread(np.zeros((0, 2)), np.zeros(0), (64, 32), 32, 3)) == 0


def test_matching_refuses_the_far_the_unlike_and_the_ambiguous() -> None:
    known = np.zeros((3, 64), np.uint8)
    known[1] = 255
    expected = np.array([[100.0, 100.0], [104.0, 100.0], [200.0, 100.0]])
    pixels = np.array([[101.0, 100.0], [300.0, 100.0]])
    zero = np.zeros((2, 64), np.uint8)
    assert match_near(BRISK, pixels, zero, expected, known, 10.0).tolist() == [0, -1]
    half = np.full((2, 64), 15, np.uint8)
    assert match_near(BRISK, pixels, half, expected, known, 10.0).tolist() == [-1, -1]
    # two of the same looks within reach, ten pixels apart: neither is clearly better
    twins = np.zeros((2, 64), np.uint8)
    apart = np.array([[96.0, 100.0], [106.0, 100.0]])
    assert match_near(BRISK, pixels[:1], zero[:1], apart, twins, 20.0).tolist() in ([-1], [0])
    almost = twins.copy()
    almost[:, 0] = 3
    seen = np.full((1, 64), 0, np.uint8)
    assert match_near(BRISK, pixels[:1], seen, apart, almost, 20.0).tolist() == [-1]


def ground_points(rng: np.random.Generator, count: int) -> np.ndarray:
    return np.column_stack([rng.uniform(-9, 9, (count, 2)), rng.uniform(0, 0.5, count)])


def pixels_of(points: np.ndarray, pose: Pose) -> np.ndarray:
    return -reprojection_errors(np.zeros((len(points), 2)), points, pose, DOWN, CAMERA)


def test_pnp_recovers_the_pose_and_identifies_outliers() -> None:
    rng = np.random.default_rng(3)
    points = ground_points(rng, 120)
    truth = Pose(so3_exp(np.array([0.02, 0.03, 0.5])), np.array([0.3, -0.2, 20.0]))
    pixels = pixels_of(points, truth) + rng.normal(0, 0.3, (120, 2))
    way = rng.uniform(0.0, 2.0 * np.pi, 20)
    away = np.where(np.arange(20) < 10, 50.0, 6.0)
    pixels[:20] += away[:, None] * np.column_stack([np.cos(way), np.sin(way)])
    guess = Pose(truth.rotation @ so3_exp(np.array([0.004, 0.0, -0.01])), truth.translation + 0.15)
    sigmas = np.where(np.arange(120) % 2 == 0, 0.3, 0.5)
    solved = solve_pnp(pixels, points, sigmas, guess, LOOSE, DOWN, CAMERA)
    assert solved is not None and not solved.inliers[:20].any() and solved.inliers[20:].all()
    np.testing.assert_allclose(solved.pose.translation, truth.translation, atol=0.06)
    assert np.linalg.norm(so3_log(solved.pose.rotation.T @ truth.rotation)) < 3e-3
    assert solved.rms_px < 0.6
    assert solve_pnp(pixels[:20], points[:20], sigmas[:20], guess, LOOSE, DOWN, CAMERA) is None


FREE = np.array([np.inf] * 6)


def chain(count: int, step: Pose, information: float) -> PoseGraph:
    """So many poses, each a ``step`` from the one before."""
    graph, pose = PoseGraph(np.full(6, 1e-6), FREE), Pose.identity()
    for k in range(count):
        graph.add_node(k, pose, pose)
        if k:
            graph.add_edge(Edge(k - 1, k, step, information * np.eye(6), False))
        pose = pose @ step
    return graph


UNIT = Pose(np.eye(3), np.array([1.0, 0.0, 0.0]))


def test_a_turned_square_closes() -> None:
    """Odometry with 1 degree too much at every corner; the closure states the return to the
    start."""
    step = Pose(rotation_from_yaw(np.radians(91.0)), np.array([10.0, 0.0, 0.0]))
    graph = chain(5, step, 100.0)
    graph.add_edge(Edge(0, 4, Pose.identity(), np.eye(6) * 1e8, True))
    graph.optimise(10)
    np.testing.assert_allclose(graph.poses[4].translation, 0.0, atol=1e-3)
    assert np.linalg.norm(so3_log(graph.poses[4].rotation)) < 1e-3
    assert np.linalg.norm(graph.poses[2].translation[:2] - [10.0, 10.0]) < 0.2


def test_a_false_closure_is_outvoted() -> None:
    graph = chain(3, UNIT, 1e4)
    graph.add_edge(Edge(0, 2, Pose(np.eye(3), np.array([9.0, 0, 0])), 1e4 * np.eye(6), True))
    graph.optimise(5)
    assert graph.poses[2].translation[0] == pytest.approx(2.0, abs=0.01)


def test_a_removed_node_is_bridged() -> None:
    unit = Pose(rotation_from_yaw(0.1), np.array([1.0, 0.0, 0.0]))
    graph = chain(3, unit, 100.0)
    graph.remove_node(1)
    assert len(graph.edges) == 1
    bridge = graph.edges[0]
    assert (bridge.source, bridge.target) == (0, 2)
    np.testing.assert_allclose(bridge.measured.translation, (unit @ unit).translation)
    np.testing.assert_allclose(bridge.information, 50.0 * np.eye(6))


def test_level_priors_hold_height_and_tilt_against_drifting_edges() -> None:
    level = np.array([1e-4, 1e-4, np.inf, np.inf, np.inf, 1e-3])
    graph = PoseGraph(np.full(6, 1e-6), level)
    flat = Pose(np.eye(3), np.zeros(3))
    graph.add_node(0, flat, flat)
    drifting = Pose(so3_exp(np.array([0.0, 0.05, 0.0])), np.array([1.0, 0.0, 0.2]))
    graph.add_node(1, drifting, Pose(np.eye(3), np.array([1.0, 0.0, 0.0])))
    graph.add_edge(Edge(0, 1, drifting, np.eye(6), False))
    graph.optimise(5)
    assert graph.poses[1].translation[2] == pytest.approx(0.0, abs=1e-3)
    assert np.abs(so3_log(graph.poses[1].rotation)).max() < 1e-3
    assert graph.poses[1].translation[0] == pytest.approx(1.0, abs=1e-6)


def test_level_transform_takes_one_position_to_the_other() -> None:
    odom = Pose(rotation_from_yaw(0.3), np.array([3.0, 1.0, 9.0]))
    world = Pose(rotation_from_yaw(0.5), np.array([3.2, 1.1, 9.0]))
    moved = level_transform(odom, world)
    np.testing.assert_allclose(moved.apply(odom.translation), world.translation)
    np.testing.assert_allclose(so3_log(moved.rotation), [0.0, 0.0, 0.2], atol=1e-9)


def test_the_odometry_frame_moves_no_faster_than_allowed() -> None:
    closures = Closures(0.1, 0.01, MemoryLimits(1, 9, 1, 0.6))
    closures._target = Pose(rotation_from_yaw(0.02), np.array([0.3, 0.0, 0.0]))
    position = np.array([40.0, 0.0, 10.0])
    goal = closures._target.apply(position)
    before = position
    for _ in range(2000):
        after = closures.advance(position, 0.005).apply(position)
        assert np.linalg.norm(after - before) <= 0.1 * 0.005 + 1e-12
        before = after
    np.testing.assert_allclose(before, goal, atol=1e-6)
    assert so3_log(closures.world_from_odom.rotation)[2] == pytest.approx(0.02)
