"""The one main loop: every flight, whatever its estimator, scene or purpose, runs through here."""

from touchdown.controller.api import Controller
from touchdown.estimator.api import Estimator, Mapper
from touchdown.experiments.flight.referee import Judgement, Referee
from touchdown.experiments.recording.recorder import Recorder, StepRecord
from touchdown.landing.api import Lander
from touchdown.sim.api import World


def run_flight(
    *,
    world: World,
    estimator: Estimator,
    mapper: Mapper,
    lander: Lander,
    controller: Controller,
    recorder: Recorder,
    referee: Referee,
) -> Judgement:
    """Flies until the referee has an outcome; only recorder and referee see the truth."""
    obs = world.reset()
    while True:
        estimate = estimator.update(obs)  # sees only what has arrived
        map_view = mapper.update(obs, estimate)
        setpoint = lander.update(obs, estimate, map_view)
        command = controller.update(estimate, setpoint)
        truth = world.truth()
        view = lander.view()
        recorder.tick(StepRecord(truth, obs, estimate, map_view, view, setpoint, command))
        outcome = referee.judge(truth, estimate, view)
        if outcome is not None:
            return referee.result(outcome)
        world.follow(view.phase, view.site_world)
        obs = world.step(command)
