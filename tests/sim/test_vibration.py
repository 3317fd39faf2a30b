"""Propeller vibration: closed forms, levels, isolation, and the recorded spectra."""

from dataclasses import replace

import numpy as np
import pytest

from touchdown.experiments.gap.vibration import RECORDED_HZ, band_rms, recorded_vibration
from touchdown.sim import vibration
from touchdown.sim.api import ImuParams
from touchdown.sim.imu import ImuSensor
from touchdown.sim.typing import Array
from touchdown.sim.vibration import MODE_HZ, PropellerVibration, mount_gain

HOVER, PERIOD_S = 398.0, 1.0 / 200.0
LINES = ImuParams(vibration_harmonics=1.0)
BROAD = ImuParams(vibration_broadband=1.0)
NO_LINES, NO_MODES = np.zeros((2, 6)), np.zeros((len(MODE_HZ), 6))
RECORDED_RMS = np.array(
    [
        [0.0160, 0.0223, 0.0205, 0.0159, 0.0148],
        [0.0149, 0.0187, 0.0281, 0.0466, 0.0743],
        [0.0076, 0.0039, 0.0063, 0.0112, 0.0574],
        [0.294, 0.388, 0.466, 0.703, 2.109],
        [0.257, 0.369, 0.438, 0.542, 0.544],
        [0.876, 1.384, 1.725, 1.450, 1.780],
    ]
)
"""rad/s and m/s^2 of each axis in 10-20, ... 50-60 Hz: medians over the recorded flights, as
`touchdown gap` compares them"""


def samples(model: PropellerVibration, speeds: Array) -> Array:
    return np.array([model.sample(row) for row in speeds])


def one_line(harmonic: int, params: ImuParams = LINES, period_s: float = PERIOD_S) -> Array:
    """(N, 6) of one harmonic of level 1 in hover, all four rotors at the same speed."""
    levels = NO_LINES.copy()
    levels[harmonic] = 1.0
    model = PropellerVibration(params, period_s, HOVER, 3, (levels, NO_MODES))
    return samples(model, np.full((4000, 4), HOVER))[1:]


def test_a_line_equals_the_numerical_mean_while_the_rotors_run_up() -> None:
    """Speeds rise linearly within a sample; the phase is that of the mean speed."""
    levels = NO_LINES.copy()
    levels[0] = 1.0
    model = PropellerVibration(LINES, PERIOD_S, HOVER, 8, (levels, NO_MODES))
    phases, offsets = model._phases.copy(), model._offsets.copy()
    speeds = np.linspace(0.0, 1.1 * HOVER, 60)[:, None] * np.array([1.0, 0.9, 1.05, 0.97])
    found = samples(model, speeds)
    before = np.zeros(4)
    for row, now in zip(found, speeds, strict=True):
        mean = 0.5 * (before + now)
        within = (np.arange(2000) + 0.5) / 2000 * PERIOD_S
        angle = phases[:, None] + mean[:, None] * within
        wave = np.cos(angle[:, None, :] + offsets[:, 0, :, None]).mean(axis=2)
        expected = ((mean / HOVER) ** 2 * np.sqrt(0.5)) @ wave
        np.testing.assert_allclose(row, expected, atol=1e-5)
        phases, before = phases + mean * PERIOD_S, now


def test_lines_of_unequal_rotors_have_the_level() -> None:
    """Rotors of different speeds add in power, so that the level is that of all four."""
    model = PropellerVibration(LINES, PERIOD_S / 20.0, HOVER, 1)
    speeds = np.tile(HOVER * np.array([0.95, 1.0, 1.03, 1.07]), (60_000, 1))
    found = samples(model, speeds)[1:]
    expected = np.sqrt((vibration.HARMONIC_RMS**2).sum(axis=0))
    np.testing.assert_allclose(np.sqrt((found**2).mean(axis=0)), expected, rtol=0.08)


@pytest.mark.parametrize("params", [LINES, BROAD])
def test_vibration_grows_with_the_square_of_the_speed_and_stops_with_the_rotors(
    params: ImuParams,
) -> None:
    def rms(speed: float) -> Array:
        model = PropellerVibration(params, PERIOD_S / 20.0, HOVER, 2)
        found = samples(model, np.full((20_000, 4), speed))[1:]
        return np.asarray(np.sqrt((found**2).mean(axis=0)))

    np.testing.assert_allclose(rms(HOVER) / rms(HOVER / 2.0), 4.0, rtol=0.1)
    assert not rms(0.0).any()


@pytest.mark.parametrize("mode", range(len(MODE_HZ)))
@pytest.mark.parametrize("period_s", [1.0 / 2000.0, 1.0 / 200.0])
def test_a_resonance_has_its_spectrum_in_means_of_any_length(mode: int, period_s: float) -> None:
    """Power of the samples: the analytic spectrum times sinc^2, integrated over all aliases."""
    levels = NO_MODES.copy()
    levels[mode] = 1.0
    model = PropellerVibration(BROAD, period_s, HOVER, 5, (NO_LINES, levels))
    count = round(150.0 / period_s) // 4
    found = samples(model, np.full((count, 4), HOVER))
    f = np.linspace(0.05, 4000.0, 400_000)
    w, w0, damping = 2 * np.pi * f, 2 * np.pi * MODE_HZ[mode], vibration.MODE_DAMPING[mode]
    density = 8.0 * damping * w0 * w**2 / ((w0**2 - w**2) ** 2 + (2 * damping * w0 * w) ** 2)
    power = np.sum(density * np.sinc(f * period_s) ** 2) * (f[1] - f[0])
    assert (found**2).mean() == pytest.approx(power, rel=0.12)


def test_the_mount_passes_what_is_slow_and_a_share_of_what_is_fast() -> None:
    corner = 2.0 * np.pi * 40.0
    for fraction in (0.2, 0.5):
        assert mount_gain(0.05 * corner, fraction, corner) == pytest.approx(1.0, abs=0.01)
        assert mount_gain(20.0 * corner, fraction, corner) == pytest.approx(fraction, rel=0.02)
    for rate in (0.3, 1.0, 4.0):
        assert mount_gain(rate * corner, 1.0, corner) == 1.0


def test_isolation_weakens_lines_by_the_gain_at_their_frequency() -> None:
    soft = one_line(0, replace(LINES, vibration_isolation=0.2))
    gain = mount_gain(HOVER, 0.2, 2.0 * np.pi * 40.0)
    np.testing.assert_allclose(soft, gain * one_line(0), rtol=1e-9, atol=1e-12)
    assert 0.2 < gain < 0.3


def test_isolation_weakens_resonances_by_the_gain_at_their_frequency() -> None:
    """The narrow resonance at 57 Hz; slow ones pass."""

    def rms(mode: int, fraction: float) -> float:
        levels = NO_MODES.copy()
        levels[mode] = 1.0
        params = replace(BROAD, vibration_isolation=fraction)
        model = PropellerVibration(params, PERIOD_S, HOVER, 5, (NO_LINES, levels))
        return float(np.sqrt((samples(model, np.full((8000, 4), HOVER)) ** 2).mean()))

    gain = mount_gain(2.0 * np.pi * MODE_HZ[4], 0.2, 2.0 * np.pi * 40.0)
    assert rms(4, 0.2) / rms(4, 1.0) == pytest.approx(gain, rel=0.1)
    assert rms(0, 0.2) / rms(0, 1.0) == pytest.approx(1.0, abs=0.1)


def test_band_levels_are_those_of_the_recorded_flights() -> None:
    """The model, sampled as the recorded sensor samples, at the recorded vehicle's speeds."""
    found = band_rms(recorded_vibration(seconds=90.0, seed=4), RECORDED_HZ)
    np.testing.assert_allclose(found, RECORDED_RMS, rtol=0.2)


def test_samples_of_the_imu_carry_the_vibration() -> None:
    params = ImuParams(vibration_harmonics=1.0, vibration_broadband=0.5)
    still = (np.eye(3), np.eye(3), np.zeros(3), np.zeros(3))
    plain, shaken = ImuSensor(ImuParams(), 600, 3, 7), ImuSensor(params, 600, 3, 7, HOVER)
    model = PropellerVibration(params, PERIOD_S, HOVER, 7)
    for k in range(5):
        speeds = np.full(4, HOVER)
        expected = model.sample(speeds)
        quiet = plain.sample(3 * k, *still)
        loud = shaken.sample(3 * k, *still, rotor_speeds=speeds)
        np.testing.assert_allclose(
            [*(loud.angular_velocity - quiet.angular_velocity),
             *(loud.specific_force - quiet.specific_force)],
            expected, atol=1e-12,
        )  # fmt: skip
