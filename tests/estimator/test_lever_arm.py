"""Every estimator on an IMU that is off the centre of mass, and on a start whose tilt is not told.

The world's own IMU without noise is an exact log: the vehicle rests, then climbs while it rolls and
yaws. Position and velocity are those of the body origin.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchdown.estimator.baselines.gps import GpsEstimator
from touchdown.estimator.baselines.hybrid_flow import HybridFlowEstimator
from touchdown.estimator.baselines.optical_flow import OpticalFlowEstimator
from touchdown.estimator.baselines.stereo import StereoEstimator
from touchdown.estimator.filtering.levelling import level_from_rest, level_sigmas
from touchdown.estimator.livo.estimator import Livo
from touchdown.estimator.oracle import Oracle
from touchdown.estimator.paper.estimator import PaperEstimator
from touchdown.scenes.compose import load_scene
from touchdown.sim.api import (
    BarometerParams,
    Command,
    GpsParams,
    ImuParams,
    MagnetometerParams,
    NavParams,
    Observation,
    SensorNeeds,
    SensorRig,
    SimParams,
    Truth,
    WindParams,
    WorldParams,
)
from touchdown.sim.frames import Pose, rotation_from_yaw, so3_exp, so3_log, yaw_from_rotation
from touchdown.sim.world import MujocoWorld

SLOPE = """<mujoco><worldbody>
  <geom name="lawn_floor" type="plane" size="60 60 0.1" euler="4 0 0"/>
  <site name="takeoff" pos="1 2 0" euler="0 0 30"/>
</worldbody></mujoco>"""
EXACT = NavParams(
    gps=GpsParams(sigma_xy_m=0.0, sigma_z_m=0.0, white_m=0.0, velocity_sigma_mps=0.0),
    barometer=BarometerParams(white_sigma_pa=0.0, drift_sigma_pa=0.0, offset_sigma_pa=0.0),
    magnetometer=MagnetometerParams(noise_sigma_ut=0.0, hard_iron_sigma_ut=0.0),
)
QUIET = ImuParams(
    gyro_density=0.0, accel_density=0.0, gyro_bias_walk=0.0, accel_bias_walk=0.0,
    gyro_bias_sigma=0.0, accel_bias_sigma=0.0,
)  # fmt: skip
LEVER = (0.12, -0.08, 0.06)
"""three times what vehicles have, so that ignoring it shows"""
NEEDS = SensorNeeds(gps=True, barometer=True, magnetometer=True)
REST, FLIGHT = 100, 140

Make = Callable[[SensorRig, Callable[[], Truth]], Any]
ESTIMATORS: dict[str, Make] = {
    "livo": lambda rig, _: Livo(rig),
    "paper": lambda rig, _: PaperEstimator(rig),
    "optical_flow": lambda rig, _: OpticalFlowEstimator(rig),
    "stereo": lambda rig, _: StereoEstimator(rig),
    "gps": lambda rig, _: GpsEstimator(rig),
    "hybrid_flow": lambda rig, _: HybridFlowEstimator(rig),
    "oracle": lambda rig, truth: Oracle(truth, rig),
}


@dataclass(frozen=True)
class Log:
    rig: SensorRig
    observations: list[Observation]
    truths: list[Truth]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Log:
    path: Path = tmp_path_factory.mktemp("place") / "place.xml"
    path.write_text(SLOPE)
    params = WorldParams(
        sim=SimParams(threads=1), wind=WindParams(mean_kmh=0.0, turbulence=False),
        imu=replace(QUIET, offset_m=LEVER), nav=EXACT,
    )  # fmt: skip
    world = MujocoWorld(load_scene(str(path), 0), params, 3, NEEDS)
    observations, truths = [world.reset()], [world.truth()]
    for k in range(REST + FLIGHT):
        turn = 45.0 * np.array([1.0, -0.6, -1.0, 0.4]) * np.sin(0.1 * (k - REST))
        speed = np.zeros(4) if k < REST else 430.0 + turn
        observations.append(world.step(Command(rotor_speed_radps=speed)))
        truths.append(world.truth())
    # What an estimator assumes of its IMU's noise stays that of the data sheet.
    rig = replace(world.rig, imu=ImuParams(offset_m=LEVER))
    world.close()
    return Log(rig, observations, truths)


def run(make: Make, rig: SensorRig, log: Log) -> tuple[Any, Truth]:
    now = [log.truths[0]]
    estimator = make(rig, lambda: now[0])
    for obs, truth in zip(log.observations, log.truths, strict=True):
        now[0] = truth
        estimate = estimator.update(obs)
    return estimate, log.truths[-1]


def test_the_log_turns_enough_to_tell(log: Log) -> None:
    last = log.truths[-1]
    turn = last.world_from_body.rotation
    assert np.linalg.norm(turn @ np.cross(last.angular_velocity_body, LEVER)) > 0.02
    assert np.linalg.norm(last.velocity_world) > 0.5
    tilt = log.rig.world_from_body_start.rotation[2, 2]
    assert np.degrees(np.arccos(tilt)) == pytest.approx(4.0, abs=0.5)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_pose_and_velocity_are_those_of_the_body_origin(name: str, log: Log) -> None:
    estimate, truth = run(ESTIMATORS[name], log.rig, log)
    pose = estimate.world_from_body
    # Those of the second kind find their heading by the magnetometer, and correct it in flight.
    near, turned = (0.04, 0.015) if name in ("gps", "hybrid_flow") else (0.012, 3e-3)
    np.testing.assert_allclose(pose.translation, truth.world_from_body.translation, atol=near)
    np.testing.assert_allclose(estimate.velocity_odom, truth.velocity_world, atol=0.03)
    np.testing.assert_allclose(pose.rotation, truth.world_from_body.rotation, atol=turned)


@pytest.mark.parametrize(
    "name", [name for name in ESTIMATORS if name in ("paper", "optical_flow", "stereo")]
)
def test_roll_and_pitch_are_found_at_rest(name: str, log: Log) -> None:
    """The rig tells heading and position only; the pad slopes by 4 degrees."""
    start = log.rig.world_from_body_start
    heading = Pose(rotation_from_yaw(yaw_from_rotation(start.rotation)), start.translation)
    rig = replace(log.rig, world_from_body_start=heading, start_tilt_sigma_rad=0.05)
    estimate, truth = run(ESTIMATORS[name], rig, log)
    found = estimate.world_from_body
    off = so3_log(truth.world_from_body.rotation.T @ found.rotation)
    assert np.degrees(np.linalg.norm(off)) < 0.25
    np.testing.assert_allclose(estimate.velocity_odom, truth.velocity_world, atol=0.05)
    np.testing.assert_allclose(found.translation, truth.world_from_body.translation, atol=0.03)


def test_level_from_rest_finds_roll_and_pitch_and_keeps_the_heading() -> None:
    rng = np.random.default_rng(1)
    for yaw, roll, pitch in ((0.3, 0.1, -0.2), (-2.0, -0.25, 0.05), (3.0, 0.0, 0.0)):
        true = (
            rotation_from_yaw(yaw)
            @ so3_exp(np.array([0.0, pitch, 0.0]))
            @ so3_exp(np.array([roll, 0.0, 0.0]))
        )
        forces = 9.81 * true[2] + 1e-3 * rng.standard_normal((400, 3))
        np.testing.assert_allclose(level_from_rest(forces, yaw), true, atol=2e-5)
    with pytest.raises(ValueError, match="at rest"):
        level_from_rest(np.zeros((0, 3)), 0.0)


def test_tilt_is_as_uncertain_as_the_accelerometer() -> None:
    sigmas = level_sigmas(ImuParams(accel_bias_sigma=0.0981, misalignment_sigma_deg=0.5))
    np.testing.assert_allclose(sigmas[:2], np.hypot(np.hypot(0.01, np.radians(0.5)), 1e-3))
    assert sigmas[2] < 1e-3
