"""Scheduled faults: the affected messages and the effects."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from touchdown.experiments.errors import UsageError
from touchdown.experiments.flight.conditions import inactive_faults
from touchdown.experiments.flight.run import fly
from touchdown.sim.api import FAULT_KINDS, FaultParams, SensorNeeds
from touchdown.sim.faults.injector import FaultInjector
from touchdown.sim.faults.types import WORLD_KINDS, parse_fault

from support.fault_support import COUNT, HZ, LATENCY, PERIOD, delivered, scan, world
from support.worlds import load_ideal_config as load_config


def arrivals(*events: str, **more: Any) -> list[int]:
    return [tick for tick, _ in delivered(*events, **more)]


CLEAN = [k * PERIOD + LATENCY for k in range(1, 25)]


def test_without_a_schedule_observations_pass_untouched() -> None:
    injector = FaultInjector(FaultParams(), HZ)
    for obs in world(300):
        assert injector.apply(obs) is obs
    assert arrivals() == CLEAN


def test_a_fault_lasts_to_the_end_unless_it_says_otherwise() -> None:
    # 1.05 s is tick 630; the scan delivered at 636 ended at 600
    assert arrivals("lidar_dropout@1.05") == [t for t in CLEAN if t < 636]
    assert arrivals("lidar_dropout@1.06") == [t for t in CLEAN if t < 636]
    assert arrivals("lidar_dropout@1.065") == [t for t in CLEAN if t < 696]
    assert arrivals("lidar_dropout@1.05", stream="images") == CLEAN


def test_a_count_is_of_messages_of_each_stream() -> None:
    assert arrivals("lidar_dropout@1.05*1") == [t for t in CLEAN if t != 636]
    assert arrivals("lidar_dropout@1.05*3") == [t for t in CLEAN if t not in (636, 696, 756)]
    for stream in ("scans", "images"):
        stamps = [m.tick if stream == "images" else m.end_tick for _, m in
                  delivered("timestamp_repeat@1.05*2", stream=stream)]  # fmt: skip
        assert stamps[8:12] == [540, 540, 540, 720]


def test_a_fault_with_duration_ends_before_its_last_tick() -> None:
    # from tick 636 up to and without tick 636 + 600
    gone = [t for t in CLEAN if 636 <= t < 1236]
    assert len(gone) == 10
    assert arrivals("lidar_dropout@1.06+1") == [t for t in CLEAN if t not in gone]
    assert arrivals("camera_dropout@1.06+1", stream="images") == [t for t in CLEAN if t not in gone]
    assert arrivals("gps_dropout@1.06+1", stream="gps") == [t for t in CLEAN if t not in gone]


@pytest.mark.parametrize("kind", ["lidar_nan", "lidar_empty", "lidar_blind"])
def test_faulty_scans_keep_their_stamps(kind: str) -> None:
    hit = dict(delivered(f"{kind}@1.05*1"))[636]
    assert (hit.start_tick, hit.end_tick) == (540, 600)
    if kind == "lidar_nan":
        assert np.isnan(hit.ranges).all() and np.isnan(hit.directions).all()
        assert len(hit.ranges) == COUNT
    elif kind == "lidar_empty":
        assert hit.points.shape == (0, 3) and len(hit.time_offsets) == len(hit.intensity) == 0
    else:
        assert len(hit.ranges) == COUNT and not hit.ranges.any() and not hit.intensity.any()
    clean = dict(delivered())
    for tick, message in delivered(f"{kind}@1.05*1"):
        if tick != 636:
            np.testing.assert_array_equal(message.ranges, clean[tick].ranges)


def test_a_soiled_window_takes_a_sector() -> None:
    """Eight beams in a cone about the boresight, from 0 degrees in steps of 45."""
    azimuth = np.radians(np.arange(0.0, 360.0, 45.0))
    cone = np.stack([np.cos(azimuth), np.sin(azimuth), np.ones(8)], axis=1).astype(np.float32)
    whole = dataclasses.replace(
        world(636)[-1], scans=(dataclasses.replace(scan(600), directions=cone),)
    )
    params = FaultParams(events=("lidar_soiled@1",), soiled_deg=(340.0, 100.0))
    soiled = FaultInjector(params, HZ).apply(whole).scans[0]
    lost = np.isin(np.arange(8), (0, 1, 2))
    np.testing.assert_array_equal(soiled.ranges == 0.0, lost)
    np.testing.assert_array_equal(soiled.intensity == 0, lost)


def test_black_images() -> None:
    images = dict(delivered("camera_black@1.06+0.2", stream="images"))
    dark = [tick for tick, message in images.items() if not message.rgb.any()]
    assert dark == [636, 696]


def test_a_frozen_sensor_shows_its_last_content_under_new_stamps() -> None:
    frozen = dict(delivered("lidar_frozen@1.06+0.2"))
    for tick in (636, 696):
        assert frozen[tick].end_tick == tick - LATENCY
        np.testing.assert_array_equal(frozen[tick].ranges, scan(540).ranges)
    np.testing.assert_array_equal(frozen[756].ranges, scan(720).ranges)
    still = dict(delivered("gps_frozen@1.06*1", stream="gps"))[636]
    assert still.tick == 600 and still.position_world[0] == pytest.approx(0.9)


def test_a_late_sensor_delivers_everything_in_order() -> None:
    late = delivered("lidar_late@1.06+0.2", late_s=0.3)
    assert [message.end_tick for _, message in late] == [t - LATENCY for t in CLEAN][: len(late)]
    due = {message.end_tick: tick for tick, message in late}
    assert due[600] == 636 + 180 and due[660] == 696 + 180
    # later messages do not overtake them
    assert due[720] == 696 + 180 and due[780] == 696 + 180 and due[840] == 876 and due[900] == 936


def test_a_repeated_stamp() -> None:
    repeated = dict(delivered("timestamp_repeat@1.05*1"))[636]
    assert (repeated.start_tick, repeated.end_tick) == (480, 540)
    assert repeated.end_time_s == pytest.approx(0.9)
    np.testing.assert_array_equal(repeated.ranges, scan(600).ranges)
    assert dict(delivered("timestamp_repeat@1.05*1", stream="images"))[636].tick == 540


def test_swapped_stamps() -> None:
    """The first waits for the second; each carries the other's stamps."""
    swapped = [(t, m) for t, m in delivered("timestamp_swap@1.05*2") if 600 < t < 760]
    assert [t for t, _ in swapped] == [696, 696, 756]
    first, second = swapped[0][1], swapped[1][1]
    assert (first.end_tick, second.end_tick) == (660, 600)
    np.testing.assert_array_equal(first.ranges, scan(600).ranges)
    np.testing.assert_array_equal(second.ranges, scan(660).ranges)


def test_a_jump_of_satellite_positions() -> None:
    jumped = dict(delivered("gps_jump@1.06+0.1", stream="gps", gps_jump_m=(3.0, -2.0, 1.0)))
    np.testing.assert_allclose(jumped[636].position_world, [4.0, -2.0, 1.0])
    np.testing.assert_allclose(jumped[696].position_world, [1.1, 0.0, 0.0])


def counted(*events: str) -> dict[str, dict[str, str]]:
    """Changed of came messages by fault and stream."""
    injector = FaultInjector(FaultParams(events=events), HZ)
    for obs in world():
        injector.apply(obs)
    return {
        entry["fault"]: {
            stream: f"{changed} of {entry['came'][stream]}"
            for stream, changed in entry["messages"].items()
        }
        for entry in injector.summary()
    }


def test_faults_add_up_and_are_counted() -> None:
    # a lost scan has no further fault; 14 of 24 messages come from 0.96 s on, 8 from 1.5 s
    assert counted("lidar_dropout@1.06+0.2", "lidar_nan@1.06+0.3", "timestamp_swap@2*2") == {
        "lidar_dropout@1.06+0.2": {"scans": "2 of 2"},
        "lidar_nan@1.06+0.3": {"scans": "1 of 3"},
        "timestamp_swap@2*2": {"scans": "2 of 5", "images": "2 of 5"},
    }
    assert counted("camera_black@1.05", "lidar_nan@1.05*1", "gps_jump@9") == {
        "camera_black@1.05": {"images": "15 of 15"},
        "lidar_nan@1.05*1": {"scans": "1 of 15"},
        "gps_jump@9": {"gps": "0 of 0"},
    }


def test_what_repeats_the_last_message_needs_one() -> None:
    assert counted("camera_frozen@0", "timestamp_repeat@0") == {
        "camera_frozen@0": {"images": "23 of 24"},
        "timestamp_repeat@0": {"scans": "23 of 24", "images": "23 of 24"},
    }


def test_messages_given_are_not_written_to() -> None:
    for kind in FAULT_KINDS.keys() - WORLD_KINDS:
        observations = world(900)
        injector = FaultInjector(FaultParams(events=(f"{kind}@0.5+0.5",)), HZ)
        for obs in observations:
            injector.apply(obs)
        for obs, clean in zip(observations, world(900), strict=True):
            for a, b in zip(obs.scans, clean.scans, strict=True):
                np.testing.assert_array_equal(a.ranges, b.ranges)
            for c, d in zip(obs.images, clean.images, strict=True):
                np.testing.assert_array_equal(c.rgb, d.rgb)


@pytest.mark.parametrize("kind", FAULT_KINDS)
def test_every_kind_is_read_back(kind: str) -> None:
    assert parse_fault(f"{kind}@12.5").text == f"{kind}@12.5"
    if kind != "intruder":
        assert parse_fault(f"{kind}@12.5+1").duration_s == 1.0
    if kind not in WORLD_KINDS or kind == "gust":
        assert parse_fault(f"{kind}@12.5*2").text == f"{kind}@12.5*2"
    else:
        with pytest.raises(ValueError, match=f"{kind} acts on the world.* give {kind}@START or"):
            parse_fault(f"{kind}@12.5*2")


@pytest.mark.parametrize(("override", "text", "fragment"), [
    ("", "lidar_nam@20", "unknown fault 'lidar_nam'"), ("", "lidar_nan", "KIND@START"),
    ("", "lidar_nan@-3", "KIND@START"), ("", "lidar_nan@1.2.3", "must be numbers"),
    ("", "lidar_nan@3+0", "DURATION must be above 0"), ("", "lidar_nan@3*0", "N must be 1 or more"),
    ("", "lidar_nan@3+1*2", "KIND@START"), ("", "lidar_nan@3*1.5", "KIND@START"),
    ("", "timestamp_swap@3*1", "even N, such as \\*2"), ("", "@3", "KIND@START"),
    ("", "", "KIND@START"), ("", "low_sun@5", "give low_sun@0"),
    ("", "intruder@8m+5", "last traffic.intruder_stays_s"),
    ("", "low_sun@0+5", "give low_sun@0"), ("faults.motor=12", "fog@0", "must be within 0 to 11"),
    ("faults.motor_loss_fraction=1.1", "fog@0", "within 0 to 1"),
    ("faults.fog_visibility_m=1.0", "fog@0", "must be within 5 to 100000"),
    ("wind.mean_kmh=40.0", "gust@5", "gust_kmh = 30 is below wind.mean_kmh = 40"),
])  # fmt: skip
def test_invalid_schedules_are_reported_in_one_line(
    override: str, text: str, fragment: str
) -> None:
    with pytest.raises(UsageError, match=fragment) as caught:
        load_config(None, [override] if override else [], fault=(text,))
    assert "\n" not in str(caught.value)


ALL_AT_DIFFERENT_TIMES = (
    "lidar_nan@18*1", "lidar_empty@19*1", "lidar_blind@20*1", "camera_black@21*1",
    "timestamp_repeat@22*1", "timestamp_swap@23*2", "lidar_dropout@25+1", "camera_dropout@28+1",
    "lidar_frozen@31*1", "camera_frozen@32*1", "lidar_late@33*1", "camera_late@35*1",
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["livo", "zou2024"])
def test_a_survey_with_all_of_them(estimator: str) -> None:
    """`pytest -m slow -s tests/sim/faults/test_faults.py` prints the errors."""
    config = load_config(
        None, ["sim.threads=1"], scene="crossroad", seed=0, estimator=estimator,
        survey_only=True, record=False, fault=ALL_AT_DIFFERENT_TIMES,
    )  # fmt: skip
    result = fly(config, None).plain()
    print(f"\n{estimator}: {result['position_error_m']}")
    for event in result["events"]:
        print(f"{event['time_s']:8.2f} {event['text']}")
    assert result["outcome"] == "COMPLETED"
    assert result["position_error_m"]["max"] < 0.25
    text = " / ".join(event["text"] for event in result["events"])
    for fragment in ("not a number", "no pulses", "no returns", "no contrast", "repeats its time",
                  "out of order", "no scan for", "no image for", "the same as"):  # fmt: skip
        assert fragment in text
    assert len(result["faults"]) == len(ALL_AT_DIFFERENT_TIMES)
    assert all(sum(entry["messages"].values()) > 0 for entry in result["faults"])


def test_a_fault_of_an_unused_sensor_is_reported() -> None:
    schedule = ["gps_dropout@20+5", "lidar_nan@3", "fog@0", "gust@9"]
    config = load_config(estimator="livo", fault=schedule)
    all_but_gps = SensorNeeds(camera_hz=10, lidar=True)
    (sentence,) = inactive_faults(config, all_but_gps)
    assert "'gps_dropout@20+5' has no effect" in sentence and "'livo'" in sentence
    assert inactive_faults(config, SensorNeeds(camera_hz=5, lidar=True, gps=True)) == []
    dark = inactive_faults(config, SensorNeeds(gps=True))
    assert [sentence.split("'")[1] for sentence in dark] == ["lidar_nan@3", "fog@0"]
    assert dark[1].endswith("reads the LIDAR or the camera")


def test_an_entry_counts_once() -> None:
    with pytest.raises(ValueError, match="'fog@3' is listed twice"):
        FaultParams(events=("fog@3", "gust@4", "fog@3")).check(0.0)
