"""The state machine: perfect estimate, a vehicle that follows its setpoint, a made-up map."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
import pytest
from landing_support import (
    LEG_HEIGHT,
    make_estimate,
    make_grid,
    make_imu,
    make_obs,
    make_rig,
    view_of,
)
from numpy.typing import NDArray

from controller.api import Setpoint
from estimator.api import GridMap, MapView
from landing.api import LanderView, LandingParams, Phase, SurveyParams
from landing.lander import SiteLander
from sim.api import GRAVITY_MPS2
from sim.frames import Pose

Array = NDArray[np.float64]

QUICK = SurveyParams(height_m=20.0, legs=2, leg_length_m=20.0, leg_spacing_m=10.0, duration_s=14.0)
PARAMS = LandingParams(climb_speed_mps=6.0, descent_speed_mps=5.0)
STEP_TICKS = 12
ORIGIN = (-20.0, -20.0)


def flat_map(height: float = 0.0, seed: int = 1) -> GridMap:
    return make_grid(np.full((280, 280), height), origin=ORIGIN, seed=seed)


def fine_map(centre: Array, height: float = 0.0) -> GridMap:
    """6 m of fine cells around a place, as a flight above it would leave them."""
    corner = tuple(np.round((centre[:2] - 3.0) / 0.05) * 0.05)
    return make_grid(np.full((120, 120), height), 0.05, origin=corner, returns=12, seed=2)


class Puppet:
    """Stands where its setpoint is, on the ground at the lowest; thrust as the flight needs."""

    def __init__(self, lander: SiteLander, coarse: GridMap, ground: float = 0.0) -> None:
        self.lander, self.coarse, self.ground = lander, coarse, ground
        self.position = np.array([0.0, 0.0, LEG_HEIGHT])
        self.setpoint: Setpoint | None = None
        self.tick = 0
        self.battery = 1.0
        self.fine_height = ground
        self.world_from_odom = Pose.identity()

    def view_map(self) -> MapView:
        low = self.position[2] - self.ground < 14.0
        return view_of(self.coarse, fine_map(self.position, self.fine_height) if low else None)

    def run(self, seconds: float) -> Iterator[tuple[LanderView, Setpoint]]:
        weight = 4.0 * GRAVITY_MPS2
        fine: MapView | None = None
        while self.tick < seconds * 600:
            on_ground = self.position[2] <= self.ground + LEG_HEIGHT + 1e-9
            carried = 0.5 if on_ground and self.setpoint and self.setpoint.motors_on else 1.0
            speed = np.full(4, np.sqrt(carried * weight / 4.0 / 4e-5))
            if self.tick % 120 == 0 or fine is None:
                fine = self.view_map()
            obs = make_obs(
                self.tick,
                imu=(make_imu(self.tick, GRAVITY_MPS2),),
                rotor_speed_radps=speed,
                battery_fraction=self.battery,
            )
            velocity = (
                np.zeros(3) if on_ground or not self.setpoint else self.setpoint.velocity_odom
            )
            estimate = dataclasses.replace(
                make_estimate(self.tick, Pose(np.eye(3), self.position.copy()), velocity),
                world_from_odom=self.world_from_odom,
            )
            self.setpoint = self.lander.update(obs, estimate, fine)
            if self.setpoint.motors_on:
                self.position = self.setpoint.position_odom.copy()
                self.position[2] = max(self.position[2], self.ground + LEG_HEIGHT)
            yield self.lander.view(), self.setpoint
            self.tick += STEP_TICKS


def fly(puppet: Puppet, seconds: float = 200.0) -> tuple[list[Phase], LanderView]:
    phases: list[Phase] = []
    for view, _ in puppet.run(seconds):
        if not phases or phases[-1] != view.phase:
            phases.append(view.phase)
        if view.phase is Phase.DONE:
            break
    return phases, view


def make_lander(**changes: object) -> SiteLander:
    return SiteLander(make_rig(), dataclasses.replace(PARAMS, **changes), QUICK)


def test_phases_follow_each_other_to_a_landing_on_the_committed_site() -> None:
    puppet = Puppet(make_lander(), flat_map())
    phases, view = fly(puppet)
    assert phases == [
        Phase.INIT, Phase.TAKEOFF, Phase.SURVEY, Phase.SELECT, Phase.APPROACH, Phase.DESCEND,
        Phase.TOUCHDOWN, Phase.DONE,
    ]  # fmt: skip
    assert view.committed_site_world is not None
    assert puppet.position[:2] == pytest.approx(view.committed_site_world[:2], abs=0.01)
    assert view.committed_site_world[2] == pytest.approx(0.0, abs=0.02)
    assert not view.no_site
    assert not view.aborted
    assert puppet.setpoint is not None
    assert not puppet.setpoint.motors_on


def test_references_never_jump_and_meet_the_ground_slowly() -> None:
    puppet = Puppet(make_lander(), flat_map())
    last, fastest_near_ground, commits = None, 0.0, set()
    for view, setpoint in puppet.run(200.0):
        if last is not None and setpoint.motors_on and view.phase is not Phase.TOUCHDOWN:
            step = np.linalg.norm(setpoint.position_odom - last)
            assert step < 8.0 * STEP_TICKS / 600.0, view.phase
        if view.phase is Phase.DESCEND and puppet.position[2] < LEG_HEIGHT + 0.2:
            fastest_near_ground = max(fastest_near_ground, abs(setpoint.velocity_odom[2]))
        if view.committed_site_world is not None:
            commits.add(tuple(view.committed_site_world))
        last = setpoint.position_odom
        if view.phase is Phase.DONE:
            break
    assert 0.05 < fastest_near_ground <= 0.2
    assert len(commits) == 1


def test_survey_only_is_done_after_the_survey_and_keeps_flying() -> None:
    puppet = Puppet(make_lander(survey_only=True), flat_map())
    phases, _ = fly(puppet)
    assert phases == [Phase.INIT, Phase.TAKEOFF, Phase.SURVEY, Phase.DONE]
    assert puppet.setpoint is not None
    assert puppet.setpoint.motors_on


def test_no_site_searches_another_leg_then_returns_home() -> None:
    rng = np.random.default_rng(3)
    rubble = make_grid(rng.uniform(0.0, 1.0, (280, 280)), origin=ORIGIN)
    puppet = Puppet(make_lander(), rubble)
    phases, view = fly(puppet)
    assert phases[3:] == [
        Phase.SELECT, Phase.SURVEY, Phase.SELECT, Phase.RETURN, Phase.DESCEND, Phase.TOUCHDOWN,
        Phase.DONE,
    ]  # fmt: skip
    assert view.no_site
    assert not view.aborted
    assert puppet.position[:2] == pytest.approx([0.0, 0.0], abs=0.02)


def test_commanded_site_is_flown_to() -> None:
    puppet = Puppet(make_lander(site_xy_m=(7.0, 5.0)), flat_map())
    phases, view = fly(puppet)
    assert phases[-1] is Phase.DONE
    assert Phase.RETURN not in phases
    assert puppet.position[:2] == pytest.approx([7.0, 5.0], abs=0.01)
    assert view.committed_site_world == pytest.approx([7.0, 5.0, 0.0], abs=0.02)


def test_unsuitable_commanded_site_is_refused_with_its_reason() -> None:
    height = np.zeros((280, 280))
    height[120:130, 132:140] = 0.8  # a box at x 6.4..8, y 4..6
    puppet = Puppet(make_lander(site_xy_m=(7.0, 5.0)), make_grid(height, origin=ORIGIN))
    phases, view = fly(puppet)
    assert view.aborted
    assert Phase.RETURN in phases
    assert Phase.APPROACH not in phases
    assert "refused" in view.candidates[0].reason
    assert puppet.position[:2] == pytest.approx([0.0, 0.0], abs=0.02)


def test_a_commanded_site_is_taken_unchecked_where_that_is_asked_for() -> None:
    height = np.zeros((280, 280))
    height[120:130, 132:140] = 0.8
    lander = make_lander(site_xy_m=(7.0, 5.0), check_site=False)
    phases, view = fly(Puppet(lander, make_grid(height, origin=ORIGIN)))
    assert not view.aborted
    assert Phase.RETURN not in phases
    assert view.candidates[0].reason.startswith("landed on unchecked; the map would have refused")
    assert view.committed_site_world is not None
    assert view.committed_site_world[:2] == pytest.approx([7.0, 5.0])


def test_a_commanded_site_stays_in_the_world_when_the_odometry_frame_is_corrected() -> None:
    """0.5 m to the north in the middle of the descent: the vehicle ends 0.5 m south in odom."""
    puppet = Puppet(make_lander(site_xy_m=(7.0, 5.0)), flat_map())
    view = None
    for view, _ in puppet.run(200.0):
        low = puppet.position[2] < 8.0 and view.phase is Phase.DESCEND
        if low:
            puppet.world_from_odom = Pose(np.eye(3), np.array([0.0, 0.5, 0.0]))
        if view.phase is Phase.DONE:
            break
    assert view is not None and view.committed_site_world is not None
    assert view.committed_site_world[:2] == pytest.approx([7.0, 5.0])
    assert puppet.position[:2] == pytest.approx([7.0, 4.5], abs=0.02)


def test_a_site_that_looks_worse_from_10_m_is_given_up() -> None:
    """The coarse map says flat, the fine one says rubble: go around twice, then home."""
    lander = make_lander()
    puppet = Puppet(lander, flat_map())
    rng = np.random.default_rng(5)

    def rubble_below() -> MapView:
        low = puppet.position[2] < 14.0
        corner = tuple(np.round((puppet.position[:2] - 6.0) / 0.05) * 0.05)
        rough = rng.uniform(0.0, 0.6, (240, 240))
        return view_of(
            puppet.coarse, make_grid(rough, 0.05, origin=corner, returns=4) if low else None
        )

    puppet.view_map = rubble_below  # type: ignore[method-assign]
    phases, view = fly(puppet, 400.0)
    assert phases.count(Phase.APPROACH) == 3
    assert view.no_site
    assert phases[-1] is Phase.DONE


def test_world_references_follow_a_correction_of_the_odometry_frame() -> None:
    """When world_from_odom moves by +1 m in x, the survey setpoint moves by -1 m in odom."""
    lander = make_lander()
    grid = view_of(flat_map())
    pose = Pose(np.eye(3), np.array([0.0, 0.0, LEG_HEIGHT]))
    shifted = Pose(np.eye(3), np.array([1.0, 0.0, 0.0]))
    first = lander.update(make_obs(0), make_estimate(0, pose), grid)
    moved = dataclasses.replace(make_estimate(3, pose), world_from_odom=shifted)
    second = lander.update(make_obs(3), moved, grid)
    assert second.position_odom - first.position_odom == pytest.approx([-1.0, 0.0, 0.0])
