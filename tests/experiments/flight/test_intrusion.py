"""First sight of an intruder, and what was answered when."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from touchdown.experiments.flight.intrusion import IntrusionObserver
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.frames import Pose

DOWN = Pose(np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]), np.zeros(3))
LONG_AHEAD = Pose(np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]), np.zeros(3))
VEHICLE = SimpleNamespace(
    leg_height_m=0.3, rotor_spin=np.ones(4), thrust_coefficient=1.0, rotor_speed_max=2.0,
    mass_kg=1.0,
)  # fmt: skip
RIG: Any = SimpleNamespace(
    camera=CameraIntrinsics(width=848, height=480, fx=617.0, fy=625.0, cx=423.5, cy=239.5),
    body_from_camera=DOWN, body_from_lidar=LONG_AHEAD, lidar=SimpleNamespace(preset="horizon"),
    vehicle=VEHICLE,
)  # fmt: skip


def step(time_s: float, height: float, foot: Any, *events: str, sink: float = 2.0) -> Any:
    truth = SimpleNamespace(
        time_s=time_s, world_from_body=Pose(np.eye(3), np.array([0.0, 0.0, height])),
        velocity_world=np.array([0.0, 0.0, -sink]),
        intruders_world=np.array([foot], float) if foot else np.zeros((0, 3)),
    )  # fmt: skip
    return SimpleNamespace(truth=truth, lander_view=SimpleNamespace(events=events))


def test_the_time_from_first_sight_to_the_answer() -> None:
    observer = IntrusionObserver(RIG)
    assert observer.summary() is None
    observer.tick(step(1.0, 20.3, (0, 0, 0)))  # too high to be watched
    observer.tick(step(2.0, 10.3, (30, 0, 0)))  # far aside
    observer.tick(step(3.0, 10.3, (5, 0, 0), "DESCEND wind_aloft: something else"))
    observer.tick(step(3.4, 9.5, (4, 0, 0), "DESCEND site_not_clear: something moves"))
    observer.tick(step(4.0, 9.0, (3, 0, 0), "DESCEND site_not_clear: something moves"))
    found = observer.summary()
    assert found is not None
    assert (found.in_view_s, found.in_view_height_m) == (3.0, pytest.approx(10.0))
    assert (found.answered_s, found.reaction_s) == (3.4, pytest.approx(0.4))
    assert found.stopping_m == pytest.approx(2.0**2 / (2.0 * (16.0 - 9.80665)), rel=1e-3)


def test_an_answer_before_the_sight_takes_no_time_and_none_is_none() -> None:
    observer = IntrusionObserver(RIG)
    observer.tick(step(1.0, 3.3, (9, 0, 0), "DESCEND site_not_clear: expected"))
    observer.tick(step(2.0, 3.3, (0, 1, 0)))
    assert observer.summary().reaction_s == 0.0  # type: ignore[union-attr]
    unseen = IntrusionObserver(RIG)
    unseen.tick(step(1.0, 3.3, (9, 0, 0)))
    assert unseen.summary().in_view_s is None  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("foot", "preset", "seen"),
    [
        ((2.0, 0.0, 0.0), "horizon", True),  # 81.7 degrees along x: the feet
        ((2.9, 0.0, 0.0), "horizon", False),
        ((1.6, 0.0, 0.0), "mid360", True),  # a cone of 35 degrees
        ((2.4, 0.0, 0.0), "mid360", False),
        ((0.0, 1.9, 0.0), "horizon", True),  # the image along its long side
        ((0.0, 2.2, 0.0), "horizon", False),
    ],
)
def test_fields_of_view(foot: tuple[float, ...], preset: str, seen: bool) -> None:
    rig: Any = SimpleNamespace(**{**vars(RIG), "lidar": SimpleNamespace(preset=preset)})
    observer = IntrusionObserver(rig)
    observer.tick(step(1.0, 3.0, foot))
    assert (observer.summary().in_view_s is not None) is seen  # type: ignore[union-attr]
