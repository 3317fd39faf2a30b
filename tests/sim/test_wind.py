"""Mean profile and Dryden turbulence against MIL-F-8785C."""

import numpy as np
import pytest
from scipy import signal

from touchdown.sim.api import WindParams
from touchdown.sim.typing import Array
from touchdown.sim.wind import REFERENCE_HEIGHT_M, Wind, _advance_pair, dryden_scales

HEIGHT_M = 30.0
AIRSPEED_MPS = 5.0


def dryden_psd(omega: Array, sigma: float, time_scale_s: float, *, longitudinal: bool) -> Array:
    """One-sided density over angular frequency, (m/s)^2 / (rad/s); ``time_scale_s`` is L / V."""
    x = (omega * time_scale_s) ** 2
    shape = 2.0 / (1.0 + x) if longitudinal else (1.0 + 3.0 * x) / (1.0 + x) ** 2
    density: Array = sigma**2 * time_scale_s / np.pi * shape
    return density


def _gusts(dt_s: float, count: int, *, height_m: float = HEIGHT_M, seed: int = 1) -> Array:
    """(count, 3) turbulence along the mean wind, to its left, and up."""
    params = WindParams(mean_kmh=12.0, direction_deg=0.0)
    wind = Wind(params, seed)
    series = np.array([wind.step(dt_s, height_m, AIRSPEED_MPS).copy() for _ in range(count)])
    series[:, 0] -= wind.mean_speed(height_m)
    return series


def test_scales_at_30_m_and_12_kmh() -> None:
    sigma_uv, sigma_w, scale_uv, scale_w = dryden_scales(HEIGHT_M / 0.3048, 12.0 / 3.6)
    assert sigma_w == pytest.approx(0.333, abs=0.001)
    assert sigma_uv == pytest.approx(0.573, abs=0.001)
    assert scale_uv == pytest.approx(152.0, abs=1.0)
    assert scale_w == pytest.approx(30.0)


def test_mean_profile_is_logarithmic() -> None:
    wind = Wind(WindParams(mean_kmh=12.0, roughness_length_m=0.1, turbulence=False), 0)
    assert wind.mean_speed(REFERENCE_HEIGHT_M) == pytest.approx(12.0 / 3.6)
    assert wind.mean_speed(0.05) == 0.0
    # One decade of height is as much as from the roughness length to ten times that.
    assert wind.mean_speed(10.0) - wind.mean_speed(1.0) == pytest.approx(wind.mean_speed(1.0))


@pytest.mark.parametrize("direction_deg", [0.0, 90.0, 215.0])
def test_steady_wind_blows_in_the_given_direction(direction_deg: float) -> None:
    wind = Wind(WindParams(mean_kmh=18.0, direction_deg=direction_deg, turbulence=False), 3)
    angle = np.radians(direction_deg)
    expected = 5.0 * np.array([np.cos(angle), np.sin(angle), 0.0])
    np.testing.assert_allclose(wind.step(0.005, REFERENCE_HEIGHT_M, 3.0), expected, atol=1e-12)


def test_turbulence_turns_with_the_mean_wind() -> None:
    east = Wind(WindParams(direction_deg=0.0), 5)
    north = Wind(WindParams(direction_deg=90.0), 5)
    for _ in range(50):
        x, y, z = east.step(0.01, 20.0, 4.0)
        np.testing.assert_allclose(north.step(0.01, 20.0, 4.0), [-y, x, z], atol=1e-12)


def test_no_wind_means_still_air() -> None:
    assert not Wind(WindParams(mean_kmh=0.0), 0).step(0.005, 30.0, 5.0).any()


@pytest.mark.parametrize("steps", [1e-5, 1e-3, 0.05, 0.0999, 0.1001, 1.0, 5.0])
def test_discretisation_keeps_the_stationary_covariance(steps: float) -> None:
    """P = F P F' + G G' exactly, whatever the step's length relative to L / V."""
    columns = []
    for a, b, n, m in np.eye(4):
        pair = np.array([a, b])
        _advance_pair(pair, np.array([n, m]), steps)
        columns.append(pair)
    transition, gain = np.array(columns[:2]).T, np.array(columns[2:]).T
    stationary = np.array([[0.5, 0.25], [0.25, 0.25]])
    propagated = transition @ stationary @ transition.T + gain @ gain.T
    np.testing.assert_allclose(propagated, stationary, atol=1e-14)
    output = np.array([np.sqrt(3.0), 1.0 - np.sqrt(3.0)])
    assert output @ stationary @ output == pytest.approx(1.0)


def test_variances_within_sampling_error() -> None:
    """100 000 s: the estimate of a variance with correlation time T has a relative standard error
    of about sqrt(2 T / duration); four of them are allowed."""
    dt_s, count = 0.5, 200_000
    series = _gusts(dt_s, count)
    sigma_uv, sigma_w, scale_uv, scale_w = dryden_scales(HEIGHT_M / 0.3048, 12.0 / 3.6)
    for axis, sigma, scale in (
        (0, sigma_uv, scale_uv),
        (1, sigma_uv, scale_uv),
        (2, sigma_w, scale_w),
    ):
        error = 4.0 * np.sqrt(2.0 * (scale / AIRSPEED_MPS) / (dt_s * count))
        assert np.var(series[:, axis]) == pytest.approx(sigma**2, rel=error)
    correlation = np.corrcoef(series.T) - np.eye(3)
    assert np.abs(correlation).max() < 0.12


def test_spectrum_is_drydens() -> None:
    """Welch's estimate, averaged over bands of about an octave, from L / V to a tenth of the
    sampling rate."""
    dt_s = 0.05
    series = _gusts(dt_s, 300_000)
    sigma_uv, sigma_w, scale_uv, scale_w = dryden_scales(HEIGHT_M / 0.3048, 12.0 / 3.6)
    frequency, power = signal.welch(series, fs=1.0 / dt_s, nperseg=4096, axis=0)
    omega = 2.0 * np.pi * frequency
    cases = (
        (0, sigma_uv, scale_uv, True), (1, sigma_uv, scale_uv, False), (2, sigma_w, scale_w, False),
    )  # fmt: skip
    for axis, sigma, scale, longitudinal in cases:
        expected = (
            2.0 * np.pi * dryden_psd(omega, sigma, scale / AIRSPEED_MPS, longitudinal=longitudinal)
        )
        for low in 0.03 * 2.0 ** np.arange(6):
            band = (frequency >= low) & (frequency < 2.0 * low)
            ratio = power[band, axis].mean() / expected[band].mean()
            # Some 146 half-overlapping segments and n bins; five standard errors and 2 % aliasing.
            tolerance = 5.0 / np.sqrt(100.0 * band.sum()) + 0.02
            assert ratio == pytest.approx(1.0, abs=tolerance), (axis, low)


def test_short_waves_have_kaimals_spectrum_and_drydens_strength() -> None:
    """Within a factor of 1.6 from 1500 m to 15 m; Dryden's has a tenth at the short end."""
    dt, count, height = 0.1, 120_000, 30.0
    params = WindParams(mean_kmh=12.0, direction_deg=0.0, short_waves=True)
    wind = Wind(params, 5)
    speed = wind.mean_speed(height)
    series = np.array([wind.step(dt, height, speed).copy() for _ in range(count)])
    sigma_uv, sigma_w, *_ = dryden_scales(height / 0.3048, 12.0 / 3.6)
    assert series.std(axis=0) == pytest.approx([sigma_uv, sigma_uv, sigma_w], rel=0.1)
    frequency, density = signal.welch(series[:, 0], 1.0 / dt, nperseg=8192)
    reduced = np.geomspace(0.02, 2.0, 8)
    at = reduced * speed / height
    found = at * np.interp(at, frequency, density) / (0.4 * wind.friction) ** 2
    kaimal = 105.0 * reduced / (1.0 + 33.0 * reduced) ** (5.0 / 3.0)
    assert np.abs(np.log10(found / kaimal)).max() < 0.35
    assert np.sqrt(np.mean(np.log10(found / kaimal) ** 2)) < 0.2


def _rotations(dt_s: float, count: int, *, span_m: float = 1.0, seed: int = 2) -> Array:
    """(count, 3) rates p, q, r of the air, in a wind to the east: about its axes."""
    params = WindParams(mean_kmh=36.0, direction_deg=0.0, rotational=True)
    wind = Wind(params, seed, span_m)
    rates = np.empty((count, 3))
    for i in range(count):
        wind.step(dt_s, HEIGHT_M, AIRSPEED_MPS)
        rates[i] = wind.rotation(dt_s, HEIGHT_M, AIRSPEED_MPS)
    return rates


def test_rotational_gusts_have_the_spectra_of_the_specification() -> None:
    dt, span = 0.02, 1.0
    rates = _rotations(dt, 200_000, span_m=span)
    frequency, density = signal.welch(rates, fs=1.0 / dt, nperseg=4096, axis=0)
    omega = 2.0 * np.pi * frequency
    sigma_uv, sigma_w, scale_uv, scale_w = dryden_scales(HEIGHT_M / 0.3048, 10.0)
    lag = 4.0 * span / (np.pi * AIRSPEED_MPS)
    expected = np.empty_like(density)
    corner = np.pi / (4.0 * span)
    roll = sigma_w**2 * 0.8 / AIRSPEED_MPS * corner ** (1 / 3) / scale_w ** (2 / 3)
    expected[:, 0] = roll / (1.0 + (lag * omega) ** 2)
    rising = (omega / AIRSPEED_MPS) ** 2
    w = dryden_psd(omega, sigma_w, scale_w / AIRSPEED_MPS, longitudinal=False)
    v = dryden_psd(omega, sigma_uv, scale_uv / AIRSPEED_MPS, longitudinal=False)
    expected[:, 1] = rising / (1.0 + (lag * omega) ** 2) * w
    expected[:, 2] = rising / (1.0 + (0.75 * lag * omega) ** 2) * v
    band = (omega > 0.3) & (omega < 8.0)
    for axis in range(3):
        # Over angular frequency, one-sided: a density over hertz is 2 pi times that.
        ratio = density[band, axis] / (2.0 * np.pi * expected[band, axis])
        assert np.median(ratio) == pytest.approx(1.0, abs=0.06), "pqr"[axis]
        assert ratio.min() > 0.5
        assert ratio.max() < 1.7


def test_rotational_gusts_leave_the_wind_as_it_is() -> None:
    plain, turning = (Wind(WindParams(rotational=on), 4) for on in (False, True))
    for _ in range(200):
        expected = plain.step(0.005, 12.0, 6.0).tobytes()
        assert turning.step(0.005, 12.0, 6.0).tobytes() == expected
        turning.rotation(0.005, 12.0, 6.0)
    assert not plain.rotational
    assert not Wind(WindParams(rotational=True, turbulence=False), 4).rotational
