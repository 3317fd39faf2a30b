"""Rejection of invalid messages, and estimators and mapper behind the guard."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from touchdown.estimator.guard import InputGuard
from touchdown.sim.api import CameraImage, ImuSample, LidarScan, Observation

from support.guard_support import RIG, obs

HEIGHT, WIDTH = RIG.camera.height, RIG.camera.width


def scan(end: int = 600, seed: int = 0, **changes: Any) -> LidarScan:
    rng = np.random.default_rng([end, seed])
    directions = np.tile(np.array([0.0, 0.0, 1.0], np.float32), (20, 1))
    values: dict[str, Any] = {
        "start_tick": end - 60, "end_tick": end,
        "start_time_s": (end - 60) / 600, "end_time_s": end / 600,
        "directions": directions,
        "ranges": rng.uniform(5.0, 9.0, 20).astype(np.float32),
        "time_offsets": np.linspace(0.005, 0.1, 20, dtype=np.float32),
        "intensity": np.full(20, 9, np.uint8),
    }  # fmt: skip
    return LidarScan(**(values | changes))


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
    whole = obs(636, scans=(scan(),), images=(image(),))
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
    out, events, guard = screen(obs(636, scans=(bad,)))
    assert out.scans == () and events == [f"scan {bad.end_tick} refused: {word}"]
    assert guard.refused == 1


def test_missing_returns_are_an_event_in_flight_only() -> None:
    def blind(end: int) -> LidarScan:
        return scan(end, ranges=np.zeros(20, np.float32))

    grounded = [obs(t + 36, scans=(blind(t),)) for t in (60, 120)]
    flying = [obs(t + 36, scans=(scan(t),)) for t in (180, 240)]
    blinded = [obs(t + 36, scans=(blind(t),)) for t in (300, 360)]
    again = [obs(456, scans=(scan(420),))]
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
    out, events, _ = screen(obs(636, scans=(given,)))
    cleaned = out.scans[0]
    assert events == ["scan 600 cleaned: 3 of 20 pulses not a number"]
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(cleaned.ranges)), [3, 7, 11])
    assert np.isfinite(cleaned.directions).all()
    assert np.isinf(given.directions[11, 1]), "what was given is not written to"


def test_stamps() -> None:
    first = obs(636, scans=(scan(600),), images=(image(600),))
    repeated = obs(696, scans=(scan(600, seed=1),), images=(image(600),))
    _, events, _ = screen(first, repeated)
    assert events == [
        "scan 600 refused: repeats its time stamp",
        "image 600 refused: repeats its time stamp",
    ]
    older = obs(696, scans=(scan(570, seed=1),), images=(image(540),))
    assert screen(first, older)[1] == [
        "scan 570 refused: older than one that came before it",
        "image 540 refused: older than one that came before it",
    ]


def test_two_swapped_messages_are_both_rejected() -> None:
    out, events, _ = screen(obs(696, scans=(scan(660), scan(600)), images=(image(660), image(600))))
    assert out.scans == () and out.images == ()
    # reported once for each sensor
    assert events == ["scan 660 refused: out of order", "image 660 refused: out of order"]


def test_a_frozen_sensor_is_detected_by_repeated_noise() -> None:
    frozen_scan = dataclasses.replace(scan(600), start_tick=600, end_tick=660)
    frozen_image = dataclasses.replace(image(600), tick=660)
    _, events, _ = screen(
        obs(636, scans=(scan(600),), images=(image(600),)),
        obs(696, scans=(frozen_scan,), images=(frozen_image,)),
    )
    assert events == [
        "scan 660 refused: the same as the one before",
        "image 660 refused: the same as the one before",
    ]


@pytest.mark.parametrize(("rgb", "word"), [
    (np.zeros((HEIGHT, WIDTH, 3), np.uint8), "no contrast"),
    (np.full((HEIGHT, WIDTH, 3), 255, np.uint8), "no contrast"),
    (np.zeros((HEIGHT, WIDTH), np.uint8), "uint8 of shape"),
    (np.zeros((HEIGHT, WIDTH, 3), np.float32), "float32 of shape"),
])  # fmt: skip
def test_images_that_are_refused(rgb: Any, word: str) -> None:
    out, events, _ = screen(obs(636, images=(image(rgb=rgb),)))
    assert out.images == () and len(events) == 1 and word in events[0]


def test_a_dropout_is_reported_once_and_so_is_its_end() -> None:
    first = obs(636, scans=(scan(600),))
    dropout = [obs(t) for t in range(639, 1200, 3)]
    back = obs(1236, scans=(scan(1200),))
    _, events, _ = screen(first, *dropout, back)
    assert events == ["no scan for 0.35 s", "scans again after 1.00 s"]
    assert screen(*dropout)[1] == [], "a sensor that never delivered has no dropout"


def test_an_invalid_imu_sample_is_replaced() -> None:
    def sample(tick: int, rate: float) -> ImuSample:
        return ImuSample(
            tick=tick, time_s=tick / 600, angular_velocity=np.full(3, rate),
            specific_force=np.ones(3),
        )  # fmt: skip

    out, events, _ = screen(obs(3, imu=(sample(3, 0.1),)), obs(6, imu=(sample(6, np.nan),)))
    assert out.imu[0].tick == 6 and out.imu[0].angular_velocity[0] == 0.1
    assert events == ["IMU sample 6 replaced by 3: not a number"]
    assert screen(obs(3, imu=(sample(3, np.inf),)))[0].imu == ()
