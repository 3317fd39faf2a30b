"""Interface of the controller: setpoints, the protocol and its parameters."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Protocol

from annotated_types import Interval

from touchdown.estimator.api import Estimate
from touchdown.sim.api import Command, Count, NotNegative, Positive, VehicleModel, parameters
from touchdown.sim.typing import Array


@dataclass(frozen=True, kw_only=True, slots=True)
class Setpoint:
    """Reference of the body origin in the ODOM frame, with feed-forward."""

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
    """``update`` returns the command for the control step that begins now; called once a step, at
    ``control_hz``. It must be deterministic and must not modify its input. The command acts at
    once, through the rotors' own lag: there is no compute latency."""

    def update(self, estimate: Estimate, setpoint: Setpoint) -> Command: ...


LED_MOTOR_S = 0.04
"""time constant of the motors that ``motor_response_s`` is of"""


@parameters
class ControlParams:
    """Closed-loop bandwidths, which ``controller/pid.py`` turns into PID gains."""

    controller: str = "cascade"
    """what turns setpoints into rotor speeds: ``cascade``, or MODULE:FUNCTION of an external
    controller"""
    control_hz: Count = 200
    """rate of the control loop, sim.tick_hz / sim.control_ticks"""
    max_tilt_deg: Annotated[float, Interval(gt=0.0, lt=60.0)] = 35.0
    """largest tilt that is commanded"""
    motor_response_s: ClassVar[float] = 0.012
    """time constant of rotors of `LED_MOTOR_S` behind the lead that speeds them up; that of others
    is in proportion"""
    rate_radps: Positive = 28.0
    """crossover of the roll and pitch rate loops"""
    yaw_rate_radps: Positive = 12.0
    """crossover of the yaw rate loop"""
    attitude_radps: Positive = 9.0
    """crossover of the roll and pitch angle loops"""
    yaw_radps: Positive = 4.0
    """crossover of the yaw angle loop"""
    velocity_xy_radps: Positive = 3.5
    """crossover of the horizontal velocity loops"""
    velocity_z_radps: Positive = 7.0
    """crossover of the vertical velocity loop"""
    position_xy_radps: Positive = 1.4
    """crossover of the horizontal position loops"""
    position_z_radps: Positive = 2.5
    """crossover of the vertical position loop"""
    rate_integral_ratio: Positive = 10.0
    """crossover of a rate loop over the corner frequency of its integral"""
    velocity_integral_ratio: Positive = 5.0
    """ratio of integral to proportional gain of the velocity loops"""
    rate_derivative_s: NotNegative = 0.012
    """derivative time of the rate loops' D term"""
    acceleration_feedback: NotNegative = 0.0
    """D term of the velocity loops: fraction of the acceleration error that is fed back"""
    disturbance_radps: NotNegative = 6.0
    """bandwidth of the observer of the wind's force"""
    wind_feed_forward: bool = False
    """feed the thrust that the felt wind takes forward too, and give height priority over place
    where the rotors' thrust does not last for both; off, the force across is fed forward alone"""

    def response_s(self, motor_s: float) -> float:
        """Time constant behind the lead of rotors whose own is ``motor_s``."""
        return self.motor_response_s * (motor_s / LED_MOTOR_S)

    max_correction_mps: ClassVar[float] = 3.0
    """bound on the velocity that the position loop may add to the reference's"""


@dataclass(frozen=True, kw_only=True, slots=True)
class ControllerRig:
    """What a controller knows before the flight."""

    vehicle: VehicleModel
    """the airframe's data sheet: mass, inertia, rotors"""
    control_hz: int
    """calls of ``update`` a second"""
    control: ControlParams
    """keys ``control.*``: limits such as ``max_tilt_deg``, and the bandwidths of the shipped one"""
