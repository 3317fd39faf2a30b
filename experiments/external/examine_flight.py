"""The examinations of controllers and landers: what each is asked in the synthetic world, and the
checks of what it answered."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.controller.api import Setpoint
from touchdown.experiments.external.examination import (
    Examination,
)
from touchdown.experiments.external.part_checks import (
    wrong_command,
    wrong_setpoint,
    wrong_view,
)
from touchdown.experiments.external.synthetic_world import (
    FollowedSetpoints,
    SyntheticAirframe,
)
from touchdown.landing.api import Phase
from touchdown.sim.api import GRAVITY_MPS2

Array = NDArray[np.float64]

# ------------------------------------------------------------------------------------- controller

_START, _WAY = np.array([0.0, 0.0, 10.0]), np.array([2.0, -1.0, 1.0])
_HOVER_S, _WAY_S, _WAY_END_S = 0.5, 3.0, 5.0
_TURN_RAD = 0.3
FARTHEST_M, LAST_M = 1.0, 0.3
"""Largest distance to the setpoint on the way, and at its end."""
THRUST_LIMIT, _SLACK = 0.5, 1.05


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


@dataclass(slots=True)
class ControllerSession:
    """Motors off, a short way of a synthetic airframe, a limit of thrust, motors off again."""

    off_m: list[float] = field(default_factory=list)
    """distance to the setpoint at each control step"""
    arrived: bool = False
    weights: float = 0.0
    """thrust over the weight under `THRUST_LIMIT`"""
    turning: bool = False
    """whether a rotor turned with motors off"""

    def run(self, asked: Examination, part: Any) -> None:
        """Asks a controller for commands."""
        vehicle, hz = asked.rig.vehicle, asked.rig.control_hz
        frame = SyntheticAirframe(vehicle, _START, 1.0 / hz)

        def speeds(setpoint: Setpoint, when: str, rule: str = "answers", **more: Any) -> Array:
            estimate = dataclasses.replace(frame.estimate(), **more)
            command = asked.ask(part, "update", estimate, setpoint, when=when, rule=rule,
                                wrong=wrong_command)  # fmt: skip
            found: Array = command.rotor_speed_radps
            self.turning |= not setpoint.motors_on and bool(np.any(found != 0.0))
            return found

        off = dataclasses.replace(setpoint_at(0.0), motors_on=False)
        speeds(off, "at first", "missing data", healthy=False)
        for number in range(round(_WAY_END_S * hz)):
            setpoint = setpoint_at(number / hz)
            frame.step(speeds(setpoint, f"at {number / hz:.3f} s"))
            self.off_m.append(float(np.linalg.norm(frame.position - setpoint.position_odom)))
            if self.off_m[-1] > FARTHEST_M:
                return
        self.arrived = True
        worst, last = max(self.off_m), self.off_m[-1]
        asked.findings.figures["way"] = f"{worst:.2f} m off at most, {last:.2f} m at its end"
        end = setpoint_at(_WAY_END_S)
        limited = speeds(dataclasses.replace(end, thrust_limit=THRUST_LIMIT), "with a thrust_limit")
        thrust = vehicle.thrust_coefficient * float(np.sum(limited**2))
        self.weights = thrust / (vehicle.mass_kg * GRAVITY_MPS2)
        speeds(dataclasses.replace(end, motors_on=False), "with motors_on = False")


def steers(seen: ControllerSession) -> str:
    """A synthetic airframe stays within 1 m of the setpoint and ends within 0.3 m."""
    if seen.off_m and seen.off_m[-1] > FARTHEST_M:
        return f"the airframe is {seen.off_m[-1]:.1f} m from the setpoint on its way"
    if seen.arrived and seen.off_m[-1] > LAST_M:
        return f"the airframe ends {seen.off_m[-1]:.2f} m from the setpoint"
    return ""


def limit(seen: ControllerSession) -> str:
    """The thrust keeps to the setpoint's thrust_limit."""
    if seen.weights <= _SLACK * THRUST_LIMIT:
        return ""
    return f"thrust_limit = {THRUST_LIMIT:g} gave {seen.weights:.2f} of the weight"


def stop(seen: ControllerSession) -> str:
    """All rotor speeds are 0 where the setpoint has motors_on = False."""
    return "motors_on = False left rotors turning" if seen.turning else ""


# ----------------------------------------------------------------------------------------- lander

JUMP_M, CONTACT_MPS, MISSION_S = 0.5, 0.5, 300.0
_FLOWN_M = 2.0
"""Height from which on the vehicle has flown."""


@dataclass(slots=True)
class LanderSession:
    """A mission of a vehicle that follows its setpoints exactly, over flat ground."""

    phases: dict[Phase, float] = field(default_factory=dict)
    """time of the beginning of each, s"""
    jumps: list[tuple[float, str]] = field(default_factory=list)
    """distance between two setpoints with motors on, and when"""
    contacts: list[tuple[float, str]] = field(default_factory=list)
    """speed downwards at each contact after the take-off, m/s, and when"""
    over: bool = False
    landed: bool = False
    motors_on: bool = True

    def run(self, asked: Examination, part: Any) -> None:
        """Asks a lander for setpoints until it is done."""
        vehicle = FollowedSetpoints(asked.rig.sensors)
        last: Setpoint | None = None
        flew, done = False, False
        while not done and (given := vehicle.seen())[0].time_s < MISSION_S:
            time_s = given[0].time_s
            when = f"at {time_s:.3f} s"
            setpoint = asked.ask(part, "update", *given, when=when, wrong=wrong_setpoint)
            view = asked.ask(part, "view", when=when, wrong=wrong_view,
                             compared=lambda view: view.phase)  # fmt: skip
            self.phases.setdefault(view.phase, time_s)
            if last is not None and last.motors_on and setpoint.motors_on:
                jump = float(np.linalg.norm(setpoint.position_odom - last.position_odom))
                self.jumps += [(jump, when)] if jump > JUMP_M else []
            last, before, falling = setpoint, vehicle.on_ground, -float(vehicle.velocity[2])
            vehicle.follow(setpoint)
            flew = flew or vehicle.position[2] > _FLOWN_M
            if flew and vehicle.on_ground and not before:
                self.contacts.append((falling, when))
                text = f"at {time_s:.1f} s with {falling:.2f} m/s"
                asked.findings.figures["touchdown"] = text
            self.motors_on = setpoint.motors_on
            done = view.phase is Phase.DONE and not self.motors_on
        self.over, self.landed = True, flew and vehicle.on_ground
        asked.findings.figures["phases"] = _told(self.phases)


def continuity(seen: LanderSession) -> str:
    """The setpoint does not jump by more than 0.5 m while motors are on."""
    return next((f"{when} the setpoint jumped by {jump:.2f} m" for jump, when in seen.jumps), "")


def touchdown(seen: LanderSession) -> str:
    """The first contact is at 0.5 m/s or less."""
    for falling, when in seen.contacts:
        if falling > CONTACT_MPS:
            return f"{when} the ground is touched with {falling:.2f} m/s"
    return ""


def mission(seen: LanderSession) -> str:
    """The phase is SURVEY once, and DONE, with motors off on the ground, within 300 s."""
    done = Phase.DONE in seen.phases and not seen.motors_on and seen.landed
    if not seen.over or (done and Phase.SURVEY in seen.phases):
        return ""
    lacks = "has landed with motors off" if Phase.SURVEY in seen.phases else "has surveyed"
    return f"within {MISSION_S:g} s it never {lacks}: phases {_told(seen.phases)}"


def _told(phases: Mapping[Phase, float]) -> str:
    return ", ".join(f"{phase} {time_s:.1f}" for phase, time_s in phases.items()) + " s"
