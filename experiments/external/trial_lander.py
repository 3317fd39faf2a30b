"""The examination of a lander: a vehicle that follows its setpoints exactly, over flat ground."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.controller.api import Setpoint
from touchdown.estimator.api import Estimate, GridMap, MapView
from touchdown.experiments.external.conformance_report import Findings
from touchdown.experiments.external.loading import Build
from touchdown.experiments.external.part_checks import wrong_lander, wrong_setpoint, wrong_view
from touchdown.experiments.external.trial import COMMON_RULES, Trial
from touchdown.landing.api import LanderRig, Phase
from touchdown.sim.api import GRAVITY_MPS2, ImuSample, Observation
from touchdown.sim.frames import Pose, rotation_from_yaw, yaw_from_rotation

Array = NDArray[np.float64]

JUMP_M, CONTACT_MPS, SECONDS = 0.5, 0.5, 300.0
RULES: Mapping[str, str] = {
    **COMMON_RULES,
    "continuity": f"the setpoint does not jump by more than {JUMP_M:g} m while motors are on",
    "mission": "the phase is SURVEY once, and DONE, with motors off on the ground, within "
    f"{SECONDS:g} s",
    "touchdown": f"the first contact is at {CONTACT_MPS:g} m/s or less",
}

_WIDE_M, _CELL_M = 120.0, 0.25
_BELOW_M = 0.3
"""setpoint below the ground at which the rotors carry least"""


class FollowedSetpoints:
    """A vehicle that is where its setpoint is, but for the ground at z = 0, and what its sensors
    and its map would be: no scan and no image ever arrives."""

    def __init__(self, rig: LanderRig) -> None:
        self._sensors = rig.sensors
        vehicle = rig.sensors.vehicle
        start = rig.sensors.world_from_body_start
        self._low = vehicle.leg_height_m
        self._hover = np.sqrt(vehicle.mass_kg * GRAVITY_MPS2 / 4.0 / vehicle.thrust_coefficient)
        self._yaw = yaw_from_rotation(start.rotation)
        self._step_s = rig.sensors.imu_ticks / rig.sensors.tick_hz
        self._tick = 0
        self.position: Array = start.translation * [1.0, 1.0, 0.0] + [0.0, 0.0, self._low]
        self.velocity: Array = np.zeros(3)
        self._acceleration: Array = np.zeros(3)
        self._carried = 0.0
        grid = _flat_map(self.position[:2])
        self._map = MapView(version=1, coarse=grid, fine=grid)

    @property
    def on_ground(self) -> bool:
        """True where the legs touch."""
        return bool(self.position[2] <= self._low)

    def seen(self) -> tuple[Observation, Estimate, MapView]:
        """What a lander is given now."""
        turn = rotation_from_yaw(self._yaw)
        time: dict[str, Any] = {"tick": self._tick, "time_s": self._tick / self._sensors.tick_hz}
        force = turn.T @ (self._acceleration + [0.0, 0.0, GRAVITY_MPS2])
        mount = self._sensors.body_from_imu.rotation
        imu = ImuSample(**time, angular_velocity=np.zeros(3), specific_force=mount.T @ force)
        obs = Observation(
            **time,
            imu=(imu,) if self._tick else (),
            rotor_speed_radps=np.full(4, self._hover * np.sqrt(self._carried)),
            battery_fraction=1.0 - 1e-6 * self._tick,
        )
        estimate = Estimate(
            **time,
            odom_from_body=Pose(turn, self.position.copy()),
            world_from_odom=Pose.identity(),
            velocity_odom=self.velocity.copy(),
            angular_velocity_body=np.zeros(3),
            acceleration_odom=self._acceleration.copy(),
            position_covariance=1e-4 * np.eye(3),
            rotation_covariance=1e-6 * np.eye(3),
        )
        return obs, estimate, self._map

    def follow(self, setpoint: Setpoint) -> None:
        """Goes where the setpoint is; stays where motors are off."""
        before, speed = self.position, self.velocity
        below = self._low - float(setpoint.position_odom[2])
        if setpoint.motors_on:
            self._yaw = float(setpoint.yaw_odom)
            if setpoint.thrust_limit is None:
                self.position = np.array(setpoint.position_odom, np.float64)
        self.position = np.maximum(self.position, [-np.inf, -np.inf, self._low])
        limit = np.inf if setpoint.thrust_limit is None else setpoint.thrust_limit
        share = 1.0 - min(max(below / _BELOW_M, 0.0), 0.8) if self.on_ground else 1.0
        self._carried = min(share, limit) if setpoint.motors_on else 0.0
        self.velocity = (self.position - before) / self._step_s
        self._acceleration = (self.velocity - speed) / self._step_s
        self._tick += self._sensors.imu_ticks


def _flat_map(centre: Array) -> GridMap:
    """A square of level ground at z = 0, seen everywhere."""
    side = round(_WIDE_M / _CELL_M)
    noise = np.random.default_rng(5).normal(0.0, 0.005, (side, side))
    height = noise.astype(np.float32)
    one = np.ones_like(height)
    return GridMap(
        origin_xy_m=np.floor(centre - 0.5 * _WIDE_M),
        cell_m=_CELL_M,
        count=12.0 * one,
        height_m=height,
        height_std_m=0.02 * one,
        min_height_m=height - np.float32(0.03),
        max_height_m=height + np.float32(0.03),
        rgb=np.stack([90.0 * one] * 3, axis=-1),
        intensity=60.0 * one,
        missing=0.0 * one,
        last_seen_s=one,
    )


def examine_lander(build: Build, rig: LanderRig, params: Mapping[str, Any]) -> Findings:
    """The broken rules of a lander, its latency and its phases."""
    trial = Trial("lander", build, params, rig, lambda part: wrong_lander(part, rig.sensors))
    trial.sessions(lambda part: _session(trial, part))
    return trial.findings


def _session(trial: Trial, part: Any) -> Iterator[Any]:
    vehicle = FollowedSetpoints(trial.rig)
    phases: dict[Phase, float] = {}
    last: Setpoint | None = None
    flew = False
    while (given := vehicle.seen())[0].time_s < SECONDS:
        time_s = given[0].time_s
        when = f"at {time_s:.3f} s"
        setpoint = trial.ask(part, "update", *given, when=when)
        view = None if setpoint is None else trial.ask(part, "view", when=when)
        if view is None and trial.findings.violations:
            return  # it raised
        wrong = wrong_setpoint(setpoint)
        trial.judge(wrong, f"{when} update returned")
        unseen = wrong_view(view)
        trial.judge(unseen, f"{when} view returned")
        if wrong is not None or unseen is not None or view is None:
            return
        yield setpoint, view.phase
        phases.setdefault(view.phase, time_s)
        jump = 0.0 if last is None else _jump(last, setpoint)
        if jump > JUMP_M:
            trial.note("continuity", f"{when} the setpoint jumped by {jump:.2f} m")
        last, before = setpoint, vehicle.on_ground
        falling = -float(vehicle.velocity[2])
        vehicle.follow(setpoint)
        flew = flew or vehicle.position[2] > 2.0
        if flew and vehicle.on_ground and not before:
            trial.findings.figures["touchdown"] = f"at {time_s:.1f} s with {falling:.2f} m/s"
            if falling > CONTACT_MPS:
                trial.note("touchdown", f"{when} the ground is touched with {falling:.2f} m/s")
        if view.phase is Phase.DONE and not setpoint.motors_on:
            break
    _judge_mission(trial, phases, landed=flew and vehicle.on_ground, last=last)


def _jump(last: Setpoint, now: Setpoint) -> float:
    if not (last.motors_on and now.motors_on):
        return 0.0
    return float(np.linalg.norm(now.position_odom - last.position_odom))


def _judge_mission(
    trial: Trial, phases: Mapping[Phase, float], *, landed: bool, last: Setpoint | None
) -> None:
    told = ", ".join(f"{phase} {time_s:.1f}" for phase, time_s in phases.items())
    trial.findings.figures["phases"] = f"{told} s"
    done = Phase.DONE in phases and last is not None and not last.motors_on
    if Phase.SURVEY not in phases or not done or not landed:
        lacks = "has landed with motors off" if Phase.SURVEY in phases else "has surveyed"
        trial.note("mission", f"within {SECONDS:g} s it never {lacks}: phases {told} s")
