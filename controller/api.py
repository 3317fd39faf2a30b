"""What the rest of the project may know of control."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from estimator.api import Estimate
from sim.api import FORBID_EXTRA, Command

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class Setpoint:
    """Where the body origin should be, in the ODOM frame, with feed-forward."""

    position_odom: Array
    """(3,) m"""
    velocity_odom: Array
    """(3,) m/s"""
    acceleration_odom: Array
    """(3,) m/s^2"""
    yaw_odom: float
    """rad"""
    yaw_rate: float = 0.0
    """rad/s"""
    motors_on: bool = True
    """False: all rotors stop (before take-off and after touchdown)."""
    thrust_limit: float | None = None
    """Fraction of hover thrust not to be exceeded (settling on the ground); None: no limit."""


class Controller(Protocol):
    def update(self, estimate: Estimate, setpoint: Setpoint) -> Command: ...


@dataclass(frozen=True, kw_only=True, slots=True)
class ControlParams:
    """Closed-loop bandwidths that ``controller/design.py`` turns into PID gains."""

    __pydantic_config__ = FORBID_EXTRA

    control_hz: int = 200
    max_tilt_deg: float = 30.0
