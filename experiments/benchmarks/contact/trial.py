"""One touchdown of the bench: the last metres of a mission by its own code in its own loop.

Mission, touchdown detection, motor cut, controller, sensors of the detection, air and referee are
those of a flight. The estimate is the truth, but for a drift of its position and velocity where the
vehicle is to move over the ground: that is how it comes to do so in flight. Nothing is perceived.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from touchdown.controller.api import Setpoint
from touchdown.estimator.api import Estimate, MapView
from touchdown.estimator.oracle import Oracle
from touchdown.experiments.benchmarks.contact.terrain import Terrain, feet_xy, terrain_scene
from touchdown.experiments.config.schema import Config
from touchdown.experiments.flight.loop import run_flight
from touchdown.experiments.flight.run import make_referee
from touchdown.experiments.flight.wiring import FlightStack, build_flight_stack
from touchdown.experiments.recording.recorder import NullRecorder, StepRecord
from touchdown.landing.api import LanderView, LandingParams
from touchdown.landing.mission.descent import final_descent
from touchdown.landing.mission.mission import Mission, Steps
from touchdown.landing.mission.phases import rest
from touchdown.landing.mission.trajectory import descent_trajectory
from touchdown.scenes.truth.maps import PAD_RADIUS_M
from touchdown.scenes.truth.static_surface import cast_points
from touchdown.sim.api import Command, Observation, SensorNeeds, Truth, VehicleModel
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array

_SLOW_M = 0.2
"""height at which the mission reaches its touchdown speed"""
_NEAR_M, _FAR_M = 0.25, 1.3
"""height of the legs at the start: over ground that is met at touchdown speed; else that from which
the cruise of the final descent is reached"""
_REST_S = 4.0
"""after the planned contact of the last leg; who has not come to rest by then slides"""


@dataclass(frozen=True, slots=True)
class Conditions:
    """Conditions of one contact. ``friction`` None: that of the vehicle's own feet."""

    friction: float | None = None
    speed_mps: float = 0.0
    wind_kmh: float = 0.0


@dataclass(frozen=True, slots=True)
class Trial:
    """One contact to fly. ``config``: of the world and the mission; its seed draws all else."""

    config: Config
    terrain: Terrain
    conditions: Conditions


@dataclass(frozen=True, slots=True)
class Touch:
    """How a trial ended."""

    terrain: Terrain
    conditions: Conditions
    fails: str
    """``tips``, ``strikes`` (a part other than a leg touches the ground), ``slides``; "" where the
    vehicle stands"""
    slid_m: float
    """way of the footprint's centre over the ground from the first contact to rest; NaN without"""
    tilt_deg: float
    """largest from the first contact on"""
    contact_mps: float
    """horizontal speed at the first contact"""
    safe_geometry: bool
    """by the true rule, at the first contact"""


def fly_trial(trial: Trial) -> Touch:
    """Flies one contact and judges it. The same trial gives the same result to the bit."""
    rng = np.random.default_rng([trial.config.seed, 0])
    scene = terrain_scene(trial.terrain, trial.conditions.friction, rng)
    heading = rng.uniform(-np.pi, np.pi)
    drift = trial.conditions.speed_mps * np.array([np.cos(heading), np.sin(heading), 0.0])
    heights, _ = cast_points(scene, np.vstack([np.zeros(2), feet_xy()]))
    ground = float(heights[0])
    low = trial.terrain.kind == "slope" or trial.terrain.size <= _SLOW_M
    top = trial.terrain.size if trial.terrain.legs else ground
    legs_m = max(top, ground) + _NEAR_M if low else ground + _FAR_M
    contact_s = _contact_s(trial.config.landing, legs_m - ground, max(top - ground, 0.0))
    last_leg_s = float(np.ptp(heights)) / trial.config.landing.touchdown_speed_mps
    wind = replace(trial.config.wind, mean_kmh=trial.conditions.wind_kmh, wakes=False)
    referee = replace(trial.config.referee, timeout_s=contact_s + last_leg_s + _REST_S)
    config = trial.config.model_copy(update={"wind": wind, "referee": referee})
    stack = build_flight_stack(config, scene)
    start = np.array([0.0, 0.0, legs_m + stack.nominal_rig.vehicle.leg_height_m])
    start -= contact_s * drift
    site = np.array([*start[:2], ground])
    return _judged(trial, config, stack, _Dropped(stack.world, start), site, drift)


def _contact_s(params: LandingParams, height_m: float, top_m: float) -> float:
    """Time at which the plan has the legs at ``top_m`` over the ground, from ``height_m``."""
    path = descent_trajectory(
        np.array([0.0, 0.0, height_m]),
        _SLOW_M,
        cruise_speed=params.final_speed_mps,
        touchdown_speed=params.touchdown_speed_mps,
        max_accel=params.final_accel_mps2,
    )
    times = np.arange(0.0, path.duration_s + _SLOW_M / params.touchdown_speed_mps, 0.01)
    heights = np.array([path.sample(t)[0][2] for t in times])
    return float(times[np.argmin(np.abs(heights - top_m))])


def _judged(
    trial: Trial, config: Config, stack: FlightStack, world: "_Dropped", site: Array, drift: Array
) -> Touch:
    vehicle = stack.nominal_rig.vehicle
    last = _Last(vehicle.leg_height_m)
    try:
        judgement = run_flight(
            world=world,  # type: ignore[arg-type]
            estimator=_Drifting(stack.world.truth, drift),
            mapper=stack.mapper,
            lander=_FinalDescent(stack, config, site),
            controller=stack.controller,
            recorder=last,
            referee=make_referee(config, stack.scene, lambda: None),
        )
    finally:
        stack.world.close()
    landing, outcome = judgement.landing, judgement.outcome
    return Touch(
        terrain=trial.terrain,
        conditions=trial.conditions,
        fails=failure_of(outcome, last.slid_m, pad_margin_m(vehicle)),
        slid_m=last.slid_m,
        tilt_deg=np.nan if landing is None else float(landing.tilt_deg or 0.0),
        contact_mps=last.contact_mps,
        safe_geometry=landing is not None and bool(landing.safe_geometry),
    )


def pad_margin_m(vehicle: VehicleModel) -> float:
    """What the pad of the true rule leaves around the vehicle: who moves farther from the first
    contact on stands beside the ground that the rule has judged."""
    return max(PAD_RADIUS_M - vehicle.footprint_radius_m, 0.0)


def failure_of(outcome: str, slid_m: float, margin_m: float) -> str:
    """What `Touch.fails` says of a flight's outcome and of the way that the vehicle slid."""
    if outcome == "TIPPED":
        return "tips"
    if outcome == "COLLIDED":
        return "strikes"
    return "" if outcome == "LANDED" and slid_m <= margin_m else "slides"


class _Dropped:
    """A world whose first step lifts the vehicle to ``position`` (3,), at rest and level."""

    def __init__(self, world: Any, position: Array) -> None:
        self._world, self._position, self._lifted = world, position, False

    def reset(self) -> Observation:
        return self._world.reset()

    def truth(self) -> Truth:
        return self._world.truth()

    def follow(self, phase: str, site_world: Array | None) -> None:
        self._world.follow(phase, site_world)

    def step(self, command: Command) -> Observation:
        observation: Observation
        if self._lifted:
            observation = self._world.step(command)
        else:
            observation = self._world.start_in_air(self._position, 0.0)
        self._lifted = True
        return observation


class _Drifting(Oracle):
    """The truth, with a position that falls behind by ``drift`` (3,) m/s: the controller, which
    holds it, moves the vehicle by as much."""

    def __init__(self, truth: Any, drift: Array) -> None:
        super().__init__(truth)
        self._drift = drift

    def update(self, obs: Observation) -> Estimate:
        estimate = super().update(obs)
        pose = estimate.odom_from_body
        return replace(
            estimate,
            odom_from_body=Pose(pose.rotation, pose.translation - obs.time_s * self._drift),
            velocity_odom=estimate.velocity_odom - self._drift,
        )


class _FinalDescent:
    """A lander that knows its site: the final descent of the mission and what follows."""

    needs = SensorNeeds()

    def __init__(self, stack: FlightStack, config: Config, site: Array) -> None:
        self._mission = Mission(stack.nominal_rig, config.landing, config.survey)
        self._site = site
        self._steps: Steps | None = None

    def update(self, obs: Observation, estimate: Estimate, map_view: MapView) -> Setpoint:
        mission = self._mission
        mission.update(obs, estimate, map_view)
        if self._steps is None:  # still on the pad
            self._steps = self._descend()
            return mission.setpoint(mission.start_world, motors_on=False)
        return next(self._steps)

    def _descend(self) -> Steps:
        mission = self._mission
        mission.reference_world = mission.view.estimate.world_from_body.translation.copy()
        mission.state.choose(self._site)
        mission.state.commit(self._site)
        yield from final_descent(mission)
        yield from rest(mission)

    def view(self) -> LanderView:
        state = self._mission.state
        return LanderView(
            phase=state.phase,
            note=state.note,
            reference_world=self._mission.reference_world,
            committed_site_world=state.committed_site_world,
        )


class _Last(NullRecorder):
    """Follows the centre of the footprint from the first contact on."""

    def __init__(self, leg_height_m: float) -> None:
        self._below = np.array([0.0, 0.0, -leg_height_m])
        self._contact: Array | None = None
        self.contact_mps = self.slid_m = np.nan

    def tick(self, step: StepRecord) -> None:
        truth = step.truth
        footprint = truth.world_from_body.apply(self._below)
        if self._contact is None and truth.time_s > 0.0 and truth.contacts:
            self._contact = footprint
            self.contact_mps = float(np.hypot(*truth.velocity_world[:2]))
        if self._contact is not None:
            self.slid_m = float(np.hypot(*(footprint - self._contact)[:2]))
