"""A rig and observations for tests of the guard."""

from typing import Any

import numpy as np

from touchdown.sim.api import Observation

from support import livo_flight

RIG = livo_flight.RIG


def obs(tick: int, **changes: Any) -> Observation:
    return Observation(
        tick=tick, time_s=tick / 600, rotor_speed_radps=np.zeros(4), battery_fraction=1.0, **changes
    )
