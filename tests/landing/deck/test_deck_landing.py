"""A landing on a deck that moves, by a vehicle that is where its setpoint is."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest

from touchdown.estimator.api import DeckTrack
from touchdown.landing.api import Phase
from touchdown.landing.deck.lander import land_on_deck
from touchdown.sim.typing import Array

from support.landing_support import LEG_HEIGHT
from support.mission_stage import STEP_S, Stage

SPEED = np.array([2.0, -1.0, 0.0])


class Deck:
    """A deck that comes into view after 3 s. It heaves and rolls until ``calm_s``; no scan measures
    it from ``blind_s`` (2,) to the second of them; it accelerates by ``lean_mps2`` (3,)."""

    def __init__(
        self,
        calm_s: float = 0.0,
        blind_s: tuple[float, float] = (1e9, 1e9),
        lean_mps2: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> None:
        self.calm_s, self.blind_s, self.lean = calm_s, blind_s, np.array(lean_mps2)
        self.stage = Stage(np.array([0.0, 0.0, 20.0]), moving_site=True)
        self.stage.deck = self.track
        self.stage.carried = self.carried

    def site(self, time_s: float) -> Array:
        rough = 0.5 * np.sin(1.2 * time_s) if time_s < self.calm_s else 0.0
        return np.array([20.0, 5.0, 1.0 + rough]) + time_s * SPEED + 0.5 * time_s**2 * self.lean

    def track(self, time_s: float) -> DeckTrack | None:
        if time_s < 3.0:
            return None
        waves = time_s < self.calm_s
        rate = 0.6 * np.cos(1.2 * time_s) if waves else 0.0
        first, last = self.blind_s
        return DeckTrack(
            site_odom=self.site(time_s),
            velocity_odom=SPEED + time_s * self.lean + [0.0, 0.0, rate],
            acceleration_odom=self.lean,
            heave=np.array([self.site(time_s)[2] - 1.0, rate]),
            slopes=np.array([[0.15 * waves, 0.0], [0.0, 0.0]]),
            seen_s=first if first < time_s < last else time_s, sigma_m=0.03, sigma_mps=0.1,
        )  # fmt: skip

    def carried(self, legs: float) -> float:
        time_s = self.stage.tick / 600.0
        return 0.5 if legs - self.site(time_s)[2] <= 0.0 else 1.0

    def land(self) -> tuple[Array, Array]:
        """Times, and positions of the legs over the site, until the motors stop."""
        setpoints = self.stage.run(land_on_deck(self.stage.mission))
        flown = [s.position_odom for s in setpoints if s.thrust_limit is None and s.motors_on]
        times = STEP_S * np.arange(len(flown))
        sites = np.array([self.site(t) for t in times])
        return times, np.array(flown) - sites - [0.0, 0.0, LEG_HEIGHT]


def test_it_waits_ahead_follows_and_touches_down_in_the_middle() -> None:
    deck = Deck()
    _, over = deck.land()
    state = deck.stage.mission.state
    assert deck.stage.result is True and state.phase is Phase.TOUCHDOWN
    np.testing.assert_allclose(over[-1][:2], 0.0, atol=0.1)
    assert -0.25 < over[-1][2] < 0.02
    last = np.gradient(over[-40:], STEP_S, axis=0)
    assert np.abs(last[:, :2]).max() < 0.1  # it goes along
    np.testing.assert_allclose(last[:, 2], -0.3, atol=0.02)
    assert state.committed_site_world is not None
    sinking = over[:, 2] < 7.0
    assert np.hypot(*over[sinking, :2].T).max() < 1.2  # over the deck before it goes down


def test_it_waits_for_a_calm_moment() -> None:
    times, over = Deck(calm_s=30.0).land()
    assert times[-1] > 30.0
    before = over[(times > 20.0) & (times < 29.0), 2]
    assert before.min() > 0.9 and before.max() < 2.2  # near, and not on it


def test_in_a_sea_that_never_calms_a_calm_present_will_do() -> None:
    deck = Deck(calm_s=1e9)
    deck.track = lambda t: _level(Deck.track(deck, t))  # type: ignore[method-assign]
    deck.stage.deck = deck.track
    times, _ = deck.land()
    assert 40.0 < times[-1] < 80.0


def _level(track: DeckTrack | None) -> DeckTrack | None:
    return None if track is None else dataclasses.replace(track, slopes=np.zeros((2, 2)))


def test_a_deck_that_is_lost_from_sight_is_left_and_met_again() -> None:
    """Its first last descent, from about 16 s on, ends where no scan has measured it for a
    second."""
    clear, _ = Deck().land()
    times, over = Deck(blind_s=(clear[-1] - 4.0, clear[-1] + 3.0)).land()
    again = over[(times > clear[-1]) & (times < clear[-1] + 3.0), 2]
    assert again.max() > 3.0 and times[-1] > clear[-1] + 4.0


@pytest.mark.parametrize("lean", [(0.0, 0.0, 0.0), (0.2, -0.1, 0.0)])
def test_a_deck_that_is_not_tracked_any_more_is_gone_along_with(lean: Sequence[float]) -> None:
    """Its track ends for five seconds; it is met where its course has taken it."""
    clear, _ = Deck(lean_mps2=lean).land()
    deck, start = Deck(lean_mps2=lean), clear[-1] - 6.0
    deck.stage.deck = lambda t: None if start < t < start + 5.0 else deck.track(t)
    times, over = deck.land()
    untracked = (times > start + 1.0) & (times < start + 5.0)
    assert np.hypot(*over[untracked, :2].T).max() < 1.0
    assert deck.stage.result is True


def test_one_that_stays_away_is_looked_for_from_higher_up_and_given_up() -> None:
    deck = Deck()
    deck.stage.deck = lambda t: None if t > 14.0 else deck.track(t)
    times, over = deck.land()
    assert deck.stage.result is False and not deck.stage.mission.state.final
    assert times[-1] == pytest.approx(14.0 + 30.0, abs=0.1)
    assert over[times < 17.9, 2].max() < 20.0 and over[-1][2] == pytest.approx(15.0, abs=0.2)
    np.testing.assert_allclose(over[-1][:2], 0.0, atol=0.2)


def test_none_comes() -> None:
    stage = Stage(np.array([0.0, 0.0, 20.0]), moving_site=True)
    stage.run(land_on_deck(stage.mission), 100.0)
    assert stage.result is False
    ahead = stage.mission.state.survey.leg_length_m
    np.testing.assert_allclose(stage.position, [ahead, 0.0, 20.0], atol=0.01)
