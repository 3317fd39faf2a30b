"""Figures of merit against values worked out by hand."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from touchdown.estimator.api import GridMap
from touchdown.experiments.flight import result
from touchdown.experiments.flight.metrics import (
    NEES_LIMIT,
    Consistency,
    GroundMap,
    PositioningError,
    TouchdownWindow,
    TrajectoryDeviation,
    fit_plane,
    levelness_error_deg,
)
from touchdown.experiments.flight.result import _map_figures
from touchdown.sim.frames import Pose, rotation_from_yaw, so3_exp

from support.flight_fakes import LEG_ON_LAWN, make_truth
from support.landing_support import grid_of_returns


def test_positioning_error_of_two_samples() -> None:
    error = PositioningError()
    error.add(Pose(np.eye(3), np.array([3.0, 0.0, 4.0])), Pose.identity())
    error.add(Pose(rotation_from_yaw(0.2), np.array([0.0, 1.0, 0.0])), Pose.identity())
    summary = error.summary()
    assert summary.mean == pytest.approx(3.0)
    assert summary.rmse == pytest.approx(np.sqrt((25 + 1) / 2))
    assert summary.max == pytest.approx(5.0)
    assert (summary.x, summary.y, summary.z) == pytest.approx((1.5, 0.5, 2.0))
    assert summary.yaw_deg == pytest.approx(np.degrees(0.1))


def test_errors_of_the_heading_take_the_shorter_way() -> None:
    error = PositioningError()
    error.add(Pose(rotation_from_yaw(3.1), np.zeros(3)), Pose(rotation_from_yaw(-3.1), np.zeros(3)))
    assert error.summary().yaw_deg == pytest.approx(np.degrees(2.0 * np.pi - 6.2))


def test_trajectory_deviation_mean_and_variance() -> None:
    deviation = TrajectoryDeviation()
    for distance in (1.0, 2.0, 3.0):
        deviation.add(make_truth(0.0, [distance, 0.0, 0.0]), np.zeros(3))
    assert deviation.mean == pytest.approx(2.0)
    assert deviation.variance == pytest.approx(2.0 / 3.0)
    assert deviation.largest == pytest.approx(3.0)


def test_touchdown_window_keeps_only_the_last_half_second() -> None:
    window = TouchdownWindow(steps_per_s=10.0)
    for step in range(20):
        speed = -5.0 if step < 15 else -0.2
        truth = make_truth(
            step / 10, [0, 0, 1], velocity_world=np.array([0.03, 0.04, speed]),
            acceleration_world=np.array([0.0, 0.0, -0.1]),
        )  # fmt: skip
        window.add_before(truth)
    window.first_contact(make_truth(2.0, [4.0, 5.0, 0.3], contacts=LEG_ON_LAWN))
    for height, tilt_deg in ((0.30, 1.0), (0.28, 3.0), (0.31, 2.0), (0.28, 0.0)):
        rotation = so3_exp(np.array([0.0, np.radians(tilt_deg), 0.0]))
        pose = Pose(rotation, np.array([4.0, 5.0, height]))
        window.add_after(make_truth(
            2.1, pose.translation, world_from_body=pose, peak_contact_accel=10 * height
        ))  # fmt: skip
    assert window.summary() == pytest.approx({
        "vertical_speed_mps": 0.2, "horizontal_speed_mps": 0.05, "vertical_accel_mps2": 0.1,
        "bounce_m": 0.03, "impact_peak_mps2": 3.1, "tilt_deg": 3.0,
    })  # fmt: skip
    assert window.contact_xy is not None
    np.testing.assert_array_equal(window.contact_xy, [4.0, 5.0])


def test_plane_fit_of_a_ramp() -> None:
    xy = np.random.default_rng(0).uniform(-1, 1, size=(50, 2))
    ramp = np.column_stack([xy, np.tan(np.radians(10.0)) * xy[:, 0] + 3.0])
    fit = fit_plane(ramp)
    assert fit.normal == pytest.approx([-np.sin(np.radians(10)), 0, np.cos(np.radians(10))])
    assert fit.residual_m < 1e-12


def test_levelness_error_of_a_map_tilted_by_two_degrees() -> None:
    shape, cell = (50, 50), 0.2
    columns = (np.arange(50) + 0.5) * cell
    heights = np.broadcast_to(np.tan(np.radians(2.0)) * columns, shape).astype(np.float32)
    ones = np.ones(shape, np.float32)
    grid = GridMap(
        origin_xy_m=np.zeros(2), cell_m=cell, count=10 * ones, height_m=heights,
        height_std_m=ones, min_height_m=heights, max_height_m=heights,
        rgb=np.zeros((*shape, 3), np.float32), intensity=ones, missing=0 * ones, last_seen_s=ones,
    )  # fmt: skip

    def level_ground(xy: np.ndarray, radius: float) -> np.ndarray:
        offsets = np.random.default_rng(1).uniform(-radius, radius, size=(60, 2))
        return np.column_stack([xy + offsets, np.zeros(60)])

    # a vehicle that left the scene maps ground beyond its edge
    assert levelness_error_deg(grid, lambda xy, radius: np.zeros((0, 3)), seed=3).shape == (0,)
    errors = levelness_error_deg(grid, level_ground, seed=3)
    assert errors.shape == (10,)
    np.testing.assert_allclose(errors, 2.0, atol=1e-3)

    def sloping(degrees: float) -> Callable[[np.ndarray, float], np.ndarray]:
        def ground(xy: np.ndarray, radius: float) -> np.ndarray:
            points = level_ground(xy, radius)
            points[:, 2] = np.tan(np.radians(degrees)) * points[:, 0]
            return points

        return ground

    np.testing.assert_allclose(levelness_error_deg(grid, sloping(2.0), seed=3), 0.0, atol=1e-3)
    np.testing.assert_allclose(levelness_error_deg(grid, sloping(-1.0), seed=3), 3.0, atol=1e-3)
    assert levelness_error_deg(grid, sloping(16.0), seed=3).size == 0

    def rough_ground(xy: np.ndarray, radius: float) -> np.ndarray:
        points = level_ground(xy, radius)
        points[::2, 2] = 0.2
        return points

    assert levelness_error_deg(grid, rough_ground, seed=3).size == 0


def test_nees_of_known_errors() -> None:
    """An error of (1, 2, 2) standard deviations has NEES 9."""
    nees = Consistency()
    assert nees.summary().model_dump() == {
        "median": None, "mean": None, "below_14_2": None, "samples": 0, "sigma_m": None,
        "sigma_z_m": None,
    }  # fmt: skip
    covariance = np.diag([0.01, 0.04, 0.25])
    nees.add(np.array([0.1, 0.4, 1.0]), np.zeros(3), covariance)
    nees.add(np.array([0.0, 0.0, 5.0]), np.zeros(3), covariance)  # 100
    nees.add(np.array([0.1, 0.0, 0.0]), np.zeros(3), covariance)  # 1
    summary = nees.summary()
    assert summary.mean == pytest.approx(110.0 / 3.0)
    assert summary.sigma_m == pytest.approx(np.sqrt(0.3)) and summary.sigma_z_m == pytest.approx(
        0.5
    )
    assert summary.median == pytest.approx(9.0, rel=0.05)
    assert summary.below_14_2 == pytest.approx(2.0 / 3.0) and summary.samples == 3


def test_nees_of_a_consistent_estimator_is_chi_square() -> None:
    rng = np.random.default_rng(5)
    root = rng.normal(size=(3, 3))
    nees = Consistency()
    for error in rng.normal(size=(4000, 3)):
        nees.add(root @ error, np.zeros(3), root @ root.T)
    summary = nees.summary()
    assert summary.median == pytest.approx(2.366, rel=0.08)
    assert summary.mean == pytest.approx(3.0, rel=0.06)
    assert NEES_LIMIT == 14.2 and summary.below_14_2 == pytest.approx(0.9973, abs=0.003)


def test_a_singular_covariance_is_overconfidence() -> None:
    nees = Consistency()
    nees.add(np.ones(3), np.zeros(3), np.zeros((3, 3)))
    assert nees.summary().below_14_2 == 0.0


def test_levelness_is_that_of_the_ground_under_plants(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows of a meadow a metre wide, on level ground."""
    rng = np.random.default_rng(2)
    rows = np.where(np.arange(60) // 5 % 2 == 0, 0.25, 0.0)
    leaves = np.maximum(1.0 + np.log(rng.random((30, 60, 60))) / 0.85, 0.0)
    grid = grid_of_returns(leaves * rows + 0.025 * rng.standard_normal((30, 60, 60)))

    def level(_lookup: object, xy: Any, radius: float) -> Any:
        across = np.linspace(-radius, radius, 9)
        x, y = np.meshgrid(xy[0] + across, xy[1] + across)
        return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])

    monkeypatch.setattr(result.TruthLookup, "surface_points", level)
    stack: Any = SimpleNamespace(scene=None)
    judgement: Any = SimpleNamespace(survey_s=36.0)
    before = result.levelness_error_deg(grid, lambda xy, r: level(None, xy, r), 3)
    found = _map_figures(stack, judgement, GroundMap.of(grid), 3)
    assert before.mean() > 1.0
    assert found.levelness_error_deg.mean is not None and found.levelness_error_deg.mean < 0.4
    assert found.density_per_m2 == pytest.approx(30 / 0.04)
