"""Every estimator on an IMU that is off the centre of mass, and on a start whose tilt is unknown.

The world's own IMU without noise is an exact log: the vehicle rests, then climbs while it rolls and
yaws. Position and velocity are those of the body origin.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchdown.estimator.baselines.gps import GpsEstimator
from touchdown.estimator.baselines.optical_flow import HybridFlowEstimator, OpticalFlowEstimator
from touchdown.estimator.baselines.stereo import StereoEstimator
from touchdown.estimator.filtering.inertial_filter import InertialFilter, bias_sigmas
from touchdown.estimator.livo.estimator import Livo
from touchdown.estimator.oracle import Oracle
from touchdown.estimator.zou2024.estimator import Zou2024Estimator
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

from support.landing_support import make_rig
from support.livo_flight import inertial
from support.worlds import NO_NOISE

SLOPE = """<mujoco><worldbody>
  <geom name="lawn_floor" type="plane" size="60 60 0.1" euler="4 0 0"/>
  <site name="takeoff" pos="1 2 0" euler="0 0 30"/>
</worldbody></mujoco>"""
EXACT = NavParams(
    gps=GpsParams(sigma_xy_m=0.0, sigma_z_m=0.0, white_m=0.0, velocity_sigma_mps=0.0),
    barometer=BarometerParams(white_sigma_pa=0.0, drift_sigma_pa=0.0, offset_sigma_pa=0.0),
    magnetometer=MagnetometerParams(noise_sigma_ut=0.0, hard_iron_sigma_ut=0.0),
)
LEVER = (0.12, -0.08, 0.06)
"""three times what vehicles have, so that ignoring it shows"""
NEEDS = SensorNeeds(gps=True, barometer=True, magnetometer=True)
REST, FLIGHT = 100, 140

Make = Callable[[SensorRig, Callable[[], Truth]], Any]
ESTIMATORS: dict[str, Make] = {
    "livo": lambda rig, _: Livo(rig), "zou2024": lambda rig, _: Zou2024Estimator(rig),
    "optical_flow": lambda rig, _: OpticalFlowEstimator(rig),
    "stereo": lambda rig, _: StereoEstimator(rig), "gps": lambda rig, _: GpsEstimator(rig),
    "hybrid_flow": lambda rig, _: HybridFlowEstimator(rig),
    "oracle": lambda rig, truth: Oracle(truth),
}  # fmt: skip


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
        imu=replace(NO_NOISE, offset_m=LEVER), nav=EXACT,
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


@pytest.mark.parametrize("name", ESTIMATORS)
def test_pose_and_velocity_are_those_of_the_body_origin(name: str, log: Log) -> None:
    estimate, truth = run(ESTIMATORS[name], log.rig, log)
    pose = estimate.world_from_body
    # Those of the second kind find their heading by the magnetometer, and correct it in flight.
    near, turned = (0.04, 0.015) if name in ("gps", "hybrid_flow") else (0.012, 3e-3)
    np.testing.assert_allclose(pose.translation, truth.world_from_body.translation, atol=near)
    np.testing.assert_allclose(estimate.velocity_odom, truth.velocity_world, atol=0.03)
    np.testing.assert_allclose(pose.rotation, truth.world_from_body.rotation, atol=turned)


def test_the_oracle_refuses_the_truth_of_another_tick(log: Log) -> None:
    with pytest.raises(ValueError, match="the observation of tick 3"):
        Oracle(lambda: log.truths[0]).update(log.observations[1])


@pytest.mark.parametrize(
    "name", [name for name in ESTIMATORS if name in ("zou2024", "optical_flow", "stereo")]
)
def test_roll_and_pitch_are_found_at_rest(name: str, log: Log) -> None:
    """The rig states heading and position only; the pad slopes by 4 degrees."""
    start = log.rig.world_from_body_start
    heading = Pose(rotation_from_yaw(yaw_from_rotation(start.rotation)), start.translation)
    rig = replace(log.rig, world_from_body_start=heading, start_tilt_sigma_rad=0.05)
    estimate, truth = run(ESTIMATORS[name], rig, log)
    found = estimate.world_from_body
    off = so3_log(truth.world_from_body.rotation.T @ found.rotation)
    assert np.degrees(np.linalg.norm(off)) < 0.25
    np.testing.assert_allclose(estimate.velocity_odom, truth.velocity_world, atol=0.05)
    np.testing.assert_allclose(found.translation, truth.world_from_body.translation, atol=0.03)


def test_level_flight_hides_gravity_along_bent_and_stretched_axes() -> None:
    """0.5 degrees of misalignment look like 0.0856 m/s^2 across, a scale of 1 % like 0.0981 along
    the vertical."""
    imu = ImuParams(
        gyro_bias_sigma=3e-3, accel_bias_sigma=0.05, misalignment_sigma_deg=0.5,
        scale_sigma=0.01, gyro_g_sensitivity=4e-4,
    )  # fmt: skip
    sigmas = bias_sigmas(imu)
    np.testing.assert_allclose(sigmas[:3], np.hypot(3e-3, 3.9227e-3), rtol=1e-3)
    np.testing.assert_allclose(sigmas[3:5], np.hypot(0.05, 0.08558), rtol=1e-3)
    assert sigmas[5] == pytest.approx(np.hypot(0.05, 0.0980665), rel=1e-3)


def test_the_tilt_found_at_rest_is_tied_to_the_bias() -> None:
    """A levelled attitude errs by the accelerometer's bias over gravity: the filter knows it."""
    rig = replace(make_rig(), start_tilt_sigma_rad=0.05)
    standing = InertialFilter(rig)
    tilt = np.array([0.03, -0.02, 0.0])
    force = so3_exp(tilt).T @ [0.0, 0.0, 9.80665]
    for tick in range(3, 303, 3):
        standing.take_imu(inertial(tick, np.zeros(3), force))
    standing.carry_to(300)
    np.testing.assert_allclose(standing.eskf.state.rotation[2], so3_exp(tilt)[2], atol=2e-4)
    covariance = standing.eskf.covariance
    sigmas = np.sqrt(np.diag(covariance))
    assert sigmas[0] == pytest.approx(rig.imu.accel_bias_sigma / 9.80665, rel=0.2)
    assert covariance[0, 13] / (sigmas[0] * sigmas[13]) < -0.9
    assert covariance[1, 12] / (sigmas[1] * sigmas[12]) > 0.9
