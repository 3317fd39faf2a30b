"""Arrival schedules are exact for any timing of the threads."""

import threading
import time
from collections.abc import Iterator
from concurrent.futures import Executor

import numpy as np
import pytest

from touchdown.sim.api import SimParams
from touchdown.sim.delivery import DeliveryQueue, Latency, make_executor


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


def test_collect_waits_for_unfinished_work() -> None:
    executor = make_executor(2)
    gate = threading.Event()
    queue: DeliveryQueue[bool] = DeliveryQueue(executor)
    queue.submit(1, gate.wait, 5.0)
    threading.Timer(0.05, gate.set).start()
    assert queue.collect(1) == (True,)
    executor.shutdown()


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


def test_clear_forgets_everything(executor: Executor) -> None:
    queue: DeliveryQueue[int] = DeliveryQueue(executor)
    for due in range(5):
        queue.submit(due, _slow, due, 0.002)
    queue.clear()
    assert queue.collect(100) == ()


def test_thread_count_is_checked() -> None:
    with pytest.raises(ValueError, match=r"sim.threads must be 1 or 2, not 3"):
        make_executor(3)


def _latencies(count: int, seed: int = 1, name: bytes = b"scans", **params: float) -> list[int]:
    """Latencies of messages that are too far apart to wait for one another."""
    latency = Latency(SimParams(**params), seed, name)  # type: ignore[arg-type]
    return [latency.due(6000 * k) - 6000 * k for k in range(count)]


def test_without_spread_the_latency_is_the_nominal_one_to_the_tick() -> None:
    assert set(_latencies(20)) == {36}
    assert set(_latencies(20, compute_latency_ticks=35, latency_sigma=0.0)) == {35}


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


def test_latencies_are_those_of_seed_and_sensor() -> None:
    one = _latencies(50, latency_sigma=0.3)
    assert one == _latencies(50, latency_sigma=0.3)
    assert one != _latencies(50, seed=2, latency_sigma=0.3)
    assert one != _latencies(50, name=b"images", latency_sigma=0.3)
    latency = Latency(SimParams(latency_sigma=0.3), 1, b"scans")
    first = [latency.due(6000 * k) for k in range(10)]
    latency.restart()
    assert first == [latency.due(6000 * k) for k in range(10)]


def test_messages_of_one_sensor_do_not_overtake_one_another() -> None:
    latency = Latency(SimParams(latency_sigma=1.0), 3, b"images")
    due = np.array([latency.due(60 * k) for k in range(1, 500)])
    assert (np.diff(due) >= 0).all()
    assert (np.diff(due) == 0).any()  # some had to wait for the one before
