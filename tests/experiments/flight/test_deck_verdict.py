"""A landing on a deck that moves is judged relative to it."""

import numpy as np
import pytest

from touchdown.experiments.api import Outcome, RefereeParams
from touchdown.experiments.config.loading import load_config
from touchdown.experiments.flight.referee import Referee, TruthLookup
from touchdown.landing.api import Phase
from touchdown.scenes.api import Scene
from touchdown.scenes.compose import load_scene
from touchdown.sim.api import Contact, MovingFrame
from touchdown.sim.frames import Pose, so3_exp

from support.flight_fakes import make_estimate, make_truth, make_view

SPEED = np.array([3.0, 0.0, 0.2])
TURN = np.array([0.0, 0.1, 0.0])


@pytest.fixture(scope="module")
def boat() -> Scene:
    return load_scene("deck", 3)


class Landing:
    """A vehicle that comes down at 0.3 m/s beside ``at`` (3,) of the deck's frame and stays."""

    def __init__(self, scene: Scene, at: np.ndarray, slip_mps: float = 0.0) -> None:
        self.at, self.slip_mps = at, slip_mps
        self.referee = Referee(RefereeParams(timeout_s=100.0), survey_only=False, steps_per_s=200.0,
                               ground=TruthLookup(scene))  # fmt: skip
        self.judge(0.0, 0.0, Phase.INIT)
        self.judge(1.0, 9.0, Phase.TAKEOFF)
        self.judge(3.0, 9.0, Phase.SURVEY)
        for step in range(100):
            self.judge(10.0 + step / 200.0, 2.0, Phase.DESCEND, down=0.3)

    def judge(self, time_s: float, above: float, phase: Phase, down: float = 0.0,
              touches: str = "") -> Outcome | None:  # fmt: skip
        frame = Pose(
            so3_exp(np.array([0.0, 0.1, 0.0])), np.array([0.0, 50.0, 0.0]) + time_s * SPEED
        )
        deck = MovingFrame(
            world_from_frame=frame, velocity_world=SPEED, angular_velocity_world=TURN
        )
        place = frame.apply(self.at + [0.0, 0.0, above])
        velocity = deck.velocity_at(place) + [0.0, self.slip_mps, -down]
        contacts = (Contact(part="leg", other=touches, normal_force_n=9.0),) if touches else ()
        return self.referee.judge(
            make_truth(time_s, Pose(frame.rotation, place).translation, velocity_world=velocity,
                       world_from_body=Pose(frame.rotation, place), deck=deck, contacts=contacts),
            make_estimate(time_s, place),
            make_view(phase, committed_site_world=np.zeros(3)),
        )  # fmt: skip

    def stand(self, touches: str = "deck_plate") -> list[Outcome | None]:
        return [self.judge(t, 0.0, Phase.DONE, touches=touches) for t in (11.0, 11.2, 11.6)]


def test_speeds_tilt_and_rest_are_those_over_the_deck(boat: Scene) -> None:
    flight = Landing(boat, np.array([-5.0, 0.0, 1.3]))
    assert flight.stand() == [None, None, Outcome.LANDED]
    landing = flight.referee.result(Outcome.LANDED).landing
    assert landing is not None and landing.landed_on == "deck" and landing.safe is True
    assert landing.vertical_speed_mps == pytest.approx(0.3, abs=0.01)
    assert landing.horizontal_speed_mps == pytest.approx(0.0, abs=0.01)
    assert landing.tilt_deg == pytest.approx(0.0, abs=1e-6) and landing.bounce_m < 1e-9
    assert landing.slope_deg == pytest.approx(np.degrees(0.1))
    assert landing.obstacle_distance_m == pytest.approx(2.8) and landing.target_offset_m is None
    sliding = Landing(boat, np.array([-5.0, 0.0, 1.3]), slip_mps=0.2)
    assert sliding.stand() == [None, None, None]
    found = sliding.referee.result(Outcome.TIMEOUT).landing
    assert found is not None and found.horizontal_speed_mps == pytest.approx(0.2, abs=0.01)


def test_on_the_edge_beside_it_and_on_its_rails(boat: Scene) -> None:
    edge = Landing(boat, np.array([-5.0, 2.5, 1.3]))
    assert edge.stand()[-1] is Outcome.LANDED
    found = edge.referee.result(Outcome.LANDED).landing
    assert found is not None and found.landed_on == "deck" and found.safe is False
    beside = Landing(boat, np.array([-5.0, 9.0, 1.3]))
    beside.stand("water")
    wet = beside.referee.result(Outcome.LANDED).landing
    assert wet is not None and wet.landed_on == "water" and wet.safe is False
    assert Landing(boat, np.array([-5.0, 2.5, 1.3])).stand("kerb_0")[0] is Outcome.COLLIDED


def test_the_scene_asks_for_a_moving_site() -> None:
    assert load_config(scene="deck").landing.moving_site
    assert not load_config(scene="lake").landing.moving_site
    assert not load_config(
        scene="deck", overrides=["landing.moving_site=false"]
    ).landing.moving_site


def test_at_home_away_from_the_deck_rest_is_that_of_the_world(boat: Scene) -> None:
    flight = Landing(boat, np.array([-5.0, 0.0, 1.3]))
    home = np.array([0.0, -40.0, 0.3])
    deck = MovingFrame(
        world_from_frame=Pose(np.eye(3), np.array([0.0, 50.0, 0.0])), velocity_world=SPEED,
        angular_velocity_world=TURN,
    )  # fmt: skip
    contact = (Contact(part="leg", other="pontoon", normal_force_n=9.0),)
    found = [
        flight.referee.judge(
            make_truth(t, home, velocity_world=np.zeros(3), deck=deck, contacts=contact),
            make_estimate(t, home), make_view(Phase.DONE, no_site=True),
        )
        for t in (20.0, 20.2, 20.8)
    ]  # fmt: skip
    assert found[-1] is Outcome.NO_SITE
