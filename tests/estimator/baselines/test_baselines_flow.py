"""Shifts, flow and displacement on images of known motion."""

import cv2
import numpy as np
import pytest

from touchdown.estimator.baselines.ground_flow import (
    level_directions,
    phase_shift,
    pixels_of,
    solve_displacement,
)
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import BODY_FROM_DOWNWARD_OPTICAL, so3_exp

from support.baselines_support import texture

CAMERA = CameraIntrinsics(width=320, height=240, fx=250.0, fy=250.0, cx=159.5, cy=119.5)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (-17.0, 11.0), (41.0, 30.0), (5.3, -2.6)])
def test_phase_correlation_finds_shifts_and_fractions_of_them(shift: tuple[float, float]) -> None:
    big = texture(400)
    move = np.float32([[1, 0, shift[0]], [0, 1, shift[1]]])
    moved = cv2.warpAffine(big, move, (400, 400), flags=cv2.INTER_CUBIC)
    found = phase_shift(big[72:328, 72:328].copy(), moved[72:328, 72:328].copy())
    assert found.response > 0.3
    np.testing.assert_allclose(found.pixels, shift, atol=0.15)


def test_phase_correlation_has_no_response_without_overlap() -> None:
    found = phase_shift(texture(256, 1), texture(256, 2))
    assert found.response < 0.2
    blank = np.full((256, 256), 90, np.uint8)
    assert phase_shift(blank, blank).response == 0.0


def test_level_directions_do_not_depend_on_the_attitude() -> None:
    tilted = so3_exp(np.array([0.1, -0.2, 0.7])) @ BODY_FROM_DOWNWARD_OPTICAL
    point = np.array([[1.5, -2.0]])
    pixels = pixels_of(point, CAMERA, tilted)
    np.testing.assert_allclose(level_directions(pixels, CAMERA, tilted), point, atol=1e-12)
    straight = level_directions(np.array([[159.5, 119.5]]), CAMERA, BODY_FROM_DOWNWARD_OPTICAL)
    np.testing.assert_allclose(straight, 0.0, atol=1e-12)


def test_displacement_of_exact_directions() -> None:
    """From 10 m, 0.4 m east, 0.3 m north, 0.5 m up: the ground moves the other way and shrinks."""
    before = np.random.default_rng(0).uniform(-0.5, 0.5, (60, 2))
    now = (10.0 * before - [0.4, 0.3]) / 10.5
    found = solve_displacement(before, now, 10.0, 1e-3)
    assert found is not None
    np.testing.assert_allclose(found.translation, [-0.4, -0.3, -0.5], atol=1e-9)
    assert found.used == 60


def test_displacement_survives_a_third_of_wrong_flow() -> None:
    rng = np.random.default_rng(1)
    before = rng.uniform(-0.5, 0.5, (90, 2))
    now = before - [0.04, -0.02] + 1e-4 * rng.standard_normal((90, 2))
    now[:30] += rng.uniform(0.05, 0.2, (30, 2))
    found = solve_displacement(before, now, 20.0, 1e-3)
    assert found is not None
    np.testing.assert_allclose(found.translation[:2], [-0.8, 0.4], atol=0.01)
    assert solve_displacement(before[:5], now[:5], 20.0, 1e-3) is None
    assert solve_displacement(np.full((40, 2), np.nan), now[:40], 20.0, 1e-3) is None
    assert solve_displacement(before, now, -1.0, 1e-3) is None


def test_attitude_errors_enter_the_displacement_by_its_jacobians() -> None:
    """Directions seen under a wrong attitude give a wrong shift; the true one follows from it by
    the derivatives."""
    rng = np.random.default_rng(2)
    before = rng.uniform(-0.5, 0.5, (200, 2))
    now = (10.0 * before + [0.3, -0.2]) / 10.0
    exact = solve_displacement(before, now, 10.0, 1e-3)
    assert exact is not None
    for which in ("before", "now"):
        error = np.array([2e-4, -1e-4, 3e-4])
        wrong = {"before": before, "now": now}
        rays = np.column_stack([wrong[which], -np.ones(200)]) @ so3_exp(error)
        wrong[which] = rays[:, :2] / -rays[:, 2:]
        found = solve_displacement(wrong["before"], wrong["now"], 10.0, 1e-3)
        assert found is not None
        jacobian = found.by_rotation_before if which == "before" else found.by_rotation_now
        np.testing.assert_allclose(
            found.translation + jacobian @ error, exact.translation, atol=2e-5
        )
