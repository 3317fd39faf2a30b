"""Linear model and stability margins of every loop of the cascade.

Each loop is cut at its controller's output; the loop inside is closed, the loops around it are
open. The rows called ``actuator`` cut the complete cascade at the rotors. The model is discrete at
the control rate: airframe and motor lag behind a zero-order hold, one more sample of delay, the
motor lead, and the gains used in flight. Torques are scaled by the inertia and thrust by the mass,
so of the vehicle only the motors' lag matters. The model omits drag, which adds damping, and the
observer of the wind's force, in which the loops' own action cancels. ``touchdown control margins``
prints the margins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import control
import numpy as np

from touchdown.controller.api import ControlParams
from touchdown.controller.mixer import lead_coefficients
from touchdown.controller.pid import CascadeGains, cascade_gains
from touchdown.sim.api import GRAVITY_MPS2, VehicleModel

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


def loop_margins(vehicle: VehicleModel, params: ControlParams) -> list[LoopMargin]:
    """Returns the margins of every loop of ``CascadeController(vehicle, params)``, inner loops
    first."""
    rows = []
    for axes, plant, stages in _chains(vehicle.motor_time_constant_s, params):
        rows += [_margin(name, loop) for name, loop in _cut_loops(plant, stages)]
        rows.append(_margin(f"actuator, {axes}", _cut_at_actuator(plant, stages)))
    return rows


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
    gain, decay = lead_coefficients(motor_s, params.motor_response_s, step_s)
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
    errors of polynomials with many poles near z = 1."""
    grid = np.geomspace(0.01, 0.999 * np.pi / loop.dt, 1_500)
    response = control.frd(loop, grid)
    gain, phase, _, _, crossover, _ = control.stability_margins(response, returnall=True)
    return LoopMargin(
        name=name,
        gain_margin_db=float(np.min(np.abs(20.0 * np.log10(gain)), initial=np.inf)),
        phase_margin_deg=float(np.min(np.abs(phase), initial=np.inf)),
        crossover_rad_s=float(np.max(crossover, initial=0.0)),
    )
