"""What a mission does with what its watch says."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from touchdown.landing.api import Finding, Phase, Verdict, WatchInput, WatchReport
from touchdown.landing.mission.lander import SiteLander
from touchdown.landing.mission.lookout import window
from touchdown.landing.mission.rules import is_in_the_way
from touchdown.landing.mission.site_recheck import Recheck
from touchdown.sim.api import SensorNeeds

from support.lander_support import PARAMS, QUICK, Puppet, flat_map
from support.landing_support import LEG_HEIGHT, make_rig

Says = Callable[[float, float], Verdict]


class Told:
    """A watch that says what it is told, by the height of the legs and by time."""

    needs = SensorNeeds()

    def __init__(self, says: Says) -> None:
        self.says = says
        self.asked: list[tuple[float, float]] = []
        self.left: list[float] = []
        """time until the touchdown, as it was told"""
        self.seen: WatchInput | None = None

    def look(self, seen: WatchInput) -> WatchReport:
        self.seen = seen
        legs = float(seen.estimate.odom_from_body.translation[2] - seen.site_odom[2]) - LEG_HEIGHT
        self.asked.append((seen.obs.time_s, legs))
        self.left.append(seen.touchdown_s)
        verdict = self.says(legs, seen.obs.time_s)
        reason = "" if verdict is Verdict.GO else "a dog"
        aside = seen.site_odom[:2] + [2.0, 0.0] if verdict is Verdict.MOVE else None
        return WatchReport(verdict=verdict, reason=reason, aside_odom=aside)


class Flown:
    """A flight to its end with a watch, or for some time."""

    def __init__(self, says: Says, seconds: float = 300.0, **params: object) -> None:
        self.watch = Told(says)
        changed = dataclasses.replace(PARAMS, **params)  # type: ignore[arg-type]
        lander = SiteLander(make_rig(), changed, QUICK, watch=self.watch)
        self.events: list[str] = []
        self.times: list[float] = []
        """of the events"""
        self.path: list[tuple[float, float]] = []
        self.places: list[np.ndarray] = []
        self.puppet = Puppet(lander, flat_map())
        for view, _ in self.puppet.run(seconds):
            self.view = view
            self.events += view.events
            self.times += [self.puppet.tick / 600.0] * len(view.events)
            self.path.append((self.puppet.tick / 600.0, float(self.puppet.position[2])))
            self.places.append(self.puppet.position.copy())
            if view.phase is Phase.DONE:
                break
        steps = np.diff(np.array(self.places), axis=0)
        self.largest_step = float(np.linalg.norm(steps, axis=1).max())


class Between:
    """Says something for a time, from the first time that the legs are below a height on."""

    def __init__(self, below_m: float, seconds: float, verdict: Verdict = Verdict.WAIT) -> None:
        self.below, self.seconds, self.verdict = below_m, seconds, verdict
        self.from_s: float | None = None

    def __call__(self, legs: float, time_s: float) -> Verdict:
        if self.from_s is None and legs < self.below:
            self.from_s = time_s
        said = self.from_s is not None and time_s - self.from_s < self.seconds
        return self.verdict if said else Verdict.GO


@pytest.mark.parametrize("below_m", [11.0, 3.0])
def test_the_descent_waits_and_goes_on_where_it_was(below_m: float) -> None:
    """Also the final one, which nothing else interrupts."""
    says = Between(below_m, 5.0)
    flown, free = Flown(says), Flown(lambda *_: Verdict.GO)
    assert says.from_s is not None and flown.view.phase is Phase.DONE
    held = [z for t, z in flown.path if says.from_s + 0.1 < t < says.from_s + 4.9]
    assert np.ptp(held) == 0.0 and held[0] - LEG_HEIGHT == pytest.approx(below_m, abs=0.15)
    assert flown.path[-1][0] - free.path[-1][0] == pytest.approx(5.0, abs=0.05)
    assert [event for event in flown.events if "site_not_clear" in event] == [
        "DESCEND site_not_clear: a dog: giving way"
    ]
    assert not [event for event in free.events if "site_not_clear" in event]


def test_it_looks_from_15_m_to_the_touchdown() -> None:
    flown = Flown(lambda *_: Verdict.GO)
    heights = [legs for _, legs in flown.watch.asked]
    assert 14.0 < max(heights) < 15.0 and min(heights) < 0.02
    assert flown.watch.asked[-1][0] < flown.path[-1][0] - 1.4  # motors off
    seen = flown.watch.seen
    assert seen is not None and seen.known is not None
    sinks = 6.0 / PARAMS.descent_speed_mps + 4.0 / 0.6 + 0.2 / 0.09
    for legs, left_s in ((10.0, sinks), (1.0, 1 / 0.6 + 0.2 / 0.09), (0.1, 0.1 / 0.6 + 0.1 / 0.09)):
        at = int(np.argmin(np.abs(np.array(heights) - legs)))
        assert flown.watch.left[at] == pytest.approx(left_s, abs=0.1)


def test_it_climbs_from_the_last_decimetre() -> None:
    """At 2 m/s² for 0.3 s, and as far again to come to rest."""
    says = Between(0.1, 0.3, Verdict.CLIMB)
    flown = Flown(says)
    assert says.from_s is not None and flown.view.phase is Phase.DONE
    climbed = [z - LEG_HEIGHT for t, z in flown.path if says.from_s < t < says.from_s + 1.0]
    assert min(climbed) > 0.05 and max(climbed) > 0.2


def test_it_climbs_to_look_and_comes_back() -> None:
    says = Between(2.0, 8.0, Verdict.CLIMB)
    flown = Flown(says)
    assert says.from_s is not None and flown.view.phase is Phase.DONE
    highest = max(z for t, z in flown.path if t > says.from_s)
    assert highest - LEG_HEIGHT == pytest.approx(PARAMS.look_height_m, abs=0.1)
    site = flown.view.committed_site_world
    assert site is not None
    np.testing.assert_allclose(flown.puppet.position[:2], site[:2], atol=0.05)
    assert flown.largest_step < 0.15 and len([e for e in flown.events if "dog" in e]) == 1


def test_it_goes_aside_in_the_final_descent_and_before_it_waits() -> None:
    flown = Flown(Between(3.0, 0.02, Verdict.MOVE))
    assert flown.view.phase is Phase.DONE
    assert any("DESCEND: the site is moved by" in event for event in flown.events)
    site, chosen = flown.view.committed_site_world, flown.view.decisions[0].positions_world[0]
    assert site is not None
    # to where the map has ground to land on within half a metre
    assert np.linalg.norm(site[:2] - chosen[:2] - [2.0, 0.0]) <= 0.55
    np.testing.assert_allclose(flown.puppet.position[:2], site[:2], atol=0.05)
    low = min(z for (t, z), xy in zip(flown.path, flown.places, strict=True)
              if 0.1 < xy[0] - chosen[0] < 1.4 and t > flown.times[-1])  # fmt: skip
    assert low - LEG_HEIGHT == pytest.approx(PARAMS.commit_height_m, abs=0.1)
    early = Between(9.0, 4.0, Verdict.MOVE)
    assert not any("moved" in event for event in Flown(early).events)


def test_it_goes_nowhere_that_the_fine_map_refuses(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def refuse(_map: object, place: np.ndarray, shift_m: float, _params: object) -> Recheck:
        asked.append((place, shift_m))
        return Recheck(position_odom=None, reason="a step")

    monkeypatch.setattr("touchdown.landing.mission.mission.recheck_site", refuse)
    flown = Flown(Between(3.0, 0.5, Verdict.MOVE))
    assert flown.view.phase is Phase.DONE and not any("moved" in event for event in flown.events)
    assert any("site_not_clear: a dog" in event for event in flown.events)
    site = flown.view.committed_site_world
    assert site is not None
    np.testing.assert_allclose(asked[0][0][:2] - site[:2], [2.0, 0.0], atol=0.05)
    assert asked[0][1] == 0.5 and len(asked) < 10  # a map is asked once


def test_what_stays_delays_a_descent_without_another_site_for_ten_seconds() -> None:
    slope = Finding(
        kind="slope", position_odom=np.zeros(3), velocity_odom=np.zeros(2), height_m=0.3,
        width_m=1.0, distance_m=0.0,
    )  # fmt: skip
    person = dataclasses.replace(slope, kind="person")
    for findings, held_s in (((slope,), 10.0), ((person,), 60.0), ((), 60.0)):
        mission = Flown(lambda *_: Verdict.GO, 8.0).puppet.lander._mission
        mission.state.enter(Phase.RETURN)
        report = WatchReport(verdict=Verdict.WAIT, reason="", findings=findings)
        view = dataclasses.replace(mission.view, watch=report)
        mission.state.give_way(held_s - 0.1, 0.0)
        assert is_in_the_way(view, mission.state)
        assert not is_in_the_way(dataclasses.replace(view, time_left_s=29.0), mission.state)
        mission.state.give_way(0.2, 0.0)
        assert not is_in_the_way(view, mission.state)


def test_what_does_not_go_away_sends_the_vehicle_around_and_home() -> None:
    """At home it waits for a minute, then lands: there is no other place."""
    flown = Flown(lambda legs, _: Verdict.WAIT if legs < 3.0 else Verdict.GO, 600.0, go_arounds=1)
    rules = [event.split(":")[0].split()[-1] for event in flown.events if "dog" in event]
    assert rules == ["site_not_clear", "go_around", "site_not_clear", "no_go_around_left",
                     "site_not_clear"]  # fmt: skip
    assert flown.view.no_site and flown.view.phase is Phase.DONE
    held = [t for t, z in flown.path if abs(z - LEG_HEIGHT - 3.0) < 0.1 and t > flown.times[-1] - 1]
    assert held[-1] - held[0] == pytest.approx(60.0, abs=2.0)


def test_an_emergency_does_not_wait_for_long() -> None:
    flown = Flown(lambda legs, _: Verdict.WAIT if legs < 3.0 else Verdict.GO, emergency="battery")
    held = [t for t, z in flown.path if abs(z - LEG_HEIGHT - 3.0) < 0.1 and t > 20.0]
    assert 4.0 < held[-1] - held[0] < 6.0 and flown.view.phase is Phase.DONE
    assert len(flown.view.decisions) == 1


def test_the_map_from_before_is_a_copy_around_the_site() -> None:
    grid = flat_map()
    kept = window(grid, np.array([3.0, -4.0, 0.0]))
    assert kept is not None
    middle = kept.origin_xy_m + 0.5 * kept.cell_m * np.array(kept.height_m.shape[::-1])
    np.testing.assert_allclose(middle, [3.0, -4.0], atol=0.15)
    row, col = np.floor((np.array([-4.0, 3.0]) - grid.origin_xy_m[::-1]) / grid.cell_m).astype(int)
    before = float(kept.height_m[40, 40])
    assert before == grid.height_m[row, col]
    grid.height_m[row, col] = 9.0
    assert float(kept.height_m[40, 40]) == before
    assert window(grid, np.array([900.0, 0.0])) is None
