"""Rejection of invalid messages, and removal of rain and fog, by the guard."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from touchdown.estimator.guard import InputGuard
from touchdown.sim.api import CameraImage, ImuSample, LidarParams, LidarScan, Observation

from support.fault_air_support import look_down
from support.landing_support import make_obs
from support.lidar_support import PLANE
from support.livo_flight import RIG
from support.messages import make_scan

HEIGHT, WIDTH = RIG.camera.height, RIG.camera.width


def scan(end: int = 600, seed: int = 0, **changes: Any) -> LidarScan:
    rng = np.random.default_rng([end, seed])
    down = np.tile([0.0, 0.0, 1.0], (20, 1))
    made = make_scan(end, down, rng.uniform(5.0, 9.0, 20), np.linspace(0.005, 0.1, 20), 9)
    return dataclasses.replace(made, **changes)


def image(tick: int = 600, **changes: Any) -> CameraImage:
    rgb = np.random.default_rng(tick).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    values: dict[str, Any] = {"tick": tick, "time_s": tick / 600, "rgb": rgb}
    return CameraImage(**(values | changes))


def screen(*observations: Observation) -> tuple[Observation, list[str], InputGuard]:
    """Returns the last screened observation and all events."""
    guard = InputGuard(RIG, 10)
    events: list[str] = []
    for observation in observations:
        out = guard.screen(observation)
        events += guard.events
    return out, events, guard


def test_valid_messages_pass_unchanged() -> None:
    whole = make_obs(636, scans=(scan(),), images=(image(),))
    out, events, guard = screen(whole)
    assert out is whole and not events and guard.refused == 0


@pytest.mark.parametrize(("changes", "word"), [
    ({"ranges": np.full(20, np.nan, np.float32)}, "not a number"),
    ({"directions": np.full((20, 3), np.nan, np.float32)}, "not a number"),
    ({"ranges": np.full(20, np.inf, np.float32)}, "not a number"),
    ({"ranges": np.zeros(19, np.float32)}, "its arrays differ in length"),
    ({"start_tick": 660}, "ends before it starts"), ({"end_tick": 900}, "from the future"),
])  # fmt: skip
def test_scans_that_are_refused(changes: dict[str, Any], word: str) -> None:
    bad = scan(**changes)
    out, events, guard = screen(make_obs(636, scans=(bad,)))
    assert out.scans == () and events == [f"scan {bad.end_tick} refused: {word}"]
    assert guard.refused == 1


def test_two_stamps_from_the_future_show_a_clock_that_runs_ahead() -> None:
    """A scan a second, delivered 36 ticks after its end by its stamp, two of them before it."""
    late = dict.fromkeys(range(10), 36) | {2: -6, 3: -6}
    observed = [make_obs(60 + 600 * k + late[k], scans=(scan(60 + 600 * k),)) for k in range(10)]
    taken = [k for k in range(10) if screen(*observed[: k + 1])[0].scans]
    assert taken == [0, 1, 7, 8, 9]  # none for five seconds after the first of the two
    events = screen(*observed)[1]
    assert [e for e in events if "clock" in e or "future" in e] == [
        "scan 1260 refused: from the future", "scan 1860 refused: its clock runs ahead",
    ]  # fmt: skip
    assert screen(*observed[:3], *observed[4:5])[0].scans, "one is chance"


def test_a_sector_that_goes_blind_is_named_and_so_is_its_sight() -> None:
    """600 beams in a cone; none comes back from azimuths of 60 to 90 degrees, then all do. Where
    most of them are missing, as over water, nothing is said."""
    azimuth = np.radians(np.arange(0.0, 360.0, 0.6))
    cone = np.stack([np.cos(azimuth), np.sin(azimuth), np.ones(600)], axis=1).astype(np.float32)

    def observed(index: int, blind: tuple[float, float]) -> Observation:
        end = 60 * (index + 1)
        lost = (azimuth >= np.radians(blind[0])) & (azimuth < np.radians(blind[1]))
        ranges = np.random.default_rng(index).uniform(5.0, 9.0, 600).astype(np.float32)
        times = np.linspace(0.005, 0.1, 600, dtype=np.float32)
        return make_obs(end + 36, scans=(scan(
            end, directions=cone, ranges=np.where(lost, np.float32(0.0), ranges),
            time_offsets=times, intensity=np.full(600, 20, np.uint8),
        ),))  # fmt: skip

    def events(*blind: tuple[float, float]) -> list[str]:
        return screen(*(observed(k, sector) for k, sector in enumerate(blind)))[1]

    soiled, clear, water = (60.0, 90.0), (0.0, 0.0), (30.0, 330.0)
    assert events(*[soiled] * 9) == events(*[water] * 20) == []
    named = "LIDAR is blind at azimuths of 60 to 90 deg"
    assert events(*[soiled] * 10) == [named]
    assert events(*[soiled] * 30, clear) == [named, "LIDAR sees all round again"]
    assert events(*[soiled, clear] * 10) == []


def test_missing_returns_are_an_event_in_flight_only() -> None:
    def blind(end: int) -> LidarScan:
        return scan(end, ranges=np.zeros(20, np.float32))

    grounded = [make_obs(t + 36, scans=(blind(t),)) for t in (60, 120)]
    flying = [make_obs(t + 36, scans=(scan(t),)) for t in (180, 240)]
    blinded = [make_obs(t + 36, scans=(blind(t),)) for t in (300, 360)]
    again = [make_obs(456, scans=(scan(420),))]
    out, events, _ = screen(*grounded)
    assert out.scans == () and events == []
    assert screen(*grounded, *flying, *blinded, *again)[1] == [
        "scan 300 refused: no returns",
        "scans usable again after 2 refused",
    ]


def test_single_invalid_pulses_keep_their_position() -> None:
    ranges = scan().ranges.copy()
    ranges[[3, 7]] = np.nan
    directions = scan().directions.copy()
    directions[11, 1] = np.inf
    given = scan(ranges=ranges, directions=directions)
    out, events, _ = screen(make_obs(636, scans=(given,)))
    cleaned = out.scans[0]
    assert events == ["scan 600 cleaned: 3 of 20 pulses not a number"]
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(cleaned.ranges)), [3, 7, 11])
    assert np.isfinite(cleaned.directions).all()
    assert np.isinf(given.directions[11, 1]), "what was given is not written to"


FIRST = make_obs(636, scans=(scan(600),), images=(image(600),))


@pytest.mark.parametrize(("later", "said"), [
    ((scan(600, seed=1), image(600)), ("scan 600", "image 600", "repeats its time stamp")),
    ((scan(570, seed=1), image(540)),
     ("scan 570", "image 540", "older than one that came before it")),
    ((dataclasses.replace(scan(600), start_tick=600, end_tick=660),
      dataclasses.replace(image(600), tick=660)),
     ("scan 660", "image 660", "the same as the one before")),
])  # fmt: skip
def test_stamps_and_content_that_come_again(later: Any, said: tuple[str, str, str]) -> None:
    _, events, _ = screen(FIRST, make_obs(696, scans=later[:1], images=later[1:]))
    assert events == [f"{name} refused: {said[2]}" for name in said[:2]]


def test_two_swapped_messages_are_both_rejected_and_reported_once_for_each_sensor() -> None:
    swapped = make_obs(696, scans=(scan(660), scan(600)), images=(image(660), image(600)))
    out, events, _ = screen(swapped)
    assert out.scans == () and out.images == ()
    assert events == ["scan 660 refused: out of order", "image 660 refused: out of order"]


@pytest.mark.parametrize(("rgb", "word"), [
    (np.zeros((HEIGHT, WIDTH, 3), np.uint8), "no contrast"),
    (np.full((HEIGHT, WIDTH, 3), 255, np.uint8), "no contrast"),
    (np.zeros((HEIGHT, WIDTH), np.uint8), "uint8 of shape"),
    (np.zeros((HEIGHT, WIDTH, 3), np.float32), "float32 of shape"),
])  # fmt: skip
def test_images_that_are_refused(rgb: Any, word: str) -> None:
    out, events, _ = screen(make_obs(636, images=(image(rgb=rgb),)))
    assert out.images == () and len(events) == 1 and word in events[0]


def test_a_dropout_is_reported_once_and_so_is_its_end() -> None:
    first = make_obs(636, scans=(scan(600),))
    dropout = [make_obs(t) for t in range(639, 1200, 3)]
    back = make_obs(1236, scans=(scan(1200),))
    _, events, _ = screen(first, *dropout, back)
    assert events == ["no scan for 0.35 s", "scans again after 1.00 s"]
    assert screen(*dropout)[1] == [], "a sensor that never delivered has no dropout"


def test_an_invalid_imu_sample_is_replaced() -> None:
    def sample(tick: int, rate: float) -> ImuSample:
        return ImuSample(
            tick=tick, time_s=tick / 600, angular_velocity=np.full(3, rate),
            specific_force=np.ones(3),
        )  # fmt: skip

    out, events, _ = screen(
        make_obs(3, imu=(sample(3, 0.1),)), make_obs(6, imu=(sample(6, np.nan),))
    )
    assert out.imu[0].tick == 6 and out.imu[0].angular_velocity[0] == 0.1
    assert events == ["IMU sample 6 replaced by 3: not a number"]
    assert screen(make_obs(3, imu=(sample(3, np.inf),)))[0].imu == ()


def a_second(height: float, *events: str, **faults: Any) -> list[LidarScan]:
    """Ten scans, each a period after the other, with noise."""
    noisy = LidarParams(divergence=False)
    scan = look_down(PLANE, height, *events, params=noisy, **faults)
    rolled = [np.roll(scan.ranges, k) for k in range(10)]  # no content twice
    return [
        dataclasses.replace(
            scan, start_tick=60 * k, end_tick=60 * (k + 1), ranges=rolled[k],
            intensity=np.roll(scan.intensity, k),
        )
        for k in range(10)
    ]  # fmt: skip


def guarded(scans: list[LidarScan]) -> tuple[list[LidarScan], list[str]]:
    guard = InputGuard(RIG)
    kept: list[LidarScan] = []
    said: list[str] = []
    for scan in scans:
        kept += guard.screen(make_obs(scan.end_tick + 36, scans=(scan,))).scans
        said += guard.events
    return kept, said


@pytest.mark.parametrize("height", [1.0, 4.0, 30.0])
def test_clear_scans_pass_untouched(height: float) -> None:
    scans = a_second(height)
    kept, said = guarded(scans)
    assert all(a is b for a, b in zip(kept, scans, strict=True)) and not said


def test_rain_is_taken_out_from_the_third_scan_on() -> None:
    scans = a_second(30.0, "rain@0")
    kept, said = guarded(scans)
    false = (scans[0].ranges > 0.0) & (scans[0].ranges < 20.0)
    assert 0.005 < false.mean() < 0.03
    assert all(a is b for a, b in zip(kept[:2], scans[:2], strict=True))
    for k, scan in enumerate(kept[2:], start=2):
        mine = np.roll(false, k)
        assert np.isnan(scan.ranges[mine]).mean() > 0.95 and not np.isnan(scan.ranges[~mine]).any()
    assert len(said) == 1 and "echoes of rain or fog" in said[0]


def test_rain_is_still_known_near_the_ground() -> None:
    high, low = a_second(30.0, "rain@0"), a_second(3.0, "rain@0")
    later = [
        dataclasses.replace(s, start_tick=s.start_tick + 600, end_tick=s.end_tick + 600)
        for s in low
    ]
    kept, _ = guarded(high + later)
    ground = later[0].ranges > 2.9
    for k, scan in enumerate(kept[10:]):
        mine = np.roll(ground, k)
        assert not np.isnan(scan.ranges[mine]).any() and np.isnan(scan.ranges[~mine]).mean() > 0.4
    untold, said = guarded(low)
    assert all(a is b for a, b in zip(untold, low, strict=True)) and not said


def test_fog_too_thick_to_see_through_is_refused() -> None:
    _, said = guarded(a_second(30.0, "fog@0", fog_visibility_m=30.0))
    assert any("nothing but echoes of rain or fog" in text for text in said)
