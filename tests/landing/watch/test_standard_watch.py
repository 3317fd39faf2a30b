"""The standard watch over synthetic ground with boxes that stand, appear and move."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from touchdown.experiments.external.synthetic_descent import Box, Descent
from touchdown.experiments.external.synthetic_stream import synthetic_rig
from touchdown.landing.api import LandingParams, Verdict, WatchReport, WatchRig
from touchdown.landing.watch.people import Person
from touchdown.landing.watch.standard import StandardWatch
from touchdown.sim.api import CameraImage
from touchdown.sim.frames import Pose, rotation_from_yaw

PERSON = (0.4, 0.5, 1.7)
BOX_S = 1.5
SCAN_S, LATENCY_S = 0.1, 0.08
"""period of scans, and from the end of one until it is looked at, at the most"""


def watched(descent: Descent) -> list[tuple[float, WatchReport]]:
    rig = synthetic_rig()
    watch = StandardWatch(WatchRig(sensors=rig, landing=LandingParams()))
    return [(seen.obs.time_s, watch.look(seen)) for seen in descent.seen(rig)]


def first(reports: list[tuple[float, WatchReport]]) -> tuple[float, str]:
    """When the descent was first interrupted, and why; inf where it was not."""
    found = [(t, report.reason) for t, report in reports if report.verdict is not Verdict.GO]
    return found[0] if found else (math.inf, "")


def at(height_m: float) -> Pose:
    return Pose(np.eye(3), np.array([0.0, 0.0, height_m]))


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("returned", [1.0, 0.25])
def test_a_box_that_appears_near_the_site_is_reported_within_two_scans(
    known: bool, returned: float
) -> None:
    near = Box(middle=(0.0, 1.0), from_s=BOX_S)
    time_s, reason = first(watched(Descent(boxes=(near,), known=known, returned=returned)))
    assert BOX_S < time_s <= BOX_S + 2 * SCAN_S + LATENCY_S + 0.02
    assert reason.startswith("something new, 0.") and reason.endswith("m from the site")


def test_the_same_box_six_metres_away_does_not_matter() -> None:
    far = (Box(middle=(0.0, 6.0), from_s=BOX_S),)
    reports = watched(Descent(boxes=far, pose_at=lambda _: at(9.0)))
    assert first(reports)[0] == math.inf
    (found,) = reports[-1][1].findings
    assert found.kind == "new" and found.distance_m == pytest.approx(5.7, abs=0.2)


def test_a_walker_towards_the_site_is_predicted() -> None:
    walker = Box(middle=(0.0, 5.5), size=PERSON, velocity=(0.0, -1.5))
    reports = watched(Descent(boxes=(walker,), touchdown_s=4.0, pose_at=lambda _: at(7.0)))
    time_s, reason = first(reports)
    assert reason.startswith("something that moves ") and time_s < 1.4
    found = next(report.findings[0] for t, report in reports if t == time_s)
    np.testing.assert_allclose(found.velocity_odom, [0.0, -1.5], atol=0.2)
    assert found.distance_m > 3.0 and found.height_m == pytest.approx(1.7, abs=0.1)


def test_who_cannot_be_there_soon_is_seen_twice_before_he_moves() -> None:
    walkers = tuple(Box(middle=(0.0, y), size=PERSON, velocity=(0.0, -1.5)) for y in (2.9, 5.5))
    reports = watched(Descent(boxes=walkers, pose_at=lambda _: at(7.0)))
    moving = ([f for f in report.findings if f.kind == "moving"] for _, report in reports)
    (near,) = next(filter(None, moving))
    assert near.position_odom[1] < 3.0


@pytest.mark.parametrize("comes", [True, False])
def test_a_walker_through_a_meadow_is_predicted(comes: bool) -> None:
    walker = Box(middle=(0.0, 5.5 if comes else 60.0), size=PERSON, velocity=(0.0, -1.5))
    descent = Descent(
        boxes=(walker,), plants_m=0.3, known=False, around=True, touchdown_s=5.0,
        pose_at=lambda _: at(6.0),
    )  # fmt: skip
    time_s, reason = first(watched(descent))
    assert (reason[:20] == "something that moves" and time_s < 2.0) if comes else not reason


def test_a_walker_who_leaves_does_not_matter() -> None:
    """He has passed by when the vehicle touches down."""
    walker = Box(middle=(0.5, 3.0), size=PERSON, velocity=(0.0, 1.2))
    reports = watched(Descent(boxes=(walker,), touchdown_s=4.0, pose_at=lambda _: at(8.0)))
    assert first(reports)[0] == math.inf
    assert any(f.kind == "moving" for _, report in reports for f in report.findings)


def test_motion_of_the_vehicle_is_no_motion_of_things() -> None:
    """At 1 m/s and turning, things come into view and leave it."""
    boxes = (Box(middle=(0.0, 2.0)), Box(middle=(0.6, -1.5)), Box(middle=(-1.2, 2.8)))

    def pose_at(t: float) -> Pose:
        return Pose(rotation_from_yaw(0.4 * t), np.array([1.0 * t - 1.5, 0.5, 6.0]))

    reports = watched(Descent(pose_at=pose_at, boxes=boxes, known=False))
    assert first(reports)[0] == math.inf
    found = [finding for _, report in reports for finding in report.findings]
    assert len(found) > 50 and {finding.kind for finding in found} == {"known"}


@pytest.mark.parametrize("drift", [(0.3, -0.2, 0.0), (0.0, 0.0, 0.3)])
def test_a_drifting_position_changes_nothing(drift: tuple[float, float, float]) -> None:
    """The map as it was drifts away, but by less than things are compared over."""
    still = Descent(boxes=(Box(middle=(0.0, 4.0), size=PERSON),), drift_mps=drift)
    assert first(watched(still))[0] == math.inf
    box = (Box(middle=(0.0, 1.0), from_s=BOX_S),)
    moved, fixed = watched(Descent(boxes=box, drift_mps=drift)), watched(Descent(boxes=box))
    assert first(moved)[0] == first(fixed)[0]


def test_who_stands_where_the_map_has_nobody_is_new() -> None:
    """A map from before is what tells; a drop of 0.1 m is no person."""
    person = Box(middle=(0.0, 1.5), size=PERSON)
    reason = first(watched(Descent(boxes=(person,))))[1]
    assert reason.startswith(("something new, 1.7", "something new, 1.8"))
    assert first(watched(Descent(boxes=(person,), known=False)))[0] == math.inf
    low = dataclasses.replace(person, size=(0.4, 0.5, 0.2))
    assert first(watched(Descent(boxes=(low,))))[0] == math.inf


def test_something_under_the_legs_is_in_the_way_even_where_the_map_has_it() -> None:
    box, low = Box(middle=(0.0, 0.3)), Box(middle=(0.0, 0.3), size=(0.5, 0.5, 0.25))
    found = [first(watched(Descent(boxes=(one,), known=False)))[1] for one in (box, low)]
    assert found[0].endswith("m high under the legs") and not found[1]  # as high as plants


def test_a_slope_is_ground() -> None:
    assert first(watched(Descent(slope=0.2, known=False)))[0] == math.inf


def test_a_scene_that_clears_lets_the_descent_go_on_after_a_second() -> None:
    walker = Box(middle=(0.0, 0.0), size=PERSON, velocity=(0.0, 1.5))
    reports = watched(Descent(boxes=(walker,), seconds=4.0, pose_at=lambda _: at(7.0)))
    waits = [t for t, report in reports if report.verdict is Verdict.WAIT]
    last_near = (2.0 + 0.25) / 1.5
    assert waits[0] < 1.0 and last_near + 0.9 < waits[-1] < last_near + 1.3
    assert reports[-1][1].verdict is Verdict.GO


def test_low_down_it_asks_to_climb_after_a_while_and_higher_up_it_waits() -> None:
    box = Box(middle=(0.0, 1.0), from_s=0.5)
    for high, expected in ((6.0, Verdict.CLIMB), (11.0, Verdict.WAIT)):
        descent = Descent(boxes=(box,), seconds=5.0, slope=0.18, pose_at=lambda _, h=high: at(h))
        reports = watched(descent)
        assert reports[-1][1].verdict is expected
        early = {report.verdict for t, report in reports if t < first(reports)[0] + 2.9}
        assert Verdict.CLIMB not in early


def test_within_reach_it_climbs_at_once() -> None:
    box = Box(middle=(0.0, 1.0), from_s=0.5)
    reports = watched(Descent(boxes=(box,), seconds=1.2, pose_at=lambda _: at(3.0)))
    assert {report.verdict for _, report in reports} == {Verdict.GO, Verdict.CLIMB}


@pytest.mark.parametrize(
    ("size", "away_m", "mps"), [((0.6, 0.6, 1.8), 13.0, 2.0), ((0.6, 0.15, 0.5), 5.5, 1.5)]
)
def test_a_lidar_that_looks_around_sees_who_comes_from_aside(
    size: tuple[float, float, float], away_m: float, mps: float
) -> None:
    """Somebody who is as far away as the watch looks, and a dog, of which it sees the side."""
    who = Box(middle=(0.0, away_m), size=size, velocity=(0.0, -mps))
    around, down = (
        Descent(boxes=(who,), seconds=1.8, touchdown_s=5.0, around=all_, pose_at=lambda _: at(3.0))
        for all_ in (True, False)
    )
    time_s, reason = first(watched(around))
    assert reason.startswith("something that moves ") and away_m - mps * time_s > 0.6 * away_m
    assert first(watched(down))[0] == math.inf


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize(("height_m", "returned"), [(2.9, 0.1), (10.0, 0.35)])
def test_a_dog_is_seen_by_few_returns(height_m: float, returned: float, seed: int) -> None:
    """Low down by those of two scans, from higher up as they are above all from before."""
    dog = Box(middle=(0.0, 6.5), size=(0.6, 0.25, 0.5), velocity=(0.0, -2.0))
    descent = Descent(
        boxes=(dog,), seconds=2.0, touchdown_s=5.0, around=True, returned=returned, seed=seed,
        pose_at=lambda _: at(height_m),
    )  # fmt: skip
    assert first(watched(descent))[1].startswith("something that moves ")


@pytest.mark.parametrize("around", [True, False])
def test_in_the_last_metre_only_who_comes_is_in_the_way(around: bool) -> None:
    """A dog that runs up, where LIDARs look around; not a box that appears, but where it was in the
    way from higher up."""
    dog = Box(middle=(0.0, 6.0), size=(0.6, 0.25, 0.55), velocity=(0.0, -2.0))
    box = Box(middle=(0.2, 0.2), from_s=0.8)

    def reports(thing: Box, height_m: float, sinks_mps: float = 0.0) -> list[Verdict]:
        descent = Descent(
            boxes=(thing,), seconds=2.2, touchdown_s=2.0, around=around,
            pose_at=lambda t: at(height_m - sinks_mps * max(t - 1.2, 0.0)),
        )  # fmt: skip
        return [report.verdict for _, report in watched(descent)]

    assert (Verdict.CLIMB in reports(dog, 0.7)) is around
    assert set(reports(box, 0.7)) == {Verdict.GO}
    assert reports(box, 1.4, 0.6)[-1] is Verdict.CLIMB


def test_what_stays_in_the_way_is_evaded_where_the_ground_is_level_and_free() -> None:
    boxes = (Box(middle=(0.0, 1.0), from_s=0.5), Box(middle=(0.0, -1.6), size=(2.0, 1.0, 0.5)))
    reports = watched(Descent(boxes=boxes, seconds=4.0, pose_at=lambda _: at(8.0)))
    moves = [(t, report) for t, report in reports if report.verdict is Verdict.MOVE]
    assert moves[0][0] == pytest.approx(first(reports)[0] + 2.0, abs=0.25)
    aside = moves[0][1].aside_odom
    assert aside is not None and np.hypot(*(aside - [0.0, 1.0])) > 2.4 and np.hypot(*aside) < 4.0
    assert max(abs(aside[0]) - 1.0, abs(aside[1] + 1.6) - 0.5) > 0.8


@pytest.mark.parametrize(
    ("slope", "boxes", "words"),
    [(0.3, (), "the ground slopes by 17 degrees"),
     (0.0, (Box(middle=(0.0, 4.0), size=(9.0, 8.0, 0.8)),), "a step of 0.")],
)  # fmt: skip
def test_bad_ground_is_told(slope: float, boxes: tuple[Box, ...], words: str) -> None:
    assert first(watched(Descent(slope=slope, boxes=boxes, known=False)))[1].startswith(words)


def test_water_is_what_the_map_has_no_returns_of() -> None:
    rig = synthetic_rig()
    watch = StandardWatch(WatchRig(sensors=rig, landing=LandingParams()))
    for seen in Descent(seconds=1.0).seen(rig):
        grid = seen.map_view.coarse
        lost = dataclasses.replace(grid, missing=2.0 * grid.count)
        view = dataclasses.replace(seen.map_view, coarse=lost)
        report = watch.look(dataclasses.replace(seen, map_view=view))
    assert report.reason == "water under the legs"


def test_without_returns_it_says_that_nothing_is_watched() -> None:
    report = watched(Descent(returned=0.0))[-1][1]
    assert report.verdict is Verdict.GO and "not watched" in report.reason
    assert watched(Descent())[-1][1].height_m == pytest.approx(6.0, abs=0.05)


@pytest.mark.parametrize(
    ("away_m", "mps", "hedge", "said"),
    [(2.0, 0.0, True, "somebody "), (2.0, 0.0, False, ""), (4.5, 0.0, True, ""),
     (5.5, -1.4, True, "somebody "), (3.7, 1.4, True, "")],
)  # fmt: skip
def test_somebody_in_images_near_the_site_is_in_the_way(
    away_m: float, mps: float, hedge: bool, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """He stands still, or walks towards the site, along a hedge or where scans show bare ground."""
    rig = synthetic_rig()
    boxes = (Box(middle=(0.0, -4.5), size=(0.6, 6.4, 1.0)),) if hedge else ()
    descent = Descent(pose_at=lambda _: at(9.0), boxes=boxes, known=False)
    place = [away_m]

    class Detector:
        def __init__(self, _network: Path) -> None: ...

        def find(self, _image: object, metres_per_pixel: float) -> tuple[Person, ...]:
            assert metres_per_pixel == pytest.approx(9.0 / rig.camera.fx, rel=0.03)
            u = rig.camera.cx + rig.camera.fx * place[0] / (9.0 - 0.8)
            return (Person(u - 9, rig.camera.cy - 9, u + 9, rig.camera.cy + 9, 0.9),)

    monkeypatch.setattr("touchdown.landing.watch.standard.PeopleDetector", Detector)
    watch = StandardWatch(
        WatchRig(sensors=rig, landing=LandingParams(people_network="people.onnx"))
    )
    assert watch.needs.camera_hz == 5 and StandardWatch.needs.camera_hz == 0
    reasons, last_s, first = [], 0.0, None
    for seen in descent.seen(rig):
        obs = seen.obs
        if obs.time_s >= last_s + 0.2:
            last_s = obs.time_s
            place[0] += 0.2 * mps
            picture = CameraImage(tick=obs.tick, time_s=last_s, rgb=np.zeros((2, 2, 3), np.uint8))
            seen = dataclasses.replace(seen, obs=dataclasses.replace(obs, images=(picture,)))
        reasons.append(watch.look(seen).reason)
        first = first or (seen if reasons[-1] else None)
    assert any(reasons) is bool(said) and all(r.startswith(said) for r in reasons if r)
    assert (first is None) is not bool(said)
    if first is not None:  # the image alone, before the next scan
        assert first.obs.images and not first.obs.scans
        if mps:  # before he is there
            assert float(next(filter(None, reasons)).split()[1]) > 3.6


def test_images_of_the_last_metre_are_not_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    rig, asked = synthetic_rig(), []

    class Detector:
        def __init__(self, _network: Path) -> None: ...

        def find(self, _image: object, _metres_per_pixel: float) -> tuple[Person, ...]:
            asked.append(1)
            return ()

    monkeypatch.setattr("touchdown.landing.watch.standard.PeopleDetector", Detector)
    for height_m, looks in ((1.1, False), (1.3, True)):
        watch = StandardWatch(
            WatchRig(sensors=rig, landing=LandingParams(people_network="people.onnx"))
        )
        for seen in Descent(pose_at=lambda _, z=height_m: at(z), seconds=0.5).seen(rig):
            obs = seen.obs
            picture = CameraImage(
                tick=obs.tick, time_s=obs.time_s, rgb=np.zeros((2, 2, 3), np.uint8)
            )
            watch.look(dataclasses.replace(seen, obs=dataclasses.replace(obs, images=(picture,))))
        assert bool(asked) is looks
