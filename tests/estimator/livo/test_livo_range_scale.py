"""The rangefinder gives the way since a keyframe its length while depths are assumed."""

import numpy as np
import pytest

from touchdown.estimator.api import LivoParams
from touchdown.estimator.filtering.error_state import STATE_DIM
from touchdown.estimator.filtering.eskf import Eskf
from touchdown.estimator.filtering.imu_propagation import NavState
from touchdown.estimator.livo.depth_without_returns import SeenGround, update_with_range

Array = np.ndarray
SPOT = np.array([0.5, -0.3, 30.0])
"""camera frame"""
SIGMA_M = 0.3
"""of the way, along each axis"""
SIGMA = 0.01
PARAMS = LivoParams(range_scale_sigma=SIGMA)


def flown(way: Array) -> Eskf:
    """A keyframe at the origin, known, and the present at ``way``, known to 0.3 m."""
    zero = np.zeros(3)
    eskf = Eskf(NavState(0, np.eye(3), zero, zero, zero, zero), np.full(STATE_DIM, 1e-12))
    eskf.add_clone()
    eskf.state = NavState(60, np.eye(3), way.copy(), zero, zero, zero)
    eskf.covariance[3:6, 3:6] += SIGMA_M**2 * np.eye(3)
    return eskf


def ground(way: Array, depths: Array, keyframe: int = 0) -> SeenGround:
    """Landmarks at these depths within 2 m of the beam."""
    aside = 2.0 * np.column_stack([np.cos(np.arange(len(depths))), np.sin(np.arange(len(depths)))])
    rays = np.column_stack([(aside + SPOT[:2]) / SPOT[2], np.ones(len(depths))])
    return SeenGround(keyframe, way, rays * depths[:, None])


def test_the_way_grows_as_the_range_is_longer_than_the_depths() -> None:
    """8 m aside with landmarks at 29.1 m, where the beam measures 30: the way is 3 % too short.
    The measurement is one of the length alone."""
    way = np.array([4.8, 6.4, 0.0])
    eskf = flown(way)
    depths = np.full(7, 30.0 * np.exp(-0.03))
    assert update_with_range(eskf, [ground(way, depths)], SPOT, PARAMS)
    gain = (SIGMA_M / 8.0) ** 2 / ((SIGMA_M / 8.0) ** 2 + SIGMA**2)
    np.testing.assert_allclose(eskf.state.position, way * (1.0 + 0.03 * gain), atol=1e-6)
    along = way / 8.0 @ eskf.covariance[3:6, 3:6] @ way / 8.0
    assert along == pytest.approx((1.0 - gain) * SIGMA_M**2, rel=1e-6)
    np.testing.assert_allclose(eskf.covariance[5, 5], SIGMA_M**2, rtol=1e-6)
    np.testing.assert_allclose(eskf.clones[0].translation, 0.0, atol=1e-6)


def test_where_landmarks_scatter_the_range_says_little() -> None:
    way = np.array([8.0, 0.0, 0.0])
    eskf = flown(way)
    depths = 30.0 * np.exp(np.array([-0.13, -0.08, -0.03, 0.02, 0.07]))
    assert update_with_range(eskf, [ground(way, depths)], SPOT, PARAMS)
    variance = SIGMA**2 + (1.4826 * 0.05) ** 2
    gain = (SIGMA_M / 8.0) ** 2 / ((SIGMA_M / 8.0) ** 2 + variance)
    assert eskf.state.position[0] == pytest.approx(8.0 * (1.0 + 0.03 * gain), abs=1e-6)


def test_the_keyframe_of_the_longest_way_moves_against_the_present() -> None:
    """Two keyframes, both known to 0.3 m and the present exactly: the one further off moves."""
    eskf = flown(np.array([8.0, 0.0, 0.0]))
    eskf.covariance[3:6, 3:6] = 1e-12 * np.eye(3)
    eskf.add_clone()
    for k in (0, 1):
        position = eskf.clone_indices(k)[3:]
        eskf.covariance[position, position] += SIGMA_M**2
    near = ground(np.array([4.0, 0.0, 0.0]), np.full(9, 30.0), keyframe=1)
    far = ground(np.array([8.0, 0.0, 0.0]), np.full(9, 30.0 * np.exp(-0.03)), keyframe=0)
    before = eskf.clones[1].translation.copy()
    assert update_with_range(eskf, [near, far], SPOT, PARAMS)
    gain = (SIGMA_M / 8.0) ** 2 / ((SIGMA_M / 8.0) ** 2 + SIGMA**2)
    assert eskf.clones[0].translation[0] == pytest.approx(-8.0 * 0.03 * gain, abs=1e-6)
    np.testing.assert_allclose(eskf.clones[1].translation, before, atol=1e-9)


@pytest.mark.parametrize(
    ("depths", "way_m", "aside"),
    [
        (np.full(7, 25.0), 8.0, 0.0),  # a crown beside the beam
        (np.full(3, 29.1), 8.0, 0.0),  # too few
        (np.full(7, 29.1), 2.5, 0.0),  # too short a way
        (np.full(7, 29.1), 8.0, 6.0),  # other ground
    ],
)
def test_what_is_not_the_ground_below_the_beam_measures_nothing(
    depths: Array, way_m: float, aside: float
) -> None:
    way = np.array([way_m, 0.0, 0.0])
    eskf = flown(way)
    before = eskf.covariance.copy()
    seen = ground(way, depths)
    seen = seen._replace(points=seen.points + [aside, 0.0, 0.0])
    assert not update_with_range(eskf, [seen], SPOT, PARAMS)
    np.testing.assert_array_equal(eskf.state.position, way)
    np.testing.assert_array_equal(eskf.covariance, before)
