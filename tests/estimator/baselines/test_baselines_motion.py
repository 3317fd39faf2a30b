"""The baselines in motion: what each of them corrects of a wrong state."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from touchdown.estimator.api import CalibrationPriors
from touchdown.estimator.baselines import ground_flow
from touchdown.estimator.baselines.aiding import BaroHeight, update_velocity
from touchdown.estimator.baselines.gps import FollowingAnchor, SatelliteAiding
from touchdown.estimator.baselines.ground_flow import Displacement, update_with_displacement
from touchdown.estimator.baselines.navigator import Alignment
from touchdown.estimator.baselines.optical_flow import HybridFlowEstimator, OpticalFlowEstimator
from touchdown.estimator.baselines.stereo import StereoEstimator, _Keyframe
from touchdown.estimator.filtering.error_state import (
    CALIBRATION_DIM,
    CAMERA_ROTATION,
    CAMERA_TRANSLATION,
    CLOCK,
    SHARED_DIM,
    STATE_DIM,
    VELOCITY,
)
from touchdown.estimator.filtering.eskf import Eskf
from touchdown.estimator.filtering.imu_propagation import NavState
from touchdown.estimator.ground_below import GroundBelow
from touchdown.sim.api import (
    GRAVITY_MPS2,
    BarometerSample,
    GpsFix,
    MagnetometerSample,
    Observation,
    RangefinderSample,
    SensorRig,
)
from touchdown.sim.frames import Pose, rotation_from_yaw, so3_exp, so3_log
from touchdown.sim.navigation.sensors import earth_field_world

from support.livo_flight import HZ, IMU_TICKS, LATENCY, START_Z, inertial
from support.zou2024_flight import image_from, make_rig

REST, LAST = 240, 1080
START = Pose(rotation_from_yaw(0.5), np.array([0.0, 0.0, START_Z]))


def rig_of(leg_m: float) -> SensorRig:
    """The IMU at the body's origin; ``leg_m``: the ground lies so far below the start."""
    rig = make_rig()
    vehicle = dataclasses.replace(rig.vehicle, leg_height_m=leg_m)
    return dataclasses.replace(
        rig, body_from_imu=Pose.identity(), vehicle=vehicle, world_from_body_start=START
    )


def observations(rig: SensorRig) -> tuple[list[Observation], dict[int, tuple[Pose, np.ndarray]]]:
    """0.4 s at rest, then 1.4 s of flight that rolls, pitches, turns and climbs, without noise;
    poses and velocities by tick. Stereo pairs ten times a second, no fixes."""
    pose, velocity, step = START, np.zeros(3), IMU_TICKS / HZ
    truth = {0: (pose, velocity)}
    field = earth_field_world(rig.nav.magnetometer)
    mount = np.array(rig.nav.rangefinder.position_body_m)
    seen = []
    for tick in range(IMU_TICKS, LAST + 1, IMU_TICKS):
        t = (tick - REST) / HZ
        flying = float(tick > REST)
        rate = flying * np.array([0.3 * np.cos(4 * t), -0.2 * np.cos(3 * t), 0.4])
        push = flying * np.array([1.5, -0.8, 0.5])
        force = pose.rotation.T @ (push + [0.0, 0.0, GRAVITY_MPS2])
        position = pose.translation + step * velocity + 0.5 * step**2 * push
        velocity = velocity + step * push
        pose = Pose(pose.rotation @ so3_exp(step * rate), position)
        truth[tick] = pose, velocity
        messages: dict[str, Any] = {}
        if tick % 12 == 0:
            reading = pose.rotation.T @ field
            messages["magnetometer"] = (
                MagnetometerSample(tick=tick, time_s=tick / HZ, field_body_ut=reading),
            )
            reach = (pose.translation + pose.rotation @ mount)[2] / pose.rotation[2, 2]
            messages["rangefinder"] = (
                RangefinderSample(tick=tick, time_s=tick / HZ, range_m=reach),
            )
        measured = tick - LATENCY
        if measured > 0 and measured % 60 == 0:
            there = truth[measured][0]
            left = image_from(there, measured, rig)
            other = dataclasses.replace(rig, body_from_camera=rig.body_from_camera_right)
            right = image_from(there, measured, other).rgb
            messages["images"] = (dataclasses.replace(left, right_rgb=right),)
        seen.append(inertial(tick, rate, force, 400.0 * flying, **messages))
    return seen, truth


def fly(estimator: Any, rig: SensorRig, upset: Any) -> tuple[Any, np.ndarray, np.ndarray]:
    """Calls ``upset`` of the filter at the first image in flight. Returns the last estimate, and
    the velocity's and the rotation's error."""
    seen, truth = observations(rig)
    for obs in seen:
        if obs.tick == REST + 60 + LATENCY:
            upset(estimator._nav.eskf)
            estimator._nav.filter.catch_up()  # what control is given is wrong, too
        estimate = estimator.update(obs)
    pose, velocity = truth[LAST]
    turned = so3_log(pose.rotation.T @ estimate.odom_from_body.rotation)
    return estimate, estimate.velocity_odom - velocity, turned


def faster(eskf: Eskf) -> None:
    eskf.state = dataclasses.replace(
        eskf.state, velocity=eskf.state.velocity + np.array([0.4, -0.3, 0.0])
    )
    eskf.covariance[VELOCITY, VELOCITY] += np.diag([0.25, 0.25, 1e-4])


def turned_left(eskf: Eskf) -> None:
    eskf.state = dataclasses.replace(eskf.state, rotation=eskf.state.rotation @ so3_exp(TURN))
    eskf.covariance[2, 2] += 0.1**2


TURN = np.array([0.0, 0.0, 0.1])


class Coarse(HybridFlowEstimator):
    """By phase correlation alone."""

    def _dense(self, *args: Any) -> None:
        return None


@pytest.mark.parametrize(("make", "leg_m", "max_mps"), [
    (OpticalFlowEstimator, 0.3, 0.05), (HybridFlowEstimator, 0.3, 0.05), (Coarse, 0.3, 0.10),
    (StereoEstimator, START_Z, 0.05),
], ids=["flow", "hybrid", "coarse", "stereo"])  # fmt: skip
def test_images_correct_a_wrong_velocity(make: Any, leg_m: float, max_mps: float) -> None:
    """0.5 m/s of error; over ground 12 m below, which flow learns by the rangefinder."""
    rig = rig_of(leg_m)
    estimate, error, turned = fly(make(rig), rig, faster)
    assert np.abs(error[:2]).max() < max_mps and abs(error[2]) < 0.1
    assert np.abs(turned).max() < 0.01
    name = "features_tracked" if make is StereoEstimator else "flow_used"
    assert estimate.diagnostics[name] >= (1 if make is Coarse else 20)


def test_the_magnetometer_corrects_a_wrong_heading() -> None:
    rig = rig_of(0.3)
    _, _, turned = fly(OpticalFlowEstimator(rig), rig, turned_left)
    assert abs(turned[2]) < 0.03


@pytest.mark.parametrize(
    ("late_s", "turn"),
    [(0.02, (0.0, 0.0, 0.0)), (0.0, (0.02, -0.02, 0.03))],
    ids=["clock", "mount"],
)
@pytest.mark.parametrize(
    ("make", "leg_m"),
    [(OpticalFlowEstimator, 0.3), (HybridFlowEstimator, 0.3), (StereoEstimator, START_Z)],
    ids=["flow", "hybrid", "stereo"],
)
def test_the_clock_and_the_mount_of_the_camera_are_found(
    make: Any, leg_m: float, late_s: float, turn: Any
) -> None:
    """Stamps that are late, or a camera that is turned on the IMU: found to a third of a prior as
    large, and what is found is used."""
    rig = rig_of(leg_m)
    given = {
        name: Pose(so3_exp(-np.array(turn)) @ pose.rotation, pose.translation)
        for name in ("body_from_camera", "body_from_camera_right")
        for pose in (getattr(rig, name),)
    }
    priors = CalibrationPriors(
        camera_clock_sigma_s=late_s, camera_rotation_sigma_deg=0.0 if late_s else 2.0
    )
    estimator = make(dataclasses.replace(rig, **given), priors=priors)
    seen, truth = observations(rig)
    late = round(late_s * HZ)
    for obs in seen:
        images = tuple(
            dataclasses.replace(image, tick=image.tick + late, time_s=image.time_s + late_s)
            for image in obs.images
        )
        estimate = estimator.update(dataclasses.replace(obs, images=images))
    nav, found = estimator._nav, estimator._nav.eskf.state.calibration
    assert nav.clock_s == pytest.approx(late_s, abs=0.4 * 0.02)
    np.testing.assert_allclose(found[CAMERA_ROTATION], turn, atol=0.3 * 0.03)
    spread = np.sqrt(np.diag(nav.eskf.covariance))[STATE_DIM:]
    assert spread[CLOCK] < 0.2 * 0.02 and spread[CAMERA_ROTATION].max() < 0.5 * np.radians(2.0)
    np.testing.assert_allclose(
        nav.imu_from_camera.rotation, rig.body_from_camera.rotation, atol=0.3 * 0.03
    )
    assert estimate.diagnostics["calibration_clock_ms"] == 1e3 * nav.clock_s
    error = nav.filter.present.position - truth[LAST][0].translation
    assert np.abs(error).max() < 0.02


def filter_at(
    pose: Pose, velocity: Any = (0.0, 0.0, 0.0), sigma: Any = 0.1, calibration: int = 0
) -> Eskf:
    zero, going = np.zeros(3), np.asarray(velocity, float)
    state = NavState(60, pose.rotation, pose.translation, going, zero, zero, np.zeros(calibration))
    return Eskf(state, np.full(15 + calibration, sigma) ** 2)


def fix_of(position: np.ndarray, velocity: np.ndarray, sigma: float = 1e-3) -> GpsFix:
    return GpsFix(
        tick=60, time_s=0.1, position_world=position, velocity_world=velocity,
        sigma_position_m=np.full(3, 0.5), sigma_velocity_mps=sigma,
    )  # fmt: skip


LEVER, RATE = np.array([0.3, -0.2, 0.5]), np.array([0.4, 1.1, -0.7])
POSE = Pose(so3_exp(np.array([0.3, -0.2, 0.8])), np.array([3.0, -2.0, 9.0]))
GOING = np.array([4.0, 1.0, -0.5])


def test_velocity_of_the_antenna_is_that_of_its_lever_too() -> None:
    swing = POSE.rotation @ np.cross(RATE, LEVER)
    eskf = filter_at(POSE, GOING + [0.2, -0.1, 0.1], np.repeat([1e-5, 1.0], [3, 12]))
    distance = update_velocity(eskf, fix_of(np.zeros(3), GOING + swing), LEVER, RATE)
    np.testing.assert_allclose(eskf.state.velocity, GOING, atol=1e-3)
    assert distance == pytest.approx(np.sqrt(0.06 / 3.0), rel=0.01)
    # and its direction shows the attitude, where the velocity itself is known
    wrong = Pose(POSE.rotation @ so3_exp(np.array([1e-3, 0.0, 0.0])), POSE.translation)
    eskf = filter_at(wrong, GOING, np.repeat([1e-1, 1e-7], [3, 12]))
    update_velocity(eskf, fix_of(np.zeros(3), GOING + swing), LEVER, RATE)
    after = eskf.state.rotation @ np.cross(RATE, LEVER)
    assert np.linalg.norm(after - swing) < 0.2 * np.linalg.norm(
        wrong.rotation @ np.cross(RATE, LEVER) - swing
    )


def test_the_frame_of_a_fix_is_that_of_its_antenna() -> None:
    rig = dataclasses.replace(make_rig(), body_from_imu=Pose.identity())
    eskf = filter_at(POSE, GOING)
    nav: Any = SimpleNamespace(rig=rig, eskf=eskf, stationary=True, rate_imu=RATE, skipped=0)
    anchor = FollowingAnchor(0.3)
    aiding = SatelliteAiding(nav, anchor)
    antenna = POSE.apply(np.array(rig.nav.gps.antenna_body_m))
    aiding.take(fix_of(antenna + [7.0, 8.0, 9.0], np.zeros(3)))
    np.testing.assert_allclose(anchor.offset, [7.0, 8.0, 9.0], atol=1e-12)
    np.testing.assert_array_equal(eskf.state.velocity, GOING)  # at rest the filter knows better
    assert aiding.healthy(2.0) and not aiding.healthy(2.2)
    aiding.take(fix_of(np.full(3, np.nan), np.zeros(3)))
    assert nav.skipped == 1
    np.testing.assert_allclose(anchor.offset, [7.0, 8.0, 9.0], atol=1e-12)
    nav.stationary = False
    swing = POSE.rotation @ np.cross(RATE, np.array(rig.nav.gps.antenna_body_m))
    aiding.take(fix_of(antenna, GOING + [0.1, 0.0, 0.0] + swing))
    assert eskf.state.velocity[0] == pytest.approx(4.1, abs=1e-3)
    assert aiding.innovation == pytest.approx(np.sqrt(1.0 / 3.0), rel=0.1)


def test_a_displacement_is_compared_with_that_of_the_camera(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Residual and Jacobian, by finite differences over the present pose, the camera's mount and
    clock, and the clone."""
    found: list[Any] = []
    monkeypatch.setattr(ground_flow, "update", lambda *given: found.append(given) or 0.0)
    before = Pose(so3_exp(np.array([-0.1, 0.2, 0.5])), np.array([2.0, -1.5, 8.5]))
    by_before, by_now = np.random.default_rng(0).normal(0.0, 1.0, (2, 3, 3))
    twist_before = np.array([0.1, -0.3, 0.2, 1.0, 2.0, 3.0])
    true = before.apply(LEVER) - POSE.apply(LEVER)
    measured = Displacement(
        translation=true, covariance=0.04 * np.eye(3), by_rotation_before=by_before,
        by_rotation_now=by_now, used=9, rms=0.0,
    )  # fmt: skip
    dim = STATE_DIM + CALIBRATION_DIM
    columns = [*range(6), *range(STATE_DIM, STATE_DIM + SHARED_DIM), *range(dim, dim + 6)]

    def asked(error: np.ndarray) -> Any:
        eskf = filter_at(before, GOING, calibration=CALIBRATION_DIM)
        eskf.add_clone()
        eskf.rate = RATE
        eskf.state = dataclasses.replace(
            eskf.state, rotation=POSE.rotation, position=POSE.translation
        )
        now, then, shared = error[:6], error[-6:], error[6:-6]
        lever = LEVER + shared[CAMERA_TRANSLATION]
        full = np.zeros(len(eskf.covariance))
        full[:6] = now - shared[CLOCK] * eskf.twist
        full[dim:] = then - shared[CLOCK] * twist_before
        eskf.state, eskf.clones = eskf.boxplus(eskf.state, eskf.clones, full)
        update_with_displacement(
            eskf, measured, lever, twist_before, floor_m=0.3, scale_sigma=0.1, gate=4.0
        )
        # the measured translation changes with the attitudes that its directions were taken under
        turns = full[:3] + shared[CAMERA_ROTATION], full[dim : dim + 3] + shared[CAMERA_ROTATION]
        seen = by_now @ POSE.rotation @ turns[0] + by_before @ before.rotation @ turns[1]
        return found[-1], found[-1][3] + seen

    (_, touched, jacobian, residual, covariance, gate), _ = asked(np.zeros(len(columns)))
    np.testing.assert_allclose(residual, 0.0, atol=1e-12)
    np.testing.assert_allclose(covariance, 0.13 * np.eye(3) + 0.01 * np.outer(true, true))
    assert touched.tolist() == columns and gate == 4.0
    steps = 1e-6 * np.eye(len(columns))
    slopes = [(asked(-step)[1] - asked(step)[1]) / 2e-6 for step in steps]
    np.testing.assert_allclose(jacobian, np.array(slopes).T, atol=1e-7)


def test_the_attitude_at_rest_is_that_of_the_body_whatever_the_mount_of_the_imu() -> None:
    mount = Pose(so3_exp(np.array([0.4, -0.9, 2.0])), np.array([0.1, 0.0, 0.0]))
    rig = dataclasses.replace(make_rig(), body_from_imu=mount)
    field = earth_field_world(rig.nav.magnetometer)
    alignment = Alignment(rig)
    for tick in (3, 150):
        force = mount.rotation.T @ POSE.rotation.T @ [0.0, 0.0, GRAVITY_MPS2]
        reading = MagnetometerSample(
            tick=tick, time_s=tick / HZ, field_body_ut=POSE.rotation.T @ field
        )
        found = alignment.take(inertial(tick, np.zeros(3), force, magnetometer=(reading,)))
        assert (found is None) is (tick == 3)
    assert found is not None
    np.testing.assert_allclose(found.rotation, POSE.rotation, atol=1e-9)
    np.testing.assert_allclose(
        alignment.mean_force(), POSE.rotation.T @ [0.0, 0.0, GRAVITY_MPS2], atol=1e-9
    )


def test_late_samples_are_compared_with_where_the_vehicle_was() -> None:
    """A reading 0.05 s old, sinking at 2 m/s: 0.1 m higher than the state."""
    down = np.array([0.0, 0.0, -2.0])
    here = Pose(np.eye(3), np.array([0.0, 0.0, 20.0]))
    eskf = filter_at(here, down)
    baro = BaroHeight(HZ, 1e-3)

    def sample(tick: int, altitude: float) -> BarometerSample:
        return BarometerSample(tick=tick, time_s=tick / HZ, pressure_pa=1e5, altitude_m=altitude)

    baro.take(eskf, [sample(0, 100.0)], stationary=True)
    baro.take(eskf, [sample(30, 100.1)], stationary=False)
    assert eskf.state.position[2] == pytest.approx(20.0, abs=1e-3)
    rig = dataclasses.replace(make_rig(), body_from_imu=Pose.identity())
    ground = GroundBelow(rig, memory_s=0.2)
    mount = float(np.array(rig.nav.rangefinder.position_body_m)[2])
    first = RangefinderSample(tick=30, time_s=0.05, range_m=20.1 + mount - 3.0)
    ground.take([first], eskf.state)
    assert ground.height_m == pytest.approx(3.0, abs=2e-3)
    again = RangefinderSample(tick=60, time_s=0.1, range_m=20.0 + mount - 4.0)
    ground.take([again], eskf.state)
    assert ground.height_m == pytest.approx(4.0 - np.exp(-0.25), abs=2e-3)


def test_parallax_corrects_the_depth_of_a_corner() -> None:
    """12 m, believed to be 10 m: a step of 1 m aside shows it, or half of it at equal weights."""
    rig = rig_of(START_Z)
    estimator = StereoEstimator(rig)
    eskf, camera = estimator._nav.eskf, rig.camera
    eskf.add_clone()
    turned = estimator._nav.imu_from_camera.rotation
    step = turned @ np.array([1.0, 0.0, 0.0])
    eskf.state = dataclasses.replace(
        eskf.state, position=eskf.state.position + START.rotation @ step
    )
    pixels = np.array([[211.5, 119.5], [150.0, 60.0], [300.0, 200.0]])
    rays = np.column_stack([(pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones(3)])
    reached = pixels - [camera.fx / 12.0, 0.0]
    reached[2] += 20.0  # a wrong track
    noise = estimator._params.track_sigma
    variance = np.array([1.0, (noise / camera.fx) ** 2, 1.0])
    keyframe = _Keyframe(np.zeros((2, 2), np.uint8), pixels, rays, np.full(3, 0.1), variance.copy())
    estimator._update_depths(keyframe, np.arange(3), reached)
    half = 0.5 * (1.0 / 12.0 + 0.1)
    np.testing.assert_allclose(keyframe.inverse, [1.0 / 12.0, half, 0.1], rtol=1e-4)
    np.testing.assert_allclose(keyframe.variance[1:], [0.5 * variance[1], 1.0])
    landmarks = keyframe.landmarks(estimator._nav.imu_from_camera)
    expected = estimator._nav.imu_from_camera.apply(12.0 * rays[:1])
    np.testing.assert_allclose(landmarks[:1], expected, rtol=1e-4)
