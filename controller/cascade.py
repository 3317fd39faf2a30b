"""The flight controller: position, velocity, attitude and body rate loops, then the mixer.

An observer of the aerodynamic force feeds it forward. Measured acceleration, less gravity and the
thrust of the modelled rotors along the measured body axis, leaves the aerodynamic force: drag of
wind and own speed. Thrust and tilt are those of the vehicle, not those commanded, so that the
loops' own action cancels in the difference, and the feed-forward of the observed force leaves the
loops' margins unchanged (an incremental inversion in the sense of Smeur, de Croon and Chu, 2018).

The vertical share, where it is asked for, is bounded to downward forces. A vehicle that leans into
a strong wind has air flowing down through its rotors, which takes up to half of their thrust; the
integral of the velocity loop cannot hold as much. Upward forces are left to the loops: near the
ground they are those of ground effect and of the legs' contact.
"""

import contextlib

import numpy as np
from numba import njit, types

from touchdown.controller.api import ControlParams, Setpoint
from touchdown.controller.mixer import Mixer, MotorLead
from touchdown.controller.pid import VectorPid, cascade_gains
from touchdown.estimator.api import Estimate
from touchdown.sim.api import GRAVITY_MPS2, Command, VehicleModel
from touchdown.sim.typing import Array

_SUPPORTED = 0.35 * GRAVITY_MPS2
"""An unexplained upward acceleration above this means ground contact. In the air a fast descent
through the rotors' inflow reaches about half of it."""


class DisturbanceObserver:
    """Low-pass estimate of the acceleration that thrust does not explain: the horizontal share, and
    with ``vertical`` the loss of thrust along z, which is 0 or below."""

    def __init__(
        self,
        vehicle: VehicleModel,
        bandwidth_radps: float,
        step_s: float,
        *,
        vertical: bool = False,
    ) -> None:
        self._vertical = vertical
        self._thrust_per_mass = vehicle.thrust_coefficient / vehicle.mass_kg
        self._approach = 1.0 - float(np.exp(-bandwidth_radps * step_s))
        self.reset()

    def reset(self) -> None:
        """Resets the estimate to still air."""
        self.acceleration = np.zeros(3)

    def update(
        self, acceleration: Array, rotation: Array, rotor_speed_radps: Array, expected: Array
    ) -> Array:
        """(3,) m/s^2 beyond ``expected`` (3,), odom frame; without ``vertical`` z is always 0.

        acceleration: (3,) m/s^2 measured, gravity removed; rotation: odom_from_body;
        rotor_speed_radps: (R,) modelled. Forgets while the ground carries the vehicle, where the
        unexplained force is friction.
        """
        self.acceleration = _update(
            self.acceleration,
            acceleration,
            rotation,
            self._thrust_per_mass * float(rotor_speed_radps @ rotor_speed_radps),
            expected,
            self._approach,
            self._vertical,
        )
        return self.acceleration


@njit(cache=True, error_model="numpy")
def _update(
    estimate: Array,
    acceleration: Array,
    rotation: Array,
    thrust_per_mass: float,
    expected: Array,
    approach: float,
    vertical: bool,
) -> Array:
    residual = acceleration - thrust_per_mass * rotation[:, 2] - expected
    residual[2] += GRAVITY_MPS2
    if residual[2] > _SUPPORTED:
        residual[:] = 0.0
    if not vertical:
        residual[2] = 0.0
    following = estimate + approach * (residual - estimate)
    following[2] = min(following[2], 0.0)
    return following


_MAX_RATE_RADPS = np.array([4.0, 4.0, 1.5])
_LAG_MPS2 = 4.0 / 3.0
"""that the reference's jerk may add to the feed-forward, for the lag of the angle loop"""
_SLOW, _SLOW_S = 0.5, 0.05
"""fraction of its modelled speed below which a rotor is lost, and for how long; a motor at the
limit of an empty battery reaches 0.8"""
_TURNING = 1.5
"""multiple of the idle speed above which a rotor is watched"""
_MIN_VERTICAL_FORCE = 0.3
_MAX_VERTICAL_FORCE = 1.8
"""fractions of the weight; below the lower one, tilting has no control authority"""
_THRUST_FRACTION = 0.98
"""fraction of the rotors' largest thrust that the wanted force may take; the rest is left to the
torques"""


def jerk_limit_mps3(params: ControlParams) -> float:
    """The largest jerk of a reference that is fed forward."""
    return _LAG_MPS2 * params.attitude_radps


class CascadeController:
    """Implements ``controller.api.Controller`` at ``params.control_hz``.

    Position P -> velocity PID with the reference's velocity and acceleration fed forward -> thrust
    vector, bounded in tilt -> attitude P, yaw apart -> body rate PID -> mixer -> motor lead. The
    derivative of the velocity loop is the estimated acceleration. With ``wind_feed_forward`` the
    thrust that the wind takes is fed forward too, and the horizontal force is bounded by what the
    rotors have left beside the vertical one.
    """

    def __init__(self, vehicle: VehicleModel, params: ControlParams) -> None:
        step_s = 1.0 / params.control_hz
        gains = cascade_gains(params)
        self._vehicle = vehicle
        self._step_s = step_s
        self._gains = gains
        self._velocity_pid = VectorPid(gains.velocity, step_s)
        self._rate_pid = VectorPid(gains.rate, step_s)
        self._mixer = Mixer(vehicle)
        response_s = params.response_s(vehicle.motor_time_constant_s)
        self._lead = MotorLead(vehicle, response_s, step_s)
        self._observer = DisturbanceObserver(
            vehicle, params.disturbance_radps, step_s, vertical=params.wind_feed_forward
        )
        full = (
            float(len(vehicle.rotor_spin)) * vehicle.thrust_coefficient * vehicle.rotor_speed_max**2
        )
        self._max_force = _THRUST_FRACTION * full if params.wind_feed_forward else np.inf
        self._max_correction = params.max_correction_mps
        self._max_slope = float(np.tan(np.radians(params.max_tilt_deg)))
        self._weight = vehicle.mass_kg * GRAVITY_MPS2
        self._drag_per_mass = vehicle.linear_drag / vehicle.mass_kg
        # A proportional angle loop follows a ramp late by 1 / gain, the thrust by the motor's lag.
        self._reference_lead_s = np.array(
            [1.0 / params.attitude_radps, 1.0 / params.attitude_radps, response_s]
        )
        self._max_jerk = jerk_limit_mps3(params)
        self._lost: tuple[int, ...] = ()
        self._slow_steps = np.zeros(len(vehicle.rotor_spin), dtype=np.int64)
        self.reset()

    def hear(self, rotor_speed_radps: Array) -> None:
        """Takes the speed controllers' telemetry, (R,) rad/s, once a control step before
        ``update``. A rotor that stays well below the speed of its model is lost: the others take
        over, as far as they can."""
        modelled = self._lead.modelled_radps
        slow = (rotor_speed_radps < _SLOW * modelled) & (
            modelled > _TURNING * self._vehicle.rotor_speed_min
        )
        if not slow.any():
            self._slow_steps[:] = 0
            return
        self._slow_steps = np.where(slow, self._slow_steps + 1, 0)
        found = np.flatnonzero(self._slow_steps * self._step_s > _SLOW_S)
        lost = tuple(sorted({*self._lost, *found.tolist()}))
        if lost != self._lost:
            self._lost = lost
            with contextlib.suppress(ValueError):  # too many: what there is must do
                self._mixer = Mixer(self._vehicle, lost)

    def reset(self) -> None:
        """Forgets integrals and references, as after a stop of the motors."""
        self._velocity_pid.reset()
        self._rate_pid.reset()
        self._lead.reset()
        self._observer.reset()
        self._last_acceleration: Array | None = None
        self._last_rates: Array | None = None

    def update(self, estimate: Estimate, setpoint: Setpoint) -> Command:
        """Returns the rotor speeds (R,) rad/s for the control step that begins now."""
        if not setpoint.motors_on:
            self.reset()
            return Command(rotor_speed_radps=np.zeros(len(self._vehicle.rotor_spin)))
        rotation = estimate.odom_from_body.rotation
        rates = estimate.angular_velocity_body
        force = self._wanted_force(estimate, setpoint)
        thrust = force[2] / max(rotation[2, 2], 0.5)  # holds the height while tilted
        wanted_rates = _rate_setpoint(
            rotation,
            force,
            setpoint.yaw_odom,
            setpoint.yaw_rate,
            self._gains.attitude,
            _MAX_RATE_RADPS,
        )
        last_rates = rates if self._last_rates is None else self._last_rates
        demand = self._rate_pid.output(wanted_rates - rates, (rates - last_rates) / self._step_s)
        self._last_rates = rates
        wrench = _wrench(thrust, demand, rates, self._vehicle.inertia_kgm2)
        fraction = setpoint.thrust_limit
        speeds = self._mixer.speeds(wrench, np.inf if fraction is None else fraction * self._weight)
        if fraction is None:  # on the ground contact forces would wind up the integrals
            self._settle(force, wrench, self._mixer.wrench(speeds))
        command = self._lead.command(speeds)
        if self._lost:
            lost = list(self._lost)
            command[lost] = self._lead.modelled_radps[lost] = 0.0
        return Command(rotor_speed_radps=command)

    def _wanted_force(self, estimate: Estimate, setpoint: Setpoint) -> Array:
        """(3,) N, odom frame: demanded thrust vector, within the tilt limit."""
        reference = setpoint.acceleration_odom
        last = reference if self._last_acceleration is None else self._last_acceleration
        self._last_acceleration = reference
        velocity_error, acceleration_error, feed_forward, drag = _outer_errors(
            setpoint.position_odom,
            estimate.odom_from_body.translation,
            setpoint.velocity_odom,
            estimate.velocity_odom,
            estimate.acceleration_odom,
            reference,
            last,
            self._step_s,
            self._gains.position,
            self._max_correction,
            self._reference_lead_s,
            self._drag_per_mass,
            self._max_jerk,
        )
        unexpected = self._observer.update(
            estimate.acceleration_odom,
            estimate.odom_from_body.rotation,
            self._lead.modelled_radps,
            drag,
        )
        feedback = self._velocity_pid.output(velocity_error, acceleration_error)
        self._unlimited_force, limited = _forces(
            feedback,
            feed_forward,
            drag,
            unexpected,
            self._vehicle.mass_kg,
            self._weight,
            self._max_slope,
            self._max_force,
        )
        return limited

    def _settle(self, force: Array, wrench: Array, achieved: Array) -> None:
        """Integrates both PIDs with back-calculation of what tilt limit and rotors did not
        deliver."""
        missing, missing_angular = _undelivered(
            force,
            self._unlimited_force,
            achieved,
            wrench,
            self._vehicle.mass_kg,
            self._vehicle.inertia_kgm2,
        )
        self._velocity_pid.settle(missing)
        self._rate_pid.settle(missing_angular)


# Whole steps are compiled, not single lines: on vectors of three the calls dominate the cost.


_GIVEN = types.Array(types.float64, 1, "A", readonly=True)


# Estimates and setpoints come in arrays of all kinds; one signature, or each kind is compiled anew.
@njit(
    [(_GIVEN,) * 7 + (types.float64, _GIVEN, types.float64, _GIVEN) + (types.float64,) * 2],
    cache=True,
)
def _outer_errors(
    wanted_position: Array,
    position: Array,
    wanted_velocity: Array,
    velocity: Array,
    acceleration: Array,
    reference: Array,
    last_reference: Array,
    step_s: float,
    gain: Array,
    max_correction: float,
    lead_s: Array,
    drag_per_mass: float,
    max_jerk: float,
) -> tuple[Array, Array, Array, Array]:
    """Velocity error with the position loop's correction, acceleration error, feed-forward, and the
    rotor drag of the reference's own speed in still air; the rest of the drag is observed.

    The feed-forward looks ahead by the lag of the loops inside.
    """
    correction = gain * (wanted_position - position)
    size = np.sqrt(np.sum(correction * correction))
    if size > max_correction:
        correction *= max_correction / size
    jerk = (reference - last_reference) / step_s
    jerk_size = np.sqrt(np.sum(jerk * jerk))
    if jerk_size > max_jerk:
        jerk *= max_jerk / jerk_size
    drag = -drag_per_mass * wanted_velocity
    drag[2] = 0.0
    return (
        wanted_velocity - velocity + correction,
        acceleration - reference,
        reference + lead_s * jerk,
        drag,
    )


@njit(cache=True, error_model="numpy")
def _forces(
    feedback: Array,
    feed_forward: Array,
    drag: Array,
    unexpected: Array,
    mass: float,
    weight: float,
    max_slope: float,
    maximum: float,
) -> tuple[Array, Array]:
    """(3,) N, odom frame: the demanded force, and the same within the limits: the vertical share
    first, then as much of the horizontal as the tilt limit and ``maximum``, the force of all
    rotors, allow."""
    force = mass * (feedback + feed_forward - drag - unexpected)
    force[2] += weight
    limited = force.copy()
    low, high = _MIN_VERTICAL_FORCE * weight, min(_MAX_VERTICAL_FORCE * weight, maximum)
    limited[2] = min(max(force[2], low), high)
    horizontal = np.sqrt(force[0] ** 2 + force[1] ** 2)
    reach = min(
        max_slope * limited[2], np.sqrt(max(maximum * maximum - limited[2] * limited[2], 0.0))
    )
    if horizontal > reach:
        limited[0] *= reach / horizontal
        limited[1] *= reach / horizontal
    return force, limited


@njit(cache=True, error_model="numpy")
def _undelivered(
    force: Array, unlimited: Array, achieved: Array, wrench: Array, mass: float, inertia: Array
) -> tuple[Array, Array]:
    """Accelerations that tilt limit and rotors did not deliver, (3,) linear and (3,) angular."""
    delivered = force * (achieved[0] / wrench[0])
    return (delivered - unlimited) / mass, (achieved[1:] - wrench[1:]) / inertia


@njit(cache=True, error_model="numpy")
def _rate_setpoint(
    rotation: Array, force: Array, yaw: float, yaw_rate: float, gain: Array, limit: Array
) -> Array:
    """(3,) body rates that rotate the thrust axis towards ``force`` on the shortest path, and yaw.

    Tilt and heading are separate, so that a large yaw error cannot disturb the thrust direction.
    """
    direction = rotation.T @ force  # in the body frame
    sine = np.sqrt(direction[0] ** 2 + direction[1] ** 2)
    per_sine = np.arctan2(sine, direction[2]) / sine if sine > 1e-12 else 0.0
    heading_error = yaw - np.arctan2(rotation[1, 0], rotation[0, 0])
    heading_error -= 2.0 * np.pi * np.round(heading_error / (2.0 * np.pi))
    wanted = np.empty(3)
    wanted[0] = -gain[0] * per_sine * direction[1]
    wanted[1] = gain[1] * per_sine * direction[0]
    wanted[2] = (gain[2] * heading_error + yaw_rate) * rotation[2, 2]
    return np.minimum(np.maximum(wanted, -limit), limit)


@njit(cache=True, error_model="numpy")
def _wrench(thrust: float, angular_acceleration: Array, rates: Array, inertia: Array) -> Array:
    """Euler's equation: torque = J alpha + rates x (J rates)."""
    spin = inertia * rates
    wrench = np.empty(4)
    wrench[0] = thrust
    wrench[1] = inertia[0] * angular_acceleration[0] + rates[1] * spin[2] - rates[2] * spin[1]
    wrench[2] = inertia[1] * angular_acceleration[1] + rates[2] * spin[0] - rates[0] * spin[2]
    wrench[3] = inertia[2] * angular_acceleration[2] + rates[0] * spin[1] - rates[1] * spin[0]
    return wrench
