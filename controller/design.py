"""Linear model and stability margins of every loop of the cascade.

Each loop is cut at its controller's output; the loop inside is closed, the loops around it are
open. The rows called ``actuator`` cut the complete cascade at the rotors. The model is discrete at
the control rate: airframe and motor lag behind a zero-order hold, one more sample of delay, the
motor lead, and the gains used in flight. Torques are scaled by the inertia and thrust by the mass,
so of the vehicle only the motors' lag matters. The model omits drag, which adds damping, and the
observer of the wind's force, in which the loops' own action cancels. ``touchdown control margins``
prints the margins.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import control
import numpy as np
from numpy.typing import NDArray

from touchdown.controller.api import ControlParams
from touchdown.controller.mixer import Mixer, lead_coefficients
from touchdown.controller.pid import CascadeGains, cascade_gains
from touchdown.sim.api import GRAVITY_MPS2, VehicleModel
from touchdown.sim.typing import Array

System = Any
"""a discrete ``control.StateSpace``"""

MIN_GAIN_MARGIN_DB = 6.0
MIN_PHASE_MARGIN_DEG = 45.0


@dataclass(frozen=True, kw_only=True, slots=True)
class LoopMargin:
    """Stability margins of one loop, cut at one place."""

    name: str
    gain_margin_db: float
    """the smaller of the factors by which the gain may rise or fall"""
    phase_margin_deg: float
    """smallest over all crossovers"""
    crossover_rad_s: float
    """the highest frequency at which the loop's gain is 1"""


@dataclass(frozen=True, slots=True)
class _Stage:
    """One loop: command = forward (reference - measured outputs) - damping outputs."""

    name: str
    forward: System
    """1 x 1"""
    measured: System
    """1 x number of outputs: picks what the reference is compared with"""
    damping: System | None = None
    """1 x number of outputs: the derivative on measurement"""

    @property
    def feedback(self) -> System:
        """1 x number of outputs: total feedback of the loop."""
        direct = self.forward * self.measured
        return direct if self.damping is None else direct + self.damping


_SHAPES = (
    ("rate_radps", "attitude_radps", "velocity_xy_radps", "position_xy_radps"),
    ("yaw_rate_radps", "yaw_radps"),
    ("velocity_z_radps", "position_z_radps"),
)
"""crossovers of the loops of roll and pitch, yaw, and height, by their keys"""
_RESERVE_DB, _RESERVE_DEG = 2.0, 5.0
"""by which the design stays above the least margins"""
_SLOWEST = 0.2
_STEPS = 7
"""bisections of a factor"""
_STEP_RAD = 0.15
"""angle error that the rotors must be able to answer without saturation"""


def designed(vehicle: VehicleModel, params: ControlParams) -> ControlParams:
    """``params`` with the gains of ``vehicle``: its loops have the shape of ``params``, the ratios
    of their crossovers, and are as fast as its motors allow, at most as fast as ``params``.

    Roll and pitch, yaw, and height are each slowed by one factor until all margins of the chain
    keep a reserve over the least ones, and until the rotors, with what they have left in hover,
    answer an angle error of `_STEP_RAD`. Raises ValueError where that is too slow to fly.
    """
    authority = angular_authority(vehicle)
    tilt_limit = min(authority[:2]) / (params.rate_radps * params.attitude_radps * _STEP_RAD)
    yaw_limit = authority[2] / (params.yaw_rate_radps * params.yaw_radps * _STEP_RAD)
    found = params
    for chain, limit in enumerate((tilt_limit, yaw_limit, np.inf)):
        low, high = _SLOWEST, min(1.0, float(np.sqrt(limit)))
        if high < low or not _has_reserve(vehicle, _slowed(params, chain, low), chain):
            raise ValueError(
                f"the loops of {('roll and pitch', 'yaw', 'height')[chain]} would be too slow to "
                f"fly: motors of {vehicle.motor_time_constant_s:g} s (motor_time_constant) and "
                f"angular accelerations of {np.round(authority, 1)} rad/s^2 (roll, pitch, yaw); "
                "give faster motors, longer arms, more thrust or torque, or less inertia"
            )
        if not _has_reserve(vehicle, _slowed(params, chain, high), chain):
            for _ in range(_STEPS):
                middle = 0.5 * (low + high)
                enough = _has_reserve(vehicle, _slowed(params, chain, middle), chain)
                low, high = (middle, high) if enough else (low, middle)
            high = low
        found = _slowed(found, chain, high)
    return found


def _slowed(params: ControlParams, chain: int, factor: float) -> ControlParams:
    """One chain's frequencies times ``factor``, and its times over it."""
    slower = {key: factor * getattr(params, key) for key in _SHAPES[chain]}
    if chain == 0:
        slower["rate_derivative_s"] = params.rate_derivative_s / factor
        slower["disturbance_radps"] = factor * params.disturbance_radps
    return replace(params, **slower)


def _has_reserve(vehicle: VehicleModel, params: ControlParams, chain: int) -> bool:
    return all(
        margin.gain_margin_db >= MIN_GAIN_MARGIN_DB + _RESERVE_DB
        and margin.phase_margin_deg >= MIN_PHASE_MARGIN_DEG + _RESERVE_DEG
        for margin in _chain_margins(*_chains(vehicle.motor_time_constant_s, params)[chain])
    )


def angular_authority(vehicle: VehicleModel) -> Array:
    """(3,) rad/s^2 about roll, pitch and yaw that the mixer delivers both ways, at no more thrust
    than in hover."""
    mixer, weight = Mixer(vehicle), vehicle.mass_kg * GRAVITY_MPS2
    found = np.empty(3)
    for axis in range(3):
        wanted = weight * np.eye(4)[0] + np.outer([-100.0, 100.0], weight * np.eye(4)[1 + axis])
        both = [mixer.wrench(mixer.speeds(one, weight))[1 + axis] for one in wanted]
        found[axis] = np.abs(both).min() / vehicle.inertia_kgm2[axis]
    return found


def checked_margins(vehicle: VehicleModel, params: ControlParams) -> list[LoopMargin]:
    """As `loop_margins`. Raises ValueError for a loop below the least margins."""
    found = loop_margins(vehicle, params)
    for one in found:
        if one.gain_margin_db < MIN_GAIN_MARGIN_DB or one.phase_margin_deg < MIN_PHASE_MARGIN_DEG:
            raise ValueError(
                f"loop '{one.name}' has margins of {one.gain_margin_db:.1f} dB and "
                f"{one.phase_margin_deg:.0f} degrees, of {MIN_GAIN_MARGIN_DB:g} dB and "
                f"{MIN_PHASE_MARGIN_DEG:g} degrees that it needs; give faster motors "
                "(motor_time_constant)"
            )
    return found


def loop_margins(vehicle: VehicleModel, params: ControlParams) -> list[LoopMargin]:
    """Returns the margins of every loop of ``CascadeController(vehicle, params)``, inner loops
    first."""
    chains = _chains(vehicle.motor_time_constant_s, params)
    return [margin for chain in chains for margin in _chain_margins(*chain)]


def _chain_margins(axes: str, plant: System, stages: list[_Stage]) -> list[LoopMargin]:
    rows = [_margin(name, loop) for name, loop in _cut_loops(plant, stages)]
    return [*rows, _margin(f"actuator, {axes}", _cut_at_actuator(plant, stages))]


def _chains(motor_s: float, params: ControlParams) -> list[tuple[str, System, list[_Stage]]]:
    """Roll and pitch with the horizontal motion that they steer (both alike), yaw, and height."""
    gains, g = cascade_gains(params), GRAVITY_MPS2
    tilt: list[list[float]] = [[0, 1, 0, 0, 0], [0, 0, 1, 0, 0], [0, 0, 0, 1, 0], [0, 0, 0, 0, 1]]
    tilt.append([0, 0, g, 0, 0])
    yaw, height = [[0, 1, 0], [0, 0, 1]], [[0, 1, 0], [0, 0, 1], [1, 0, 0]]
    return [
        ("roll/pitch", _plant(motor_s, params, [1, 1, g, 1], tilt), _tilt_stages(gains, params)),
        ("yaw", _plant(motor_s, params, [1, 1], yaw), _yaw_stages(gains, params)),
        ("thrust", _plant(motor_s, params, [1, 1], height), _height_stages(gains, params)),
    ]


def _tilt_stages(gains: CascadeGains, params: ControlParams) -> list[_Stage]:
    """Demands an angular acceleration. Outputs of the plant: rate, angle, velocity, position,
    acceleration."""
    step_s, outputs = 1.0 / params.control_hz, 5
    attitude = _gain([[gains.attitude[0]]], step_s)
    velocity = _pi(gains.velocity.kp[0], gains.velocity.ki[0], step_s)
    per_g = _gain([[1.0 / GRAVITY_MPS2]], step_s)
    damping = _gain([[0.0, 0.0, 0.0, 0.0, gains.velocity.kd[0]]], step_s)
    position = _gain([[gains.position[0]]], step_s)
    return [
        _rate_stage("rate roll/pitch", gains, 0, outputs, step_s),
        _Stage("attitude roll/pitch", attitude, _pick(1, outputs, step_s)),
        _Stage("velocity horizontal", per_g * velocity, _pick(2, outputs, step_s), per_g * damping),
        _Stage("position horizontal", position, _pick(3, outputs, step_s)),
    ]


def _rate_stage(name: str, gains: CascadeGains, axis: int, outputs: int, step_s: float) -> _Stage:
    """The derivative, a backward difference, acts on the measured rate alone; output 0."""
    forward = _pi(gains.rate.kp[axis], gains.rate.ki[axis], step_s)
    per_step = gains.rate.kd[axis] / step_s
    derivative = control.ss(0.0, 1.0, -per_step, per_step, step_s)
    output = _pick(0, outputs, step_s)
    return _Stage(name, forward, output, derivative * output)


def _yaw_stages(gains: CascadeGains, params: ControlParams) -> list[_Stage]:
    """Demands an angular acceleration. Outputs of the plant: rate, angle."""
    step_s = 1.0 / params.control_hz
    attitude = _gain([[gains.attitude[2]]], step_s)
    return [
        _rate_stage("rate yaw", gains, 2, 2, step_s),
        _Stage("attitude yaw", attitude, _pick(1, 2, step_s)),
    ]


def _height_stages(gains: CascadeGains, params: ControlParams) -> list[_Stage]:
    """Demands an acceleration. Outputs of the plant: velocity, position, acceleration."""
    step_s = 1.0 / params.control_hz
    velocity = _pi(gains.velocity.kp[2], gains.velocity.ki[2], step_s)
    damping = _gain([[0.0, 0.0, gains.velocity.kd[2]]], step_s)
    position = _gain([[gains.position[2]]], step_s)
    return [
        _Stage("velocity vertical", velocity, _pick(0, 3, step_s), damping),
        _Stage("position vertical", position, _pick(1, 3, step_s)),
    ]


def _plant(
    motor_s: float, params: ControlParams, links: Sequence[float], rows: Sequence[Sequence[float]]
) -> System:
    """The motor's lag followed by one integrator per link, ``rows`` picking outputs from these
    states; sampled, behind the lead and a sample of delay."""
    size, step_s = len(links) + 1, 1.0 / params.control_hz
    dynamics = np.diag(links, k=-1)
    dynamics[0, 0] = -1.0 / motor_s
    drive = np.zeros((size, 1))
    drive[0] = 1.0 / motor_s
    continuous = control.ss(dynamics, drive, np.array(rows, dtype=float), 0.0)
    sampled = control.sample_system(continuous, step_s, method="zoh")
    delay = control.ss(0.0, 1.0, 1.0, 0.0, step_s)
    gain, decay = lead_coefficients(motor_s, params.response_s(motor_s), step_s)
    approach = (1.0 - decay) * gain
    lead = control.ss(1.0 - approach, approach, 1.0 - gain, gain, step_s)
    return sampled * delay * lead


def _pi(proportional: float, integral: float, step_s: float) -> System:
    """As ``controller.pid`` computes it: the integral moves after the output."""
    return control.ss(1.0, step_s * integral, 1.0, proportional, step_s)


def _gain(matrix: list[list[float]], step_s: float) -> System:
    return control.ss([], [], [], np.array(matrix), step_s)


def _pick(index: int, count: int, step_s: float) -> System:
    """The row that selects one output."""
    return _gain([[float(i == index) for i in range(count)]], step_s)


def _closed(plant: System, stage: _Stage) -> System:
    """From the stage's reference to the plant's outputs."""
    if stage.damping is not None:
        plant = control.feedback(plant, stage.damping)
    return control.feedback(plant * stage.forward, stage.measured)


def _cut_loops(plant: System, stages: list[_Stage]) -> list[tuple[str, System]]:
    loops = []
    for stage in stages:
        loops.append((stage.name, stage.feedback * plant))
        plant = _closed(plant, stage)
    return loops


def _cut_at_actuator(plant: System, stages: list[_Stage]) -> System:
    """Loop gain at the rotors with every loop closed."""
    law = stages[-1].feedback
    for stage in reversed(stages[:-1]):
        law = stage.forward * law + stage.feedback
    return law * plant


def _margin(name: str, loop: System) -> LoopMargin:
    """Returns the margins from the frequency response on a fine grid, which avoids the rounding
    errors of polynomials with many poles near z = 1; linear between its points."""
    grid = np.geomspace(0.01, 0.999 * np.pi / loop.dt, 1_500)
    response = _response(loop, np.exp(1j * grid * loop.dt))
    gain_db, phase = 20.0 * np.log10(np.abs(response)), np.unwrap(np.angle(response))
    at_unity, where = _crossings(gain_db)
    phases = (1.0 - where) * phase[at_unity] + where * phase[at_unity + 1]
    at_turn, there = _crossings(np.sin(phase))
    gains = (1.0 - there) * gain_db[at_turn] + there * gain_db[at_turn + 1]
    gains = gains[np.cos(phase[at_turn]) < 0.0]  # at -180 degrees, and not at 0
    off = np.abs(phases % (2.0 * np.pi) - np.pi)
    return LoopMargin(
        name=name,
        gain_margin_db=float(np.min(np.abs(gains), initial=np.inf)),
        phase_margin_deg=float(np.degrees(np.min(off, initial=np.inf))),
        crossover_rad_s=float(np.max(grid[at_unity] ** (1.0 - where) * grid[at_unity + 1] ** where,
                                     initial=0.0)),
    )  # fmt: skip


def _response(loop: System, points: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """(N,) of a single loop at (N,) ``points`` of the z plane."""
    states = points[:, None, None] * np.eye(loop.nstates) - loop.A
    inside = np.linalg.solve(states, np.broadcast_to(loop.B, (len(points), *loop.B.shape)))
    return (loop.C @ inside)[:, 0, 0] + loop.D[0, 0]


def _crossings(values: Array) -> tuple[NDArray[np.int64], Array]:
    """Indices before which, and fractions of a step after which, ``values`` (N,) pass zero."""
    at = np.flatnonzero(values[:-1] * values[1:] < 0.0)
    return at, values[at] / (values[at] - values[at + 1])
