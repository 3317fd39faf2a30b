"""What the main loop hands to recorders."""

from dataclasses import dataclass
from typing import Protocol

from touchdown.controller.api import Setpoint
from touchdown.estimator.api import Estimate, MapView
from touchdown.landing.api import LanderView
from touchdown.sim.api import Command, Observation, Truth


@dataclass(frozen=True, slots=True)
class StepRecord:
    """Inputs and outputs of all parts of the loop in one control step."""

    truth: Truth
    obs: Observation
    estimate: Estimate
    map_view: MapView
    lander_view: LanderView
    setpoint: Setpoint
    command: Command


class Recorder(Protocol):
    """Observer of every control step, without effect on the flight."""

    def tick(self, step: StepRecord) -> None: ...

    def close(self) -> None: ...


class NullRecorder:
    """Recorder that writes nothing."""

    def tick(self, step: StepRecord) -> None:
        pass

    def close(self) -> None:
        pass
