"""The camera's own clock, and late and unsteady stamps."""

import numpy as np
import pytest

from touchdown.estimator.api import ImageThinning
from touchdown.sim.api import CameraImage, CameraParams, SimParams
from touchdown.sim.camera.stamps import ShutterClock

from support.landing_support import make_rig

SIM = SimParams()


def clock(seed: int = 0, takes_time: bool = False, **changes: float) -> ShutterClock:
    return ShutterClock(CameraParams(**changes), SIM, seed, takes_time)  # type: ignore[arg-type]


def test_stamps_are_exact_and_pulses_shared_by_default() -> None:
    plain = clock()
    assert (plain.phase_ticks, plain.before_ticks, plain.after_ticks) == (0, 0, 0)
    for pulse in (60, 61, 777):
        assert plain.stamp(pulse) == (pulse, pulse / 600)


def test_stamps_are_late_by_the_delay_and_scatter_by_the_jitter() -> None:
    late = clock(stamp_delay_s=0.003, stamp_jitter_s=0.0003)
    pulses = np.arange(60, 60 * 2000, 60)
    stamps = [late.stamp(int(p)) for p in pulses]
    error = np.array([s.time_s for s in stamps]) - pulses / 600
    assert error.mean() == pytest.approx(0.003, abs=3e-5)
    assert error.std() == pytest.approx(0.0003, rel=0.06)
    assert abs(np.corrcoef(error[1:], error[:-1])[0, 1]) < 0.1
    assert all(s.tick == round(s.time_s * 600) for s in stamps)
    assert [clock(stamp_delay_s=0.003, stamp_jitter_s=0.0003).stamp(60)] == stamps[:1]


def test_the_phase_is_drawn_once_a_flight_within_its_limit() -> None:
    drawn = [clock(seed, phase_s=0.03).phase_ticks for seed in range(60)]
    assert min(drawn) <= 1
    assert 17 <= max(drawn) <= 18
    assert len(set(drawn)) > 10
    assert clock(5, phase_s=0.03).phase_ticks == drawn[5]
    with pytest.raises(ValueError, match=r"camera\.phase_s is 0\.04.*every 0\.03333 s"):
        clock(phase_s=0.04)


def test_an_image_waits_for_the_end_of_its_exposure() -> None:
    rows = clock(takes_time=True, readout_s=0.015, exposure_max_s=0.01)
    assert (rows.before_ticks, rows.after_ticks, rows.span_ticks) == (4, 3, 15)


def test_thinning_takes_the_images_of_a_slower_camera() -> None:
    """Of 30 Hz on the clock's ticks those at multiples of 60; of a camera with a phase, a delay and
    jitter every third one, from the third on; of one that gives 10 Hz all."""
    rig = make_rig()

    def kept(times_s: np.ndarray, pulses: int) -> list[int]:
        thinning = ImageThinning(rig, pulses)
        images = [image_at(float(t)) for t in times_s]
        return [n for n, image in enumerate(images, start=1) if thinning.keeps(image)]

    pulses = np.arange(1, 31) / 30.0
    jitter = 0.0003 * np.random.default_rng(0).standard_normal(30)
    assert kept(np.round(pulses * 600) / 600, 3) == list(range(3, 31, 3))
    assert kept(np.round(pulses * 600) / 600, 0) == []
    assert kept(pulses + 0.013 + 0.003 + jitter, 3) == list(range(3, 31, 3))
    assert kept(pulses + 0.003 + jitter, 1) == list(range(1, 31))
    for phase in np.arange(0, 20) / 600:
        times = np.arange(1, 11) / 10.0 + phase + 0.003 + jitter[:10]
        assert kept(times, 3) == list(range(1, 11))


def image_at(time_s: float) -> CameraImage:
    tick = round(time_s * 600)
    exact = abs(time_s * 600 - tick) < 1e-9
    return CameraImage(
        tick=tick, time_s=tick / 600 if exact else time_s, rgb=np.zeros((2, 2, 3), np.uint8)
    )
