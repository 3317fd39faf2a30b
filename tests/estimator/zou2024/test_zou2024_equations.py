"""Every equation of the paper's positioning on a case worked out by hand."""

from typing import Any, NamedTuple

import numpy as np
import pytest

from touchdown.estimator.filtering.error_state import Frame
from touchdown.estimator.zou2024.depth_field import (
    STEP_ENERGY,
    colour_smoothness,
    geodesic_depth,
    geodesic_lengths,
    geodesic_transform,
    path_energy,
)
from touchdown.estimator.zou2024.estimator import nearest_image
from touchdown.estimator.zou2024.lidar_pose import (
    fused_smoothness,
    lidar_smoothness,
    sort_out_features,
)
from touchdown.estimator.zou2024.registration import (
    NO_ANCHORS,
    Matches,
    ScanEquations,
    edge_distance,
    line_and_plane_axes,
    line_weights,
    neighbourhood_shapes,
    plane_distance,
    relative_equations,
)
from touchdown.estimator.zou2024.structured_edges import GradientEdges
from touchdown.estimator.zou2024.visual_map import inside_image, project
from touchdown.sim.api import CameraImage
from touchdown.sim.frames import Pose


def test_eq_2_with_skew() -> None:
    matrix = np.array([[100.0, 10.0, 50.0], [0.0, 200.0, 40.0], [0.0, 0.0, 1.0]])
    pixels, front = project(np.array([[2.0, 1.0, 4.0], [1.0, 1.0, -1.0]]), matrix)
    # u = 100 * 0.5 + 10 * 0.25 + 50, v = 200 * 0.25 + 40
    np.testing.assert_allclose(pixels[0], [102.5, 90.0])
    assert front.tolist() == [True, False]
    assert inside_image(pixels, front, (200, 91)).tolist() == [True, False]
    assert inside_image(pixels, front, (200, 90)).tolist() == [False, False]


def test_the_image_nearest_in_time_is_taken() -> None:
    images = [
        CameraImage(tick=t, time_s=t / 600, rgb=np.zeros((1, 1, 3), np.uint8)) for t in (20, 60, 80)
    ]
    assert nearest_image(images, 65, 60) is images[1] and nearest_image(images, 70, 60) is images[1]
    assert nearest_image(images, 71, 60) is images[2] and nearest_image(images, 200, 60) is None


def test_eq_6_of_a_corner() -> None:
    # one laser scans x = -5..5 at z = 10, with a kerb of 1 m from x = 1 on
    x = np.arange(-5.0, 6.0)
    points = np.column_stack([x, np.zeros(11), np.where(x > 0, 9.0, 10.0)])
    scores, shadowed = lidar_smoothness(points, np.arange(11), 1, 8)
    # about the middle the x differences cancel, and the five raised ones give 5 * 1 m
    assert scores[5] == pytest.approx(5.0 / (10 * 10.0))
    # the end sees five neighbours alone
    assert np.isnan(scores[0]) and shadowed.tolist() == [i == 5 for i in range(11)]


def test_eq_6_of_a_straight_track_is_zero_and_gaps_end_it() -> None:
    points = np.column_stack([np.arange(30.0), np.zeros(30), np.full(30, 10.0)])
    scores, _ = lidar_smoothness(points, np.arange(30), 1, 8)
    np.testing.assert_allclose(scores[5:25], 0.0, atol=1e-12)
    broken = np.arange(30) + 100 * (np.arange(30) >= 15)
    scores, _ = lidar_smoothness(points, broken, 1, 8)
    # at the gap only five neighbours are left, three steps off it eight
    assert np.isnan(scores[14])
    # x differences -1..-5 and 1, 2: the sum is 3 + 4 + 5 to one side, over 7 and the range
    assert scores[12] == pytest.approx(12.0 / (7 * np.hypot(12.0, 10.0)))


def test_eq_6_keeps_the_lasers_apart() -> None:
    points = np.zeros((24, 3))
    points[:, 0] = np.arange(24) // 2
    points[:, 2] = np.where(np.arange(24) % 2 == 0, 10.0, 20.0)
    scores, _ = lidar_smoothness(points, np.arange(24), 2, 8)
    np.testing.assert_allclose(scores[10:14], 0.0, atol=1e-12)


def test_eq_7_and_returns_without_image() -> None:
    fused = fused_smoothness(np.array([0.1, 0.2]), np.array([5.0, np.nan]), 0.02)
    np.testing.assert_allclose(fused, [0.2, 0.2])


def test_features_are_sorted_out_by_sector() -> None:
    directions = np.array([[0.0, 0.0], [0.1, 0.0], [0.9, 0.0], [1.0, 0.0], [0.95, 0.0]])
    scores = np.array([0.001, 0.5, 0.002, 0.9, np.nan])
    chosen = sort_out_features(
        scores, np.zeros(5, dtype=bool), directions, cells=(2, 1), edges=1, edge_threshold=0.01
    )
    assert chosen.planes.tolist() == [0, 2] and chosen.edges.tolist() == [3]
    shaded = np.array([False, False, False, True, False])
    chosen = sort_out_features(
        scores, shaded, directions, cells=(2, 1), edges=1, edge_threshold=0.01
    )
    assert chosen.edges.tolist() == [1]


def step_image() -> np.ndarray:
    """A wall of energy 1 in column 4 of a 3 x 9 image."""
    energy = np.zeros((3, 9), dtype=np.float32)
    energy[:, 4] = 1.0
    return energy


class Around(NamedTuple):
    """Geodesic neighbourhoods of returns in row 1."""

    rows: np.ndarray
    cols: np.ndarray
    distance: np.ndarray
    label: np.ndarray
    neighbours: np.ndarray
    lengths: np.ndarray

    def smoothness(self) -> np.ndarray:
        return colour_smoothness(self.label, self.rows, self.cols, *self[4:])

    def depth(self, cols: list[int], depths: list[float], similarity: float) -> Any:
        at = np.ones(len(cols), np.int32), np.array(cols, np.int32)
        return geodesic_depth(*at, *self[2:], np.array(depths), similarity)


def around(energy: np.ndarray, cols: list[int], k: int) -> Around:
    seeds = np.ones(len(cols), np.int32), np.array(cols, np.int32)
    distance, label = geodesic_transform(energy, *seeds, 1)
    return Around(*seeds, distance, label, *geodesic_lengths(energy, distance, label, len(cols), k))


def test_eq_8_between_two_returns() -> None:
    assert path_energy(0.2, 0.6, 2.0) == pytest.approx(2.0 * (0.4 + STEP_ENERGY))
    found = around(step_image(), [0, 8], 3)
    assert found.label[1].tolist()[:4] == [0] * 4 and found.label[1].tolist()[5:] == [1] * 4
    neighbours, lengths = found.neighbours, found.lengths
    # eight steps; the wall is entered and left: twice half its energy
    expected = 8 * STEP_ENERGY + 1.0
    assert neighbours[0].tolist().count(1) == 1
    assert lengths[neighbours == 1] == pytest.approx(expected, rel=1e-5)
    assert lengths[neighbours == 0] == pytest.approx(expected, rel=1e-5)
    # one neighbour stands for all three
    np.testing.assert_allclose(found.smoothness(), 3 * expected, rtol=1e-5)


def test_eq_8_is_larger_at_a_boundary_than_on_either_side() -> None:
    score = around(step_image(), [0, 1, 2, 3, 5, 6, 7, 8], 2).smoothness()
    assert score[3] > 10 * score[1] and score[4] > 10 * score[6]


def test_geodesic_goes_round_an_obstacle() -> None:
    energy = np.zeros((5, 5), dtype=np.float32)
    energy[:4, 2] = 1.0
    seed = np.array([0], np.int32)
    distance, _ = geodesic_transform(energy, seed, seed, 2)
    # round the wall's lower end, four steps down and up, of which four are diagonal
    around = STEP_ENERGY * (4 + 4 * np.sqrt(2.0))
    assert distance[0, 4] == pytest.approx(around, rel=1e-5) and distance[0, 4] < 1.0


def test_returns_that_share_a_pixel_share_their_score() -> None:
    score = around(step_image(), [0, 0, 3], 2).smoothness()
    assert score[0] == score[1]


def test_eq_10_distances() -> None:
    origin, x, y = np.zeros(3), np.array([2.0, 0.0, 0.0]), np.array([0.0, 3.0, 0.0])
    point = np.array([7.0, 3.0, 4.0])
    assert edge_distance(point, origin, x) == pytest.approx(5.0)
    assert abs(plane_distance(point, origin, x, y)) == pytest.approx(4.0)


def test_lines_and_planes_by_their_eigenvalues() -> None:
    line = np.column_stack([np.arange(5.0), np.zeros(5), np.zeros(5)])
    square = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0.5, 0.5, 0]], dtype=float)
    blob = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1], [0, 0, 0]], dtype=float)
    near = np.stack([line + [0.0, 0.1, 0.0], square, blob, square])
    found = np.array([True, True, True, False])
    lines, planes, values = neighbourhood_shapes(near, found)
    assert lines.tolist() == [True, False, False, False]
    assert planes[1] and not planes[2] and not planes[3]
    # means of (i - 2)^2 and of 4 (1/2)^2
    np.testing.assert_allclose(values[:2], [[0.0, 0.0, 2.0], [0.0, 0.2, 0.2]], atol=1e-6)
    # barely a line, three times as thin, thin
    weights = line_weights(np.array([[0.0, 1.0, 3.0], [0.0, 1.0, 9.0], [0.0, 0.0, 1.0]]))
    np.testing.assert_allclose(weights, [0.0, 2.0 / 3.0, 1.0])


def test_noise_of_the_map_neither_pulls_nor_counts() -> None:
    """Corners of triangles on level ground err by 1 cm in height; the point lies beside them, where
    its coordinates are 2, -1/2 and -1/2."""
    rng, count, sigma = np.random.default_rng(2), 6000, 0.01
    near = np.tile([[0.0, 0, 0], [0, 0, 0], [0.6, 0, 0], [0, 0, 0], [0, 0.6, 0]], (count, 1, 1))
    near[..., 2] += rng.normal(0.0, sigma, (count, 5))
    axes = line_and_plane_axes(near, np.zeros(count, np.bool_))
    axes *= np.sign(axes[:, 2:])
    points, none = np.tile([-0.3, -0.3, 0.0], (count, 1)), np.full(count, -1)

    def equations(scatter: float) -> ScanEquations:
        found = Matches(
            points, near, axes, none == 0, none, points, np.ones(count), np.full(count, scatter)
        )
        still = Frame.of(Pose.identity())
        return relative_equations(found, np.zeros(3), still, NO_ANCHORS, 0, 0, np.ones(2), True)

    # 2 / 0.6 + 2 (1/2) / 0.6 towards the middle, about one in count
    pull = count * sigma**2 * 2.5 / 0.6
    np.testing.assert_allclose(equations(0.0).vector[3:5], pull, rtol=0.1)
    np.testing.assert_allclose(equations(sigma**2).vector[3:5], 0.0, atol=0.1 * pull)
    information, _, noise = equations(sigma**2)
    np.testing.assert_allclose(np.diag(noise)[3:5], 2 * count * (sigma / 0.6) ** 2, rtol=0.01)
    np.testing.assert_allclose(np.diag(information)[3:5], np.diag(noise)[3:5], rtol=0.06)


def test_eq_12_prefers_the_depth_on_the_same_side_of_a_boundary() -> None:
    depth, spread = around(step_image(), [1, 7], 2).depth([3, 6], [10.0, 20.0], 0.15)
    first, between = 2 * STEP_ENERGY, 6 * STEP_ENERGY + 1.0
    near, far = np.exp(-first / 0.15), np.exp(-(first + between) / 0.15)
    assert depth[0] == pytest.approx((10.0 * near + 20.0 * far) / (near + far), rel=1e-4)
    assert depth[0] < 10.1 and depth[1] > 19.9 and spread[0] < 0.5


def test_eq_12_of_an_even_surface_is_the_mean_and_open_where_no_return_is_near() -> None:
    even = around(np.zeros((3, 5), dtype=np.float32), [1, 3], 1)
    assert even.depth([1], [4.0, 6.0], 1e6)[0] == pytest.approx(5.0, abs=1e-4)
    assert np.isnan(around(np.ones((3, 9), dtype=np.float32), [0], 2).depth([8], [1.0], 0.15)[0])


def test_gradient_edges_lie_on_the_boundary() -> None:
    rgb = np.full((40, 40, 3), 60, dtype=np.uint8)
    rgb[:, 20:, 2] = 200
    energy = GradientEdges()(rgb)
    assert energy.shape == (40, 40) and energy.dtype == np.float32
    assert energy.min() >= 0.0 and energy.max() <= 1.0 and energy[20, 19:21].min() > 0.8
    assert energy[:, :12].max() == 0.0 and energy[:, 28:].max() == 0.0
