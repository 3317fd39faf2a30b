"""Scans and images that overtake one another are used in the order of measurement, soon."""

from dataclasses import replace

import numpy as np
import pytest

from touchdown.estimator.filtering.synchronizer import ArrivingStream, MessageOrder, stamp_of
from touchdown.sim.api import CameraImage, LidarScan, Observation, SimParams
from touchdown.sim.delivery import Latency

from support import livo_flight
from support.landing_support import make_obs
from support.messages import make_scan

RIG = livo_flight.RIG
PERIODS = {"scans": 60, "images": 60}
PATIENCE = 180


def _scan(tick: int) -> LidarScan:
    return make_scan(tick, np.zeros((0, 3)), [])


def _image(tick: int) -> CameraImage:
    return CameraImage(tick=tick, time_s=tick / 600, rgb=np.zeros((1, 1, 3), np.uint8))


def _flight(arrivals: dict[int, list[LidarScan | CameraImage]], end: int) -> list[Observation]:
    """Observations every 3 ticks; messages by tick of arrival."""
    out = []
    for tick in range(3, end + 1, 3):
        messages = arrivals.get(tick, [])
        scans = tuple(m for m in messages if isinstance(m, LidarScan))
        images = tuple(m for m in messages if isinstance(m, CameraImage))
        out.append(make_obs(tick, scans=scans, images=images))
    return out


def _released(order: MessageOrder, flight: list[Observation]) -> list[tuple[str, int, int]]:
    """Kind, stamp and tick of release of every message."""
    return [
        ("scan" if isinstance(message, LidarScan) else "image", stamp_of(message), seen.tick)
        for seen in flight
        for message in order.push(seen)
    ]


def _drawn_flight(sigma: float, seconds: int, shift: int = 20) -> list[Observation]:
    """Scans at 60 k and images at 60 k - ``shift`` with the latencies of the simulated world."""
    sim = SimParams(latency_sigma=sigma)
    scans, images = Latency(sim, 4, b"scans"), Latency(sim, 4, b"images")
    arrivals: dict[int, list[LidarScan | CameraImage]] = {}
    for k in range(1, 10 * seconds + 1):
        arrivals.setdefault(images.due(60 * k - shift), []).append(_image(60 * k - shift))
        arrivals.setdefault(scans.due(60 * k), []).append(_scan(60 * k))
    return _flight(arrivals, 600 * seconds)


@pytest.mark.parametrize("shift", [0, 21])
def test_constant_delays_hold_nothing_back_even_where_messages_are_lost(shift: int) -> None:
    flight = _drawn_flight(0.0, 10, shift)
    flight = [replace(o, images=()) if 1500 < o.tick < 2500 else o for o in flight]
    order = MessageOrder(RIG, PERIODS, PATIENCE, scans_follow_images=True)
    released = _released(order, flight)
    assert len(released) > 170 and all(now == stamp + 36 for _, stamp, now in released)


def test_an_overtaken_image_is_used_first() -> None:
    """The image of tick 100 arrives 60 ticks late, the scan of tick 120 after 30."""
    flight = _flight(
        {90: [_image(40)], 96: [_scan(60)], 150: [_scan(120)], 162: [_image(100)]}, 300
    )
    released = _released(MessageOrder(RIG, PERIODS, PATIENCE), flight)
    assert released == [
        ("image", 40, 90), ("scan", 60, 96), ("image", 100, 162), ("scan", 120, 162),
    ]  # fmt: skip


def test_all_messages_come_in_order_when_latencies_vary() -> None:
    flight = _drawn_flight(0.3, 60)
    arrived = [stamp for o in flight for stamp in map(stamp_of, [*o.scans, *o.images])]
    assert (np.diff(arrived) < 0).sum() > 30  # scans and images do overtake one another
    released = _released(MessageOrder(RIG, PERIODS, PATIENCE), flight)
    stamps = [stamp for _, stamp, _ in released]
    assert len(stamps) == len(arrived) and (np.diff(stamps) < 0).sum() <= 2
    due = {stamp_of(m): o.tick for o in flight for m in (*o.scans, *o.images)}
    waits = np.array([now - due[stamp] for _, stamp, now in released])
    assert waits.mean() < 8.0  # 13 ms
    assert (waits > 0).mean() < 0.5


def test_a_lost_message_delays_the_next_no_longer_than_the_longest_delay_seen() -> None:
    flight = _drawn_flight(0.3, 30)
    lost = [replace(o, images=tuple(i for i in o.images if i.tick % 600 != 580)) for o in flight]
    released = _released(MessageOrder(RIG, PERIODS, PATIENCE), lost)
    longest = max(o.tick - stamp_of(m) for o in flight for m in (*o.scans, *o.images))
    bound = longest + 0.5 * (longest - min(o.tick - s.end_tick for o in flight for s in o.scans))
    assert max(now - stamp for _, stamp, now in released) <= min(bound + 3, PATIENCE + 3)


def test_a_sensor_that_is_gone_is_not_waited_for() -> None:
    flight = [replace(o, images=()) if o.tick > 3000 else o for o in _drawn_flight(0.3, 30)]
    due = {stamp_of(m): o.tick for o in flight for m in (*o.scans, *o.images)}
    late = [
        now - due[stamp]
        for _, stamp, now in _released(MessageOrder(RIG, PERIODS, PATIENCE), flight)
        if now > 3400
    ]
    assert len(late) > 200 and set(late) == {0}


def test_a_scan_waits_for_an_image_of_its_own_instant_on_request_alone() -> None:
    flight = _flight({96: [_scan(60), _image(60)], 150: [_scan(120)], 162: [_image(120)]}, 300)
    first = [("scan", 60, 96), ("image", 60, 96)]
    assert _released(MessageOrder(RIG, PERIODS, PATIENCE), flight) == [
        *first, ("scan", 120, 150), ("image", 120, 162),
    ]  # fmt: skip
    waiting = MessageOrder(RIG, PERIODS, PATIENCE, scans_follow_images=True)
    # 36 ticks are all the delay that was ever seen: by tick 156 the image counts as lost
    assert _released(waiting, flight) == [*first, ("scan", 120, 156), ("image", 120, 162)]


def test_the_bound_grows_with_the_spread_and_forgets() -> None:
    stream = ArrivingStream(60, 36, 100)
    assert stream.longest_ticks == 36
    stream.take(0, 30)
    assert stream.longest_ticks == 30
    stream.take(0, 50)
    assert stream.longest_ticks == 50 + (50 - 30) // 2
    stream.take(0, 90)
    assert stream.longest_ticks == 100
    for _ in range(64):
        stream.take(0, 36)
    assert stream.longest_ticks == 36
