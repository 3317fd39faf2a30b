"""First sight of an intruder, and what was answered when."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from touchdown.experiments.flight.intrusion import IntrusionObserver
from touchdown.landing.api import Phase, Verdict
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose

DOWN = Pose(np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]), np.zeros(3))
VEHICLE = SimpleNamespace(
    leg_height_m=0.3, rotor_spin=np.ones(4), thrust_coefficient=1.0, rotor_speed_max=2.0,
    mass_kg=1.0,
)  # fmt: skip
RIG: Any = SimpleNamespace(
    camera=CameraIntrinsics(width=848, height=480, fx=617.0, fy=625.0, cx=423.5, cy=239.5,
        distortion=np.array([-0.06, 0.0, 0.0, 0.0, 0.0])),
    body_from_camera=DOWN, body_from_lidar=DOWN,
    vehicle=VEHICLE,
)  # fmt: skip


def scan(point: Any, returns: int, end_s: float) -> Any:
    """A scan with returns from one point of the LIDAR's frame."""
    points = np.tile(np.asarray(point), (returns, 1))
    return SimpleNamespace(ranges=np.ones(returns), points=points, end_time_s=end_s)


def step(
    time_s: float,
    height: float,
    foot: Any,
    verdict: Verdict = Verdict.GO,
    *,
    sink: float = 2.0,
    scans: Any = (),
    phase: Phase = Phase.DESCEND,
    above: tuple[float, float] = (0.0, 0.0),
) -> Any:
    truth = SimpleNamespace(
        time_s=time_s, world_from_body=Pose(np.eye(3), np.array([*above, height])),
        velocity_world=np.array([0.0, 0.0, -sink]),
        intruders_world=np.array([foot], float) if foot else np.zeros((0, 3)),
    )  # fmt: skip
    obs = SimpleNamespace(scans=scans)
    watch = SimpleNamespace(verdict=verdict)
    view = SimpleNamespace(phase=phase, watch=watch, reference_world=np.array([*above, height]))
    return SimpleNamespace(truth=truth, obs=obs, lander_view=view)


def seen_after(*steps: Any) -> Any:
    observer = IntrusionObserver(RIG)
    for each in steps:
        observer.tick(each)
    found = observer.summary()
    assert found is not None
    return found


def test_the_time_from_first_sight_to_the_answer() -> None:
    assert IntrusionObserver(RIG).summary() is None
    found = seen_after(
        step(1.0, 20.3, (0, 0, 0)),  # too high to be watched
        step(2.0, 10.3, (30, 0, 0)),  # far aside
        step(2.5, 10.3, (0, 5, 0), phase=Phase.APPROACH),  # nothing to interrupt
        step(3.0, 10.3, (0, 5, 0)),
        step(3.2, 9.5, (0, 4, 0), Verdict.WAIT),  # it still sinks
        step(3.4, 9.5, (0, 4, 0), Verdict.WAIT),
        step(4.0, 9.5, (0, 3, 0), Verdict.WAIT),
    )
    assert (found.in_view_s, found.in_view_height_m) == (3.0, pytest.approx(10.0))
    assert (found.answered_s, found.reaction_s) == (3.4, pytest.approx(0.4))
    assert found.stopping_m == pytest.approx(2.0**2 / (2.0 * (16.0 - 9.80665)), rel=1e-3)


def test_an_answer_before_the_sight_takes_no_time_and_none_is_none() -> None:
    found = seen_after(
        step(0.9, 3.3, None),
        step(1.0, 3.3, None, Verdict.WAIT),
        step(1.5, 3.3, (9, 0, 0), Verdict.WAIT),
        step(2.0, 3.3, (0, 1, 0), Verdict.WAIT),
        step(3.0, 3.3, (0, 1, 0)),
    )
    assert (found.answered_s, found.reaction_s) == (1.0, 0.0)
    assert seen_after(step(1.0, 3.3, (9, 0, 0))).in_view_s is None


def test_an_interruption_that_ended_before_the_sight_is_no_answer() -> None:
    found = seen_after(
        step(0.9, 3.3, (9, 0, 0)),
        step(1.0, 3.3, (9, 0, 0), Verdict.WAIT),
        step(1.5, 3.2, (9, 0, 0)),
        step(2.0, 3.1, (0, 1, 0)),
        step(3.5, 3.1, (0, 1, 0), Verdict.WAIT),
    )
    assert (found.answered_s, found.reaction_s) == (3.5, 1.5)


@pytest.mark.parametrize(
    ("aside", "height", "seen"),
    [
        (1.9, 3.0, True),  # the image along its long side
        (2.2, 3.0, False),
        (3.27, 1.0, False),  # where the lens would fold him back into the image
    ],
)
def test_the_field_of_view_of_the_camera(aside: float, height: float, seen: bool) -> None:
    found = seen_after(step(1.0, height, (0.0, aside, 0.0)))
    assert (found.in_view_s is not None) is seen


@pytest.mark.parametrize(
    ("beside_m", "up_m", "returns", "seen"),
    [(0.0, 1.0, 6, True), (0.0, 1.0, 5, False), (0.9, 1.0, 6, False), (0.0, 0.1, 6, False)],
)
def test_returns_of_a_scan_from_him(beside_m: float, up_m: float, returns: int, seen: bool) -> None:
    foot, body = np.array([6.0, 0.0, 0.0]), np.array([0.0, 0.0, 3.0])
    away = DOWN.inverse().apply(foot + [beside_m, 0.0, up_m] - body)
    scans = (scan(away, returns, 1.0),)
    found = seen_after(step(1.0, 3.0, tuple(foot)), step(1.01, 3.0, tuple(foot), scans=scans))
    assert (found.in_view_s is not None) is seen


def test_farther_away_than_eight_metres_nobody_counts() -> None:
    far = step(1.0, 14.0, (0.0, 8.1, 0.0))
    assert seen_after(far).in_view_s is None
    assert seen_after(far, step(2.0, 14.0, (0.0, 7.9, 0.0))).in_view_s == 2.0


@pytest.mark.parametrize(("height", "avoidable"), [(3.3, True), (3.1, False)])
def test_who_is_seen_too_late_cannot_be_avoided(height: float, avoidable: bool) -> None:
    """2 m, and 0.3 s at 2 m/s, and 0.32 m to brake, and legs of 0.3 m."""
    assert seen_after(step(1.0, height - 0.05, (0, 1, 0))).avoidable is avoidable
    assert seen_after(step(1.0, 3.3, (9, 0, 0))).avoidable is False


def test_who_stands_on_a_hill_far_from_the_origin_is_below_by_the_difference() -> None:
    found = seen_after(step(3.0, 25.3, (-40, 30, 15), above=(-40.0, 28.0)))
    assert found.in_view_height_m == pytest.approx(10.0)
