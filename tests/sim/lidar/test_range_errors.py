"""Bias of ranges with echo power and incidence, and noise that grows as echoes get weaker."""

import dataclasses
import math

import numpy as np
import pytest

from touchdown.scenes.api import Surface
from touchdown.sim.api import LidarParams, LidarScan
from touchdown.sim.lidar.patterns import HORIZON
from touchdown.sim.lidar.range_errors import FRACTIONS, SMEAR_M, RangeErrors
from touchdown.sim.lidar.sensor import LidarSensor, fired_directions

from support.lidar_support import DOWN, PERFECT, PLANE, TICK_HZ, make_scene, track

TICKS = (0, 120)


def _scan(params: LidarParams, height: float, reflectivity: float, seed: int = 5) -> LidarScan:
    """Level ground seen from above."""
    surface = Surface(land_class="field", reflectivity=reflectivity)
    sensor = LidarSensor(make_scene(PLANE, {"plane": surface}), params, seed)
    return sensor.scan(*TICKS, TICK_HZ, track(TICKS, height), DOWN, {})


def _errors(params: LidarParams, seed: int = 5) -> RangeErrors:
    errors = RangeErrors.of(params, HORIZON, seed)
    assert errors is not None
    return errors


def _at(*values: float) -> list[np.ndarray]:
    return [np.array([value]) for value in values]


def test_nothing_is_drawn_or_changed_without_bias_and_growth() -> None:
    assert RangeErrors.of(LidarParams(), HORIZON, 5) is None
    plain = _scan(LidarParams(), 30.0, 0.4)
    tiny = _scan(LidarParams(range_bias_m=1e-12), 30.0, 0.4)
    np.testing.assert_allclose(plain.ranges, tiny.ranges, atol=1e-5)
    np.testing.assert_array_equal(plain.intensity, tiny.intensity)


@pytest.mark.parametrize("growth", [0.2, 0.5])
def test_noise_variance_follows_the_power_of_the_echo(growth: float) -> None:
    """Vertical pulses: variance s^2 (1 - g + g (r/20)^2 0.8 / reflectivity)."""
    params = LidarParams(angle_sigma_deg=0.0, divergence=False, range_noise_growth=growth)
    for height, reflectivity in ((20.0, 0.8), (30.0, 0.4), (60.0, 0.8), (10.0, 0.2)):
        noisy = _scan(params, height, reflectivity)
        exact = _scan(dataclasses.replace(params, range_sigma_m=0.0), height, reflectivity)
        near = (noisy.ranges > 0) & (noisy.directions[:, 2] > math.cos(math.radians(10.0)))
        spread = (noisy.ranges - exact.ranges)[near].std()
        fraction = 1.0 - growth + growth * (height / 20.0) ** 2 * 0.8 / reflectivity
        assert spread == pytest.approx(0.02 * math.sqrt(fraction), rel=0.05)
        known = _errors(params).noise_sigma_m(*_at(height, reflectivity))
        assert known == pytest.approx(0.02 * math.sqrt(fraction))


def test_bias_curve_in_a_scan_is_the_known_one() -> None:
    params = dataclasses.replace(PERFECT, range_bias_m=0.02)
    errors = _errors(params)
    for height, reflectivity in ((10.0, 0.5), (30.0, 0.14), (50.0, 0.8)):
        scan, exact = _scan(params, height, reflectivity), _scan(PERFECT, height, reflectivity)
        cosine = scan.directions[:, 2].astype(np.float64)
        found = scan.ranges > 0
        level = scan.intensity[found] / 150.0
        expected = errors.bias_m(exact.ranges[found].astype(float), level, cosine[found])
        np.testing.assert_allclose((scan.ranges - exact.ranges)[found], expected, atol=1e-5)


def test_bias_parts_by_hand() -> None:
    errors = RangeErrors(
        constant_m=0.003, walk_m=0.008, incidence_m=-0.006, sigma_m=0.02, growth=0.0,
        half_width_rad=math.radians(0.14), min_range_m=0.5,
    )  # fmt: skip
    assert errors.bias_m(*_at(20.0, 0.8, 1.0)) == pytest.approx(0.003)
    # 1.5 decades weaker: the whole of the walk; more than that: no more
    assert errors.bias_m(20.0, 0.8 / 10**1.5, 1.0) == pytest.approx(0.011)
    assert errors.bias_m(20.0, 0.8 / 10**1.8, 1.0) == pytest.approx(0.011)
    assert errors.bias_m(20.0 * 10**0.375, 0.8, 1.0) == pytest.approx(0.007)
    # half the incidence's part where the echo is smeared by SMEAR_M
    tangent = SMEAR_M / (20.0 * math.radians(0.14))
    cosine = math.cos(math.atan(tangent))
    assert errors.bias_m(*_at(20.0, 0.8, cosine)) == pytest.approx(0.000, abs=1e-9)


def test_bias_is_bounded_constant_over_a_flight_and_differs_between_flights() -> None:
    params = LidarParams(range_bias_m=0.02)
    assert sum(FRACTIONS) == pytest.approx(1.0)
    drawn = [_errors(params, seed) for seed in range(200)]
    assert drawn[7] == _errors(params, 7)
    for errors in drawn:
        for where in ((1.0, 0.9, 1.0), (30.0, 0.1, 0.5), (200.0, 0.01, 0.1)):
            assert abs(errors.bias_m(*_at(*where))) <= 0.02
    for name, fraction in zip(("constant_m", "walk_m"), FRACTIONS, strict=False):
        values = np.array([getattr(errors, name) for errors in drawn])
        assert abs(values.mean()) < 0.1 * 0.02 * fraction * 2
        assert values.std() == pytest.approx(0.02 * fraction / math.sqrt(3.0), rel=0.1)
    assert all(-0.02 * FRACTIONS[2] <= errors.incidence_m < 0.0 for errors in drawn)


def test_errors_apply_to_split_beams_and_keep_the_minimum_range() -> None:
    edge = '<geom name="box" type="box" size="4 4 2"/>' + PLANE
    params = dataclasses.replace(PERFECT, divergence=True, range_bias_m=0.05)
    scenes = make_scene(edge)
    biased = LidarSensor(scenes, params, 1).scan(*TICKS, TICK_HZ, track(TICKS, 12.0), DOWN, {})
    plain = LidarSensor(scenes, dataclasses.replace(params, range_bias_m=0.0), 1).scan(
        *TICKS, TICK_HZ, track(TICKS, 12.0), DOWN, {}
    )
    both = (biased.ranges > 0) & (plain.ranges > 0)
    assert np.abs(biased.ranges - plain.ranges)[both].max() <= 0.05 + 1e-5
    assert (biased.ranges != plain.ranges)[both].mean() > 0.99
    close = _scan(dataclasses.replace(params, range_bias_m=0.6), 0.55, 0.5, seed=3)
    assert close.ranges[close.ranges > 0].min() >= params.min_range_m


def test_pulses_go_elsewhere_than_the_nominal_directions_say() -> None:
    """A beam at the angle a from the vertical over level ground has the range h / cos(a)."""
    params = dataclasses.replace(PERFECT, prism_error_deg=0.1)
    scan, exact = _scan(params, 30.0, 0.5), _scan(PERFECT, 30.0, 0.5)
    np.testing.assert_array_equal(scan.directions, exact.directions)
    pattern = fired_directions(params, 5)
    assert pattern is not None and fired_directions(PERFECT, 5) is None
    fired = pattern(1, len(scan.ranges))
    np.testing.assert_allclose(scan.ranges, 30.0 / fired[:, 2], rtol=1e-5)
    assert np.abs(scan.ranges - exact.ranges).max() > 0.02
    with pytest.raises(ValueError, match=r"prism_error_deg must be 0: 'mid360' has no prisms"):
        fired_directions(dataclasses.replace(params, preset="mid360"), 5)
