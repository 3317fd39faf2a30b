"""The record of one control step, as the main loop hands it to recorders."""

from __future__ import annotations

from dataclasses import dataclass

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
