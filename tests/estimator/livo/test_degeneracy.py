"""Degenerate directions of scans, and their removal from the update."""

import numpy as np

from touchdown.estimator.filtering.eskf import weak_directions, without_directions
from touchdown.estimator.livo.depth_without_returns import common_plane
from touchdown.estimator.livo.scan_update import (
    DegeneracyWatch,
    LidarReport,
)
from touchdown.sim.frames import so3_exp

from support.livo_support import plane_information

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
