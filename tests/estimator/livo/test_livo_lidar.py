"""Deskewing, the plane map and the point-to-plane update on hand-made geometry; degenerate
directions of scans, and their removal from the update.
"""

from unittest import mock

import numpy as np
import pytest

from touchdown.estimator.filtering.anchors import Anchors
from touchdown.estimator.filtering.deskew import ScanPath, place_scan, screen_scan, thin_out
from touchdown.estimator.filtering.error_state import STATE_DIM
from touchdown.estimator.filtering.eskf import (
    Eskf,
    limit_information,
    weak_directions,
    without_directions,
)
from touchdown.estimator.filtering.plane_map import PlaneMap, smallest_eigen
from touchdown.estimator.livo import scan_update
from touchdown.estimator.livo.depth_without_returns import common_plane
from touchdown.estimator.livo.scan_update import (
    DegeneracyWatch,
    LidarReport,
    ScanErrors,
    update_with_scan,
)
from touchdown.sim.api import LidarParams
from touchdown.sim.frames import Pose, so3_exp

from support.livo_support import placed, plane_information, room_points, state_at
from support.messages import make_scan


def test_deskew_brings_a_fixed_point_to_one_place() -> None:
    """A moving, turning sensor measures one world point again and again."""
    rng = np.random.default_rng(1)
    steps, count = 20, 4000
    times = np.linspace(0.0, 0.1, steps + 1)
    rate, velocity = np.array([0.4, -0.3, 0.5]), np.array([5.0, 1.0, -2.0])
    rotations = np.array([so3_exp(rate * t) for t in times])
    positions = times[:, None] * velocity
    mount = so3_exp(np.array([0.1, 3.0, 0.2]))
    lever = np.array([0.05, -0.02, -0.1])
    target = np.array([3.0, -4.0, -30.0])
    offsets = np.sort(rng.uniform(0.0, 0.1, count))
    directions, ranges = np.empty((count, 3)), np.empty(count)
    for i, t in enumerate(offsets):
        in_imu = so3_exp(rate * t).T @ (target - velocity * t)
        in_lidar = mount.T @ (in_imu - lever)
        ranges[i] = np.linalg.norm(in_lidar)
        directions[i] = in_lidar / ranges[i]
    scan = make_scan(60, directions, ranges, offsets, 0)
    pulses = screen_scan(scan, LidarParams())
    path = ScanPath(times, rotations, positions, steps)
    result = place_scan(scan, pulses, Pose(mount, lever), path)
    expected = rotations[-1].T @ (target - positions[-1])
    np.testing.assert_allclose(result.points, np.tile(expected, (count, 1)), atol=2e-4)
    np.testing.assert_allclose(np.linalg.norm(result.beams, axis=1), ranges, rtol=1e-4)


def test_screening_keeps_valid_returns_only() -> None:
    directions = np.tile(np.array([0.0, 0.0, 1.0]), (7, 1))
    ranges = np.array([0.0, np.nan, np.inf, 0.2, 7.0, 261.0, 5.0])
    offsets = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, np.nan])
    scan = make_scan(60, directions, ranges, offsets, 0)
    pulses = screen_scan(scan, LidarParams(min_range_m=0.5, max_range_m=260.0))
    np.testing.assert_array_equal(pulses, [4])
    path = ScanPath(np.array([0.0, 0.1]), np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)), 1)
    result = place_scan(scan, pulses, Pose.identity(), path)
    np.testing.assert_allclose(result.points, [[0.0, 0.0, 7.0]])
    np.testing.assert_array_equal(result.pulses, [4])


def test_thinning_keeps_one_point_a_cell() -> None:
    grid = np.stack(np.meshgrid(np.arange(10.0), np.arange(10.0), [0.0]), -1).reshape(-1, 3) + 0.5
    crowd = np.repeat(grid, 7, axis=0)
    np.testing.assert_array_equal(thin_out(crowd, 1.0, 16), np.arange(0, 700, 7))


def test_smallest_eigenvector_agrees_with_lapack() -> None:
    rng = np.random.default_rng(2)
    for _ in range(50):
        root = rng.normal(size=(3, 3)) * np.array([1.0, 0.3, 0.01])
        cov = root @ root.T
        values, vectors = np.linalg.eigh(cov)
        low, mid, high, *normal = smallest_eigen(cov)
        np.testing.assert_allclose([low, mid, high], values, rtol=1e-6, atol=1e-10)
        assert abs(np.dot(normal, vectors[:, 0])) == pytest.approx(1.0, abs=1e-6)


def tilted_plane(rng: np.random.Generator, count: int, noise_m: float) -> np.ndarray:
    """z = 0.1 x - 0.05 y + 0.02, noise along the normal."""
    xy = rng.uniform(-8.0, 8.0, (count, 2))
    normal = np.array([-0.1, 0.05, 1.0]) / np.sqrt(1.0125)
    points = np.column_stack([xy, 0.1 * xy[:, 0] - 0.05 * xy[:, 1] + 0.02])
    return points + rng.normal(0.0, noise_m, (count, 1)) * normal


def test_map_recovers_a_tilted_plane_also_across_voxel_faces() -> None:
    rng = np.random.default_rng(3)
    plane_map = PlaneMap(1.0, capacity=1 << 12, max_points=10_000)
    plane_map.insert(tilted_plane(rng, 40_000, 0.02))
    probes = tilted_plane(rng, 500, 0.02)
    probes = probes[np.abs(probes[:, :2]).max(axis=1) < 7.0]
    found, normals, centres, variances, *_ = plane_map.match(probes)
    assert found.mean() > 0.99
    truth = np.array([-0.1, 0.05, 1.0]) / np.sqrt(1.0125)
    alignment = np.abs(normals[found] @ truth)
    assert np.degrees(np.arccos(np.minimum(alignment, 1.0))).max() < 1.5
    # plane heights are unbiased: without merging, voxels cut by z = 0 would be off by 1.6 cm
    heights = (centres[found] - [0.0, 0.0, 0.02]) @ truth
    assert np.abs(heights).max() < 0.006
    np.testing.assert_allclose(np.sqrt(variances[found, 0]), 0.02, rtol=0.25)


def flat_voxel(height: float, spread_m: float = 0.0) -> np.ndarray:
    """An even grid of 400 points in one voxel of a metre; heights uniform within ``spread_m``."""
    x, y = np.meshgrid(np.arange(0.025, 1.0, 0.05), np.arange(0.025, 1.0, 0.05))
    z = height + spread_m * np.random.default_rng(0).uniform(-0.5, 0.5, x.size)
    return np.column_stack([x.ravel(), y.ravel(), z])


def test_a_plane_is_known_best_at_its_centre() -> None:
    """Its height errs by low / n there; a lean of low / (n mid) adds the distance squared."""
    plane_map = PlaneMap(1.0, capacity=1 << 8, max_points=400)
    points = flat_voxel(0.5, 0.04)
    plane_map.insert(points)
    _, _, _, variances, *_ = plane_map.match(np.array([[0.5, 0.5, 0.5], [0.8, 0.7, 0.5]]))
    low, mid = np.var(points[:, 2]), np.var(points[:, 0])
    np.testing.assert_allclose(variances[:, 0], low, rtol=0.02)
    # of the normal no more than 25 are independent
    np.testing.assert_allclose(variances[:, 2], low / (25 * mid), rtol=0.02)
    height = low / 400 * np.array([1.0, 1.0 + (0.3**2 + 0.2**2) / mid])
    np.testing.assert_allclose(variances[:, 1], height, rtol=0.03)


@pytest.mark.parametrize(("spread_m", "found"), [(0.15, True), (0.20, False)])
def test_foliage_is_no_plane(spread_m: float, found: bool) -> None:
    """Five centimetres of standard deviation are 17 of a uniform spread; nor is a line a plane."""
    plane_map = PlaneMap(1.0, capacity=1 << 8, max_points=400)
    plane_map.insert(flat_voxel(0.5, spread_m))
    plane_map.insert(flat_voxel(0.5) * [1.0, 0.005, 1.0] + [3.0, 0.5, 0.0])
    matched = plane_map.match(np.array([[0.5, 0.5, 0.5], [3.5, 0.5, 0.5]]))
    assert matched.found.tolist() == [found, False]


def test_a_full_voxel_keeps_its_first_returns() -> None:
    plane_map = PlaneMap(1.0, capacity=1 << 8, max_points=400)
    plane_map.insert(flat_voxel(0.5))
    plane_map.insert(flat_voxel(0.6))
    assert plane_map.match(np.array([[0.5, 0.5, 0.5]])).centres[0, 2] == pytest.approx(0.5)


@pytest.mark.parametrize(("count", "height", "owner"), [(11, 0.6, 1), (12, 0.5, 0)])
def test_a_voxel_holds_the_points_of_one_anchor(count: int, height: float, owner: int) -> None:
    """Of another, with fewer than twelve, it is taken over as if empty; with more it stays."""
    plane_map = PlaneMap(1.0, capacity=1 << 8, max_points=400)
    first = flat_voxel(0.5)[:: 400 // count][:count]
    plane_map.insert(first, np.array([1.0, 2.0, 3.0]), 0)
    plane_map.insert(flat_voxel(0.6), np.array([4.0, 5.0, 6.0]), 1)
    matched = plane_map.match(np.array([[0.5, 0.5, 0.5]]))
    assert matched.centres[0, 2] == pytest.approx(height)
    assert (matched.anchors[0], matched.sensors[0, 0]) == (owner, 1.0 + 3.0 * owner)


def test_map_memory_and_learning_are_bounded() -> None:
    rng = np.random.default_rng(4)
    plane_map = PlaneMap(1.0, capacity=1 << 8, max_points=20)
    for _ in range(3):
        plane_map.insert(rng.uniform(-50.0, 50.0, (5000, 3)))
    assert plane_map.used <= 0.7 * 256


@pytest.mark.parametrize(
    ("beam", "height", "thickness", "unsure", "floor", "weight"),
    [
        ((0, 0, -10), 0.0, 0.01, 0.0, 0.0, 1 / 4e-4),  # 2 cm of range noise
        ((0, 0, -10), 0.0, 0.03, 0.0, 0.0, 1 / 9e-4),  # rougher ground
        ((0, 0, -10), 0.0, 0.01, 0.02, 0.0, 1 / 8e-4),
        ((0, 0, -10), 0.0, 0.01, 0.0, 0.02, 1 / 8e-4),
        # at 45 degrees half of the range's, and a milliradian over 14 m
        ((10, 0, -10), 0.0, 0.01, 0.0, 0.0, 1 / 3e-4),
        ((0, 0, -10), 0.04, 0.01, 0.0, 0.0, 0.5 / 4e-4),  # two sigma: Cauchy's half weight
        ((0, 0, -10), 0.09, 0.01, 0.0, 0.0, 0.0),  # beyond the gate of four
    ],
)
def test_a_return_weighs_by_its_beam_its_plane_and_its_residual(
    beam: tuple[float, ...], height: float, thickness: float, unsure: float, floor: float,
    weight: float,
) -> None:  # fmt: skip
    point, up = np.array([beam], dtype=float), np.array([[0.0, 0.0, 1.0]])
    information, vector, used, *_ = plane_information(
        point, point, np.eye(3), np.zeros(3), np.array([True]), up, point - height * up,
        np.array([[thickness**2, unsure**2, 0.0]]), 0.02, 1e-3, floor, 4.0,
    )  # fmt: skip
    assert used == (weight > 0.0) and information[5, 5] == pytest.approx(weight, rel=1e-6)
    assert vector[5] == pytest.approx(-weight * height, rel=1e-6)


def test_floor_adds_its_covariance() -> None:
    rng = np.random.default_rng(6)
    root = rng.normal(size=(6, 8))
    information, errors = root @ root.T, np.diag([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    limited = limit_information(information, errors)
    np.testing.assert_allclose(np.linalg.inv(limited), np.linalg.inv(information) + errors)


@pytest.mark.parametrize("weak_sigmas", [None, (0.005, 0.1)])
@pytest.mark.parametrize("walls", [True, False])
def test_scan_update_recovers_a_known_offset(
    walls: bool, weak_sigmas: tuple[float, float] | None
) -> None:
    rng = np.random.default_rng(7)
    plane_map = PlaneMap(1.0, capacity=1 << 14)
    surfaces = room_points(rng, walls)
    plane_map.insert(surfaces + rng.normal(0.0, 0.01, surfaces.shape))
    true_rotation, true_position = so3_exp(np.array([0.02, -0.03, 0.1])), np.array([0.4, 1.0, 12.0])
    world = room_points(rng, walls)[::7]
    points = (world - true_position) @ true_rotation + rng.normal(0.0, 0.01, (len(world), 3))
    offset = np.array([0.004, -0.003, 0.002, 0.05, -0.04, 0.06])
    state = state_at(true_rotation @ so3_exp(offset[:3]), true_position + offset[3:])
    variances = np.full(STATE_DIM, 1e-6)
    variances[:3], variances[3:6] = 1e-4, 1e-2
    eskf = Eskf(state, variances)
    floor = 0.01 if walls else 0.5
    errors = ScanErrors(
        range_sigma_m=0.02, angle_sigma_rad=1e-3,
        floor_sigmas=np.array([1e-4, 1e-4, 1e-3, floor, floor, 1e-3]), weak_sigmas=weak_sigmas,
    )  # fmt: skip
    report = update_with_scan(eskf, plane_map, Anchors(), placed(points), errors)
    error = np.abs(eskf.state.position - true_position)
    assert report.matched > 0.7 * len(points)
    assert error[2] < 0.02  # the map's own noise is shared: its offset is the limit
    turn = eskf.state.rotation.T @ true_rotation
    assert abs(turn[2, 0]) < 5e-4 and abs(turn[2, 1]) < 5e-4
    left_out = not walls and weak_sigmas is not None
    weak = report.weak_translation, report.weak_rotation
    assert weak == ((2, 1) if left_out else (0, 0))
    if walls:
        assert error[0] < 0.02 and error[1] < 0.02
    else:
        # a plane leaves the lateral position unobserved, but the noise of the voxels' normals adds
        # spurious information: with the floor, prior and covariance stay
        np.testing.assert_allclose(error[:2], [0.05, 0.04], atol=5e-3)
        assert np.sqrt(eskf.covariance[3, 3]) > 0.09
    if left_out:  # x, y, yaw and their covariance stay; the ground as mapped leans by a hair
        np.testing.assert_allclose(error[:2], [0.05, 0.04], atol=1e-4)
        np.testing.assert_allclose(np.diag(eskf.covariance)[2:5], variances[2:5], rtol=2e-3)
    # from there on the returns stay on their planes; where nothing strays, two steps suffice
    equations = scan_update.plane_equations
    with (
        mock.patch.object(plane_map, "match", wraps=plane_map.match) as lookups,
        mock.patch.object(scan_update, "plane_equations", wraps=equations) as steps,
    ):
        update_with_scan(eskf, plane_map, Anchors(), placed(points), errors)
    assert (lookups.call_count, steps.call_count) == (1, 2 if walls or left_out else 3)


def test_too_few_matches_change_nothing() -> None:
    eskf = Eskf(state_at(np.eye(3), np.zeros(3)), np.ones(STATE_DIM))
    before = eskf.covariance.copy()
    points = np.random.default_rng(8).uniform(-5, 5, (100, 3))
    report = update_with_scan(
        eskf, PlaneMap(1.0, capacity=1 << 8), Anchors(), placed(points),
        ScanErrors(range_sigma_m=0.02, angle_sigma_rad=1e-3, floor_sigmas=np.ones(6)),
    )  # fmt: skip
    assert report.matched == 0
    np.testing.assert_array_equal(eskf.covariance, before)
    np.testing.assert_array_equal(eskf.state.position, np.zeros(3))


NOTHING = np.zeros((6, 6))


def test_rotation_and_translation_are_judged_each_in_its_own_unit() -> None:
    information = np.diag([1e6, 1e6, 100.0, 1.0, 1e4, 1e6])
    # 100 / rad^2 are 0.1 rad, 1 / m^2 is 1 m, 1e4 / m^2 are 1 cm
    axes, directions = weak_directions(information, NOTHING, 0.01, 0.1)
    np.testing.assert_allclose(np.abs(axes), [[0.0], [0.0], [1.0]])
    np.testing.assert_allclose(np.abs(directions), [[1.0], [0.0], [0.0]])
    axes, directions = weak_directions(information, NOTHING, 0.2, 2.0)
    assert axes.shape == (3, 0) and directions.shape == (3, 0)


def test_two_unknowns_of_one_equation_are_both_weak() -> None:
    """Yaw and x appear only as x + 10 m * yaw: of neither anything is known by itself."""
    row = np.array([0.0, 0.0, 10.0, 1.0, 0.0, 0.0])
    information = np.diag([1e6, 1e6, 0.0, 0.0, 1e6, 1e6]) + 1e6 * np.outer(row, row)
    axes, directions = weak_directions(information, NOTHING, 0.01, 0.1)
    np.testing.assert_allclose(np.abs(axes[:, 0]), [0.0, 0.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(np.abs(directions[:, 0]), [1.0, 0.0, 0.0], atol=1e-9)


def test_noise_does_not_count() -> None:
    information = np.diag([1e6, 1e6, 1e6, 1e4, 1e4, 1e6])
    noise = np.diag([0.0, 0.0, 0.0, 4.99e3, 4e3, 0.0])
    # twice the noise leaves 20 / m^2 of x, which are 0.22 m, and 2000 / m^2 of y
    _, directions = weak_directions(information, noise, 0.01, 0.1)
    np.testing.assert_allclose(np.abs(directions), [[1.0], [0.0], [0.0]])


def test_removal_equals_the_marginal_of_a_gaussian() -> None:
    """The marginal of a Gaussian: its covariance and its mean without the weak coordinate."""
    rng = np.random.default_rng(1)
    root = rng.normal(size=(6, 9))
    information, mean = root @ root.T, rng.normal(size=6)
    turn = np.zeros((6, 6))
    turn[:3, :3], turn[3:, 3:] = so3_exp(rng.normal(size=3)), so3_exp(rng.normal(size=3))
    weak, strong = turn[:, [1, 4]], turn[:, [0, 2, 3, 5]]
    left, gradient = without_directions(information, information @ mean, weak)
    np.testing.assert_allclose(left @ weak, 0.0, atol=1e-9)
    covariance = strong.T @ np.linalg.inv(information) @ strong
    np.testing.assert_allclose(np.linalg.inv(strong.T @ left @ strong), covariance, rtol=1e-8)
    solved = covariance @ strong.T @ gradient
    np.testing.assert_allclose(solved, strong.T @ mean, rtol=1e-8)


def test_noisy_normals_add_the_predicted_noise_information() -> None:
    """Level ground whose normals err by 0.01 rad about both axes."""
    rng = np.random.default_rng(2)
    count, sigma = 4000, 0.01
    points = np.column_stack([rng.uniform(-9, 9, (count, 2)), np.full(count, -12.0)])
    lean = rng.normal(0.0, sigma, (count, 2))
    normals = np.column_stack([lean, np.ones(count)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    variances = np.tile([4e-4, 0.0, sigma**2], (count, 1))
    arguments = (
        points, points, np.eye(3), np.array([0.0, 0.0, 12.0]), np.ones(count, np.bool_), normals,
        points + np.array([0.0, 0.0, 12.0]), variances, 0.02, 0.0, 0.0, 1e9,
    )  # fmt: skip
    seeming, _, _, _, noise_information = plane_information(*arguments)
    # 4000 / (2 cm)^2 * 0.01^2 = 1000 / m^2 in x and y, nothing in z
    np.testing.assert_allclose(np.diag(noise_information)[3:5], 1000.0, rtol=0.01)
    np.testing.assert_allclose(np.diag(seeming)[3:5], np.diag(noise_information)[3:5], rtol=0.06)
    assert noise_information[5, 5] < 1.0


def test_the_watch_reports_lasting_changes_only() -> None:
    def report(weak: int) -> LidarReport:
        return LidarReport(matched=99, weak_translation=weak, weak_rotation=weak // 2)

    watch = DegeneracyWatch(patience=3)
    said = [watch.events(report(weak)) for weak in (0, 2, 2, 0, 2, 2, 2, 2, 0, 0, 0, 0)]
    assert [i for i, text in enumerate(said) if text] == [6, 10]
    assert said[6] == [
        "the LIDAR does not measure translation along 2 axes and rotation about 1 axis"
    ]
    assert said[10] == ["the LIDAR measures the whole pose again"]
    turns = LidarReport(matched=99, weak_translation=0, weak_rotation=1)
    assert [watch.events(turns) for _ in range(3)][2] == [
        "the LIDAR does not measure rotation about 1 axis"
    ]


def water_and_raft(rng: np.random.Generator, raft_m: float) -> np.ndarray:
    """Camera frame, 25 m over level water: returns from right below, and from a raft of 4 x 6 m
    whose deck is ``raft_m`` nearer and gives four of five returns."""
    water = np.column_stack([rng.uniform(-7, 7, (1500, 2)), np.full(1500, 25.0)])
    water = water[(np.abs(water[:, 0]) > 2.0) | (np.abs(water[:, 1]) > 3.0)]
    deck = np.column_stack(
        [rng.uniform(-2, 2, 500), rng.uniform(-3, 3, 500), np.full(500, 25.0 - raft_m)]
    )
    both = np.vstack([water, deck])
    return both + rng.normal(0.0, 0.02, both.shape)


def test_the_plane_around_is_the_water_not_the_raft() -> None:
    plane = common_plane(water_and_raft(np.random.default_rng(3), 0.4))
    assert plane is not None
    np.testing.assert_allclose(plane, [0.0, 0.0, 1 / 25.0], atol=2e-5)


def test_no_plane_is_extended_where_something_lies_below_or_near_or_too_narrow() -> None:
    rng = np.random.default_rng(4)
    pit = water_and_raft(rng, -0.4)
    assert common_plane(pit) is None, "a hole"
    assert common_plane(0.5 * water_and_raft(rng, 0.4)) is None, "12.5 m high"
    strip = water_and_raft(rng, 0.0) * np.array([1.0, 0.1, 1.0])
    assert common_plane(strip) is None, "0.4 m wide"
    assert common_plane(water_and_raft(rng, 0.4)[:100]) is None, "too few"
    hills = np.column_stack([rng.uniform(-7, 7, (2000, 2)), rng.uniform(23.0, 27.0, 2000)])
    assert common_plane(hills) is None
