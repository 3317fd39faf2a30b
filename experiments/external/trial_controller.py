"""The examination of a controller: it flies a synthetic airframe along a short way."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.controller.api import ControllerRig, Setpoint
from touchdown.experiments.external.conformance_report import Findings
from touchdown.experiments.external.loading import Build
from touchdown.experiments.external.part_checks import lacks, wrong_command
from touchdown.experiments.external.synthetic_airframe import SyntheticAirframe
from touchdown.experiments.external.trial import COMMON_RULES, Trial
from touchdown.sim.api import GRAVITY_MPS2

Array = NDArray[np.float64]

FARTHEST_M, LAST_M = 1.0, 0.3
"""largest distance to the setpoint on the way, and at its end"""
RULES: Mapping[str, str] = {
    **COMMON_RULES,
    "steers": f"a synthetic airframe stays within {FARTHEST_M:g} m of the setpoint and ends "
    f"within {LAST_M:g} m",
    "limit": "the thrust keeps to the setpoint's thrust_limit",
    "stop": "all rotor speeds are 0 where the setpoint has motors_on = False",
}

_TICK_HZ = 600
_START = np.array([0.0, 0.0, 10.0])
_WAY = np.array([2.0, -1.0, 1.0])
_HOVER_S, _WAY_S, _SECONDS = 0.5, 3.0, 5.0
_TURN_RAD = 0.3
_LIMIT, _SLACK = 0.5, 1.05


def examine_controller(build: Build, rig: ControllerRig, params: Mapping[str, Any]) -> Findings:
    """The broken rules of a controller, its latency and how well it follows the way."""
    trial = Trial("controller", build, params, rig, lambda part: lacks(part, "update"))
    trial.sessions(lambda part: _session(trial, part))
    return trial.findings


def setpoint_at(time_s: float) -> Setpoint:
    """The way: half a second of hovering, three seconds of minimum jerk with a turn, hovering."""
    share = float(np.clip((time_s - _HOVER_S) / _WAY_S, 0.0, 1.0))
    place = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    speed = 30.0 * share**2 * (1.0 - share) ** 2 / _WAY_S
    change = 60.0 * share * (1.0 - share) * (1.0 - 2.0 * share) / _WAY_S**2
    return Setpoint(
        position_odom=_START + place * _WAY,
        velocity_odom=speed * _WAY,
        acceleration_odom=change * _WAY,
        yaw_odom=place * _TURN_RAD,
        yaw_rate=speed * _TURN_RAD,
    )


def _session(trial: Trial, part: Any) -> Iterator[Any]:
    rig: ControllerRig = trial.rig
    frame = SyntheticAirframe(rig.vehicle, _START, 1.0 / rig.control_hz)
    first = dataclasses.replace(setpoint_at(0.0), motors_on=False)
    unhealthy = dataclasses.replace(frame.estimate(_TICK_HZ), healthy=False)
    command = trial.ask(part, "update", unhealthy, first, when="at first", rule="missing data")
    yield command
    if not _judged(trial, command, "at first") or not _stops(trial, command):
        return
    farthest = away = 0.0
    for number in range(round(_SECONDS * rig.control_hz)):
        time_s = number / rig.control_hz
        estimate, setpoint = frame.estimate(_TICK_HZ), setpoint_at(time_s)
        command = trial.ask(part, "update", estimate, setpoint, when=f"at {time_s:.3f} s")
        yield command
        if not _judged(trial, command, f"at {time_s:.3f} s"):
            return
        frame.step(command.rotor_speed_radps)
        away = float(np.linalg.norm(frame.position - setpoint.position_odom))
        farthest = max(farthest, away)
        if farthest > FARTHEST_M:
            text = f"at {time_s:.2f} s the airframe is {away:.1f} m from the setpoint"
            trial.note("steers", text)
            return
    trial.findings.figures["way"] = f"{farthest:.2f} m off at most, {away:.2f} m at its end"
    if away > LAST_M:
        trial.note("steers", f"the airframe ends {away:.2f} m from the setpoint")
    yield from _limits(trial, part, frame)


def _limits(trial: Trial, part: Any, frame: SyntheticAirframe) -> Iterator[Any]:
    """Asks for less thrust than the weight, and then for none."""
    vehicle = trial.rig.vehicle
    weight = vehicle.mass_kg * GRAVITY_MPS2
    last = setpoint_at(_SECONDS)
    command = trial.ask(
        part, "update", frame.estimate(_TICK_HZ), dataclasses.replace(last, thrust_limit=_LIMIT)
    )
    yield command
    if not _judged(trial, command, "with a thrust_limit"):
        return
    thrust = vehicle.thrust_coefficient * float(np.sum(command.rotor_speed_radps**2))
    if thrust > _SLACK * _LIMIT * weight:
        trial.note("limit", f"thrust_limit = {_LIMIT:g} gave {thrust / weight:.2f} of the weight")
    off = dataclasses.replace(last, motors_on=False)
    command = trial.ask(part, "update", frame.estimate(_TICK_HZ), off)
    yield command
    if _judged(trial, command, "with motors_on = False"):
        _stops(trial, command)


def _judged(trial: Trial, command: Any, when: str) -> bool:
    if command is None and trial.findings.violations:
        return False  # it raised
    wrong = wrong_command(command)
    trial.judge(wrong, f"{when} update returned")
    return wrong is None


def _stops(trial: Trial, command: Any) -> bool:
    if np.any(command.rotor_speed_radps != 0.0):
        trial.note("stop", "motors_on = False left rotors turning")
        return False
    return True
