"""A lander: up, along one leg, to the first site of the selector, straight down.

touchdown land flat --preset short --lander examples.straight_in:build
"""

from collections.abc import Iterator

import numpy as np

from touchdown.controller.api import Setpoint
from touchdown.estimator.api import Estimate, MapView
from touchdown.landing.api import LanderRig, LanderView, Phase, SelectorInput
from touchdown.sim.api import Observation, SensorNeeds
from touchdown.sim.frames import yaw_from_rotation


class StraightIn:
    """A generator yields the setpoint of each control step. It has neither site recheck, ground
    classification nor go-around; without a site it lands where it took off."""

    needs = SensorNeeds(lidar=True)

    def __init__(self, params: dict, rig: LanderRig) -> None:
        self.rig, self.sink_mps = rig, params.get("sink_mps", 0.12)
        start = rig.sensors.world_from_body_start
        self.home, self.heading = start.translation.copy(), yaw_from_rotation(start.rotation)
        self.reference, self.phase, self.note = self.home.copy(), Phase.INIT, "motors off"
        self.site, self.choice, self.no_site = None, None, False
        self.steps = self.fly()

    def update(self, obs: Observation, estimate: Estimate, map_view: MapView) -> Setpoint:
        self.obs, self.estimate, self.map_view = obs, estimate, map_view
        return next(self.steps)

    def view(self) -> LanderView:
        choice = self.choice
        return LanderView(
            phase=self.phase,
            note=self.note,
            reference_world=self.estimate.world_from_odom.apply(self.reference),
            candidates=() if choice is None else choice.candidates,
            costmap=None if choice is None else choice.costmap,
            site_world=self.site,
            committed_site_world=self.site,
            no_site=self.no_site,
        )

    def fly(self) -> Iterator[Setpoint]:
        yield from self.hold(1.5, motors_on=False)  # the estimator learns its biases
        yield from self.hold(0.8, thrust_limit=0.4)
        self.phase, self.note = Phase.TAKEOFF, "climbing"
        height = self.home[2] + self.rig.survey.height_m
        yield from self.move([*self.home[:2], height], self.rig.landing.climb_speed_mps)
        self.phase, self.note = Phase.SURVEY, "one leg"
        ahead = np.array([np.cos(self.heading), np.sin(self.heading), 0.0])
        end = self.reference + self.rig.survey.leg_length_m * ahead
        yield from self.move(end, self.rig.landing.cruise_speed_mps)
        if self.rig.landing.survey_only:
            self.phase = Phase.DONE
            yield from self.hold(np.inf)
        ground = yield from self.choose()
        self.phase = Phase.DESCEND
        low = ground + self.rig.sensors.vehicle.leg_height_m
        self.site = self.estimate.world_from_odom.apply(np.array([*self.reference[:2], ground]))
        sinking = self.rig.landing.descent_speed_mps
        yield from self.move([*self.reference[:2], low + 1.0], sinking)
        while not self.on_ground(low):
            self.reference[2] -= self.sink_mps * self.step_s
            yield self.setpoint(velocity=np.array([0.0, 0.0, -self.sink_mps]))
        self.phase, self.note = Phase.TOUCHDOWN, "ground contact: motors off"
        for fraction in np.linspace(0.8, 0.1, 100):
            yield self.setpoint(thrust_limit=float(fraction))
        yield from self.hold(1.0, motors_on=False)
        self.phase = Phase.DONE
        yield from self.hold(np.inf, motors_on=False)

    def choose(self) -> Iterator[Setpoint]:
        """Flies above the first accepted site and returns the height of its ground."""
        self.phase, self.note = Phase.SELECT, "choosing a site"
        yield from self.hold(0.5)
        seen = SelectorInput(map_view=self.map_view, estimate=self.estimate)
        self.choice = self.rig.select(seen)
        yield from self.hold(self.rig.landing.decision_latency_s)
        sites = [site for site in self.choice.candidates if site.accepted]
        self.no_site = not sites
        self.phase = Phase.RETURN if self.no_site else Phase.APPROACH
        self.note = "no site: back to the take-off" if self.no_site else sites[0].reason
        home = self.home - [0.0, 0.0, self.rig.sensors.vehicle.leg_height_m]
        place = home if self.no_site else sites[0].position_odom
        yield from self.move([*place[:2], self.reference[2]], self.rig.landing.cruise_speed_mps)
        yield from self.hold(1.0)
        return float(place[2])

    def on_ground(self, low: float) -> bool:
        """True where the reference has gone into the ground and the vehicle has not followed."""
        z = self.estimate.odom_from_body.translation[2]
        stopped = abs(self.estimate.velocity_odom[2]) < 0.05
        return bool(self.reference[2] < z - 0.15 and stopped and z < low + 0.5)

    def move(self, end: list | np.ndarray, speed_mps: float) -> Iterator[Setpoint]:
        """A minimum-jerk way of at most ``speed_mps``, and half a second at its end."""
        start, way = self.reference.copy(), np.asarray(end, float) - self.reference
        length = np.linalg.norm(way)
        last_s = max(1.875 * length / speed_mps, np.sqrt(5.78 * length / 3.0), 0.1)
        for time_s in np.arange(self.step_s, last_s, self.step_s):
            s = time_s / last_s
            self.reference = start + s**3 * (10.0 - 15.0 * s + 6.0 * s**2) * way
            speed = 30.0 * s**2 * (1.0 - s) ** 2 / last_s
            change = 60.0 * s * (1.0 - s) * (1.0 - 2.0 * s) / last_s**2
            yield self.setpoint(speed * way, change * way)
        self.reference = start + way
        yield from self.hold(0.5)

    def hold(self, seconds: float, **more: object) -> Iterator[Setpoint]:
        end_s = self.obs.time_s + seconds
        while self.obs.time_s < end_s:
            yield self.setpoint(**more)

    @property
    def step_s(self) -> float:
        return self.rig.sensors.imu_ticks / self.rig.sensors.tick_hz

    def setpoint(self, velocity: np.ndarray | None = None, acceleration: np.ndarray | None = None,
                 **more: object) -> Setpoint:  # fmt: skip
        return Setpoint(
            position_odom=self.reference.copy(),
            velocity_odom=np.zeros(3) if velocity is None else velocity,
            acceleration_odom=np.zeros(3) if acceleration is None else acceleration,
            yaw_odom=self.heading,
            **more,
        )


def build(params: dict, rig: LanderRig) -> StraightIn:
    return StraightIn(params, rig)
