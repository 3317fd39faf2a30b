"""Arrival schedules are exact for any timing of the threads."""

import threading
import time
from collections.abc import Iterator
from concurrent.futures import Executor

import numpy as np
import pytest

from touchdown.estimator.api import ImageThinning
from touchdown.sim.api import CameraImage, CameraParams, SimParams
from touchdown.sim.delivery import Computer, DeliveryQueue, Latency, ShutterClock, make_executor

from support.landing_support import make_rig


@pytest.fixture(params=[1, 2])
def executor(request: pytest.FixtureRequest) -> Iterator[Executor]:
    chosen = make_executor(request.param)
    yield chosen
    chosen.shutdown(wait=True)


def _slow(value: int, seconds: float) -> int:
    time.sleep(seconds)
    return value


def test_results_arrive_at_their_tick_and_not_before(executor: Executor) -> None:
    """A fake world that measures every 6 ticks, is late by 10 and collects every 3: item k comes at
    the first collection at or after 6 k + 10, in order."""
    queue: DeliveryQueue[int] = DeliveryQueue(executor)
    arrivals = {}
    for tick in range(1, 61):
        if tick % 6 == 0:
            queue.submit(tick + 10, _slow, tick, 0.002 if tick % 12 else 0.0)
        if tick % 3 == 0:
            for measured in queue.collect(tick):
                arrivals[measured] = tick
    assert arrivals == {6: 18, 12: 24, 18: 30, 24: 36, 30: 42, 36: 48, 42: 54, 48: 60}


def test_several_due_at_once_come_oldest_first(executor: Executor) -> None:
    queue: DeliveryQueue[str] = DeliveryQueue(executor)
    for due, name in ((3, "a"), (3, "b"), (5, "c"), (9, "d")):
        queue.submit(due, str, name)
    assert queue.collect(2) == ()
    assert queue.collect(5) == ("a", "b", "c")
    assert queue.collect(5) == ()
    assert queue.collect(100) == ("d",)


def test_two_threads_mean_one_worker_that_is_not_the_caller() -> None:
    executor = make_executor(2)
    queue: DeliveryQueue[int] = DeliveryQueue(executor)
    for _ in range(4):
        queue.submit(0, threading.get_ident)
    workers = set(queue.collect(0))
    executor.shutdown()
    assert len(workers) == 1
    assert threading.get_ident() not in workers


def test_errors_surface_when_their_result_is_due(executor: Executor) -> None:
    queue: DeliveryQueue[float] = DeliveryQueue(executor)
    queue.submit(4, lambda: 1 / 0)
    assert queue.collect(3) == ()
    with pytest.raises(ZeroDivisionError):
        queue.collect(4)


def test_due_ticks_may_not_go_back(executor: Executor) -> None:
    queue: DeliveryQueue[int] = DeliveryQueue(executor)
    queue.submit(10, int)
    with pytest.raises(ValueError, match=r"due tick 9 lies before 10"):
        queue.submit(9, int)


def _latencies(count: int, seed: int = 1, name: bytes = b"scans", **params: float) -> list[int]:
    """Latencies of messages that are too far apart to wait for one another."""
    latency = Latency(SimParams(**params), seed, name)  # type: ignore[arg-type]
    return [latency.due(6000 * k) - 6000 * k for k in range(count)]


def test_latencies_without_spread_are_the_median() -> None:
    assert _latencies(5, latency_sigma=0.0) == [SimParams().compute_latency_ticks] * 5 == [36] * 5


def test_latencies_are_log_normal_and_end_at_control_ticks() -> None:
    drawn = np.array(_latencies(20_000, latency_sigma=0.3))
    assert set(drawn % 3) == {0}
    # rounding up adds half a control step on average
    logs = np.log((drawn - 1.5) / 36.0)
    assert abs(logs.mean()) < 0.01
    assert abs(logs.std() - 0.3) < 0.015
    third = ((logs - logs.mean()) ** 3).mean() / logs.std() ** 3
    assert abs(third) < 0.1  # of the logarithm: that of the latency itself is 0.95
    assert drawn.min() > 0


def test_messages_of_one_sensor_do_not_overtake_one_another() -> None:
    latency = Latency(SimParams(latency_sigma=1.0), 3, b"images")
    due = np.array([latency.due(60 * k) for k in range(1, 500)])
    assert (np.diff(due) >= 0).all()
    assert (np.diff(due) == 0).any()  # some had to wait for the one before


def test_a_busy_computer_delivers_later_and_drops_what_would_wait_too_long() -> None:
    """Works of 30 ticks that come every 20: each waits 10 ticks longer than the one before, until
    120 ticks are too long. A second sensor waits for the first."""
    sim = SimParams(compute_latency_ticks=30)
    computer = Computer()
    scans, images = (Latency(sim, 1, name, computer) for name in (b"scans", b"images"))
    assert [scans.due(20 * k) for k in range(13)] == [30 * (k + 1) for k in range(13)]
    assert scans.due(20 * 13) is None  # it would wait for 130 ticks
    assert images.due(20 * 14) == 30 * 14
    assert images.due(1002) == 1032


SIM = SimParams()


def clock(seed: int = 0, takes_time: bool = False, **changes: float) -> ShutterClock:
    return ShutterClock(CameraParams(**changes), SIM, seed, takes_time)  # type: ignore[arg-type]


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
