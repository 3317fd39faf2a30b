"""`livo` on flights whose answer is known: single steps inside the estimator, and as a whole."""

import dataclasses
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from touchdown.estimator.api import Estimate, LivoParams
from touchdown.estimator.filtering.eskf import Eskf
from touchdown.estimator.filtering.imu_propagation import ImuBuffer, NavState
from touchdown.estimator.livo.estimator import Livo
from touchdown.estimator.livo.visual import VisualFrontEnd
from touchdown.sim.api import GRAVITY_MPS2, ImuParams, Observation, RangefinderSample, SensorRig
from touchdown.sim.frames import Pose, so3_exp

from support.livo_flight import (
    FLIGHT,
    HZ,
    IMU_TICKS,
    RIG,
    START_Z,
    fly,
    inertial,
    make_rig,
    observations,
    position_at,
    swaying,
)

Array = np.ndarray
UP = np.array([0.0, 0.0, GRAVITY_MPS2])


def accelerated(*mps2: float) -> Callable[[float], Array]:
    """Level, from rest at the start."""
    return lambda t: 0.5 * t * t * np.array(mps2) + [0.0, 0.0, START_Z]


def blind(flight: list[Observation]) -> list[Observation]:
    """Without images and scans."""
    return [dataclasses.replace(obs, images=(), scans=()) for obs in flight]


def sampled(obs: Observation, rate: Array, force: Callable[[Array], Array]) -> Observation:
    """The observation with other samples of the IMU."""
    imu = tuple(
        dataclasses.replace(
            sample, angular_velocity=rate, specific_force=force(sample.specific_force)
        )
        for sample in obs.imu
    )
    return dataclasses.replace(obs, imu=imu)


def run(
    flight: list[Observation], params: LivoParams | None = None, rig: SensorRig = RIG
) -> tuple[Livo, list[Estimate]]:
    livo = Livo(rig, params)
    return livo, [livo.update(obs) for obs in flight]


def test_without_sensors_the_covariance_is_that_of_dead_reckoning() -> None:
    """From the uncertainty of the start over every sample up to the present, with the noise of the
    flying vehicle; that of the position is inflated by 1.8 and has a floor of 5 mm."""
    params = LivoParams(
        use_calibration=False, ground_sigma_m=0.02, gyro_density=3e-3, accel_density=0.2,
        gyro_bias_walk=0.01, accel_bias_walk=0.3,
    )  # fmt: skip
    flight = blind(FLIGHT[:201])  # the covariance is renewed every 63 ticks, here at 600
    _, estimates = run(flight, params)
    sigmas = np.repeat([2e-4, 2e-3, 5e-3, RIG.imu.gyro_bias_sigma, RIG.imu.accel_bias_sigma], 3)
    start, zero = RIG.world_from_body_start @ RIG.body_from_imu, np.zeros(3)
    eskf = Eskf(NavState(0, start.rotation, start.translation, zero, zero, zero), sigmas**2)
    noise = ImuParams(
        gyro_density=3e-3, accel_density=0.2, gyro_bias_walk=0.01, accel_bias_walk=0.3
    )
    buffer = ImuBuffer(noise, IMU_TICKS / HZ)
    for obs in flight:
        for sample in obs.imu:
            buffer.push(sample.tick, sample.angular_velocity, sample.specific_force, False)
    eskf.propagate(buffer, buffer.count)
    floor = np.diag([0.005, 0.005, np.hypot(0.005, 0.02)]) ** 2
    position, rotation = eskf.covariance[3:6, 3:6], eskf.covariance[:3, :3]
    assert position[0, 0] > 1e-3
    np.testing.assert_allclose(estimates[-1].position_covariance, 1.8 * position + floor, rtol=1e-6)
    np.testing.assert_allclose(estimates[-1].rotation_covariance, rotation, rtol=1e-6, atol=1e-15)
    _, noisy = run(flight, dataclasses.replace(params, accel_density=4.0))
    assert np.trace(noisy[-1].position_covariance) > 1.0
    assert estimates[-1].healthy and not noisy[-1].healthy


def poor_imu() -> tuple[SensorRig, list[Observation]]:
    """An accelerometer whose bias is metres per second squared and known to be so."""
    rig = dataclasses.replace(RIG, imu=dataclasses.replace(RIG.imu, accel_bias_sigma=2.0))
    bias, flight = np.array([1.0, -1.5, 2.0]), observations(RIG, 780)
    return rig, [sampled(obs, np.zeros(3), lambda force: force + bias) for obs in flight]


def test_a_correction_is_handed_out_over_time_and_counted_until_it_is() -> None:
    """Errors of centimetres before the second scan and image: the covariance covers what is not
    handed out yet, the position does not jump, the track of a scan is the corrected one."""
    rig, flight = poor_imu()
    _, estimates = run(flight, rig=rig)
    estimates = [e for e in estimates if e.tick >= 96]  # the first scan was at 60
    errors = [e.world_from_body.translation - position_at(e.time_s) for e in estimates]
    scores = [
        error @ np.linalg.solve(e.position_covariance, error)
        for error, e in zip(errors, estimates, strict=True)
    ]
    assert max(np.linalg.norm(error) for error in errors) > 0.05
    assert max(scores) < 11.3  # chi-square, 3 degrees of freedom, 99 %
    assert np.linalg.norm(errors[-1]) < 0.01
    for a, b in itertools.pairwise(estimates):
        step = b.odom_from_body.translation - a.odom_from_body.translation
        expected = 0.5 * (a.velocity_odom + b.velocity_odom) * (b.time_s - a.time_s)
        assert np.linalg.norm(step - expected) < 0.01
    tracks = [e.scan_track for e in estimates if e.scan_track is not None]
    ends = [t.positions_odom[-1] - position_at(t.times_s[-1]) for t in tracks]
    assert abs(ends[1][2]) < 0.03  # of 0.04 that the bias makes in 0.2 s
    assert np.abs(ends[3:]).max() < 5e-3


@pytest.mark.parametrize("seen", [False, True])
def test_an_imu_mounted_askew_gives_the_same_estimate(seen: bool) -> None:
    """``seen``: with scans and images, over which the vehicle does not turn."""
    rate = np.zeros(3) if seen else np.array([0.3, -0.2, 0.5])
    turn = so3_exp(np.array([0.2, -0.3, 1.0]))
    askew = dataclasses.replace(RIG, body_from_imu=Pose(turn, RIG.body_from_imu.translation))
    ends = []
    for rig in (RIG, askew):
        to_imu = rig.body_from_imu.rotation.T
        flight = [
            sampled(obs, to_imu @ rate, lambda force, turn=to_imu: turn @ force)
            for obs in (FLIGHT[:60] if seen else blind(FLIGHT[:60]))
        ]
        ends.append(run(flight, LivoParams(use_calibration=False), rig)[1][-1])
    level, found = ends
    assert (found.diagnostics.get("features_tracked", 0.0) > 20.0) == seen
    # other returns are chosen from a scan whose frame is turned
    near, fraction = (2e-3, 0.2) if seen else (1e-9, 1e-5)
    np.testing.assert_allclose(found.angular_velocity_body, rate, atol=1e-9 + 0.1 * near)
    for name in ("velocity_odom", "acceleration_odom"):
        np.testing.assert_allclose(getattr(found, name), getattr(level, name), atol=near)
    for name in ("rotation", "translation"):
        pose, other = found.odom_from_body, level.odom_from_body
        np.testing.assert_allclose(getattr(pose, name), getattr(other, name), atol=near)
    for name in ("position_covariance", "rotation_covariance"):
        np.testing.assert_allclose(
            getattr(found, name), getattr(level, name), rtol=fraction, atol=1e-3 * near
        )


def test_the_ground_stays_where_it_is_under_a_climb() -> None:
    """At 4.6 m/s the vehicle is half a metre higher when a scan arrives than when it was taken."""
    livo, estimates = run(observations(RIG, 780, accelerated(0, 0, 4.0), seen=False))
    assert estimates[-1].velocity_odom[2] == pytest.approx(5.2, abs=0.05)
    ground = livo._map.recent.median_height()
    assert ground is not None and abs(ground) < 0.02
    said = [event for e in estimates for event in e.events if "LIDAR" in event]
    assert said == ["the LIDAR does not measure translation along 2 axes and rotation about 1 axis"]


def test_the_found_error_of_the_mount_is_applied_to_the_next_scan() -> None:
    """A LIDAR known to sit 0.1 m higher than stated sees the ground 0.1 m higher."""
    livo = Livo(RIG, LivoParams())
    known = np.zeros_like(livo._eskf.state.calibration)
    known[5] = 0.1
    livo._eskf.state = dataclasses.replace(livo._eskf.state, calibration=known)
    for obs in FLIGHT[:33]:
        livo.update(obs)
    assert livo._map.recent.median_height() == pytest.approx(0.1, abs=2e-3)


def test_a_scan_from_the_edge_of_the_blind_zone_is_not_used() -> None:
    """Its ranges are all within 4 standard deviations of the smallest."""
    flight, near = FLIGHT[:33], RIG.lidar.min_range_m + RIG.lidar.range_sigma_m
    scan = flight[-1].scans[0]
    ranges = np.linspace(near, near + 1e-3, len(scan.ranges), dtype=np.float32)
    close = dataclasses.replace(flight[-1], scans=(dataclasses.replace(scan, ranges=ranges),))
    for last, used in ((flight[-1], True), (close, False)):
        _, estimates = run([*flight[:-1], last])
        assert (estimates[-1].diagnostics["scan_returns"] > 0.0) == used


@pytest.mark.parametrize(("above_m", "estimated"), [(50.0, False), (5.0, True)])
def test_mounts_are_estimated_from_high_above_alone(above_m: float, estimated: bool) -> None:
    params = LivoParams(calibrate_above_m=above_m, camera_clock_sigma_s=0.0)
    livo, _ = run(FLIGHT[:120], params)
    assert bool(livo._eskf.state.calibration[:6].any()) == estimated


def test_level_ground_is_reported_as_degenerate() -> None:
    for use, expected in ((True, (2.0, 1.0)), (False, (0.0, 0.0))):
        _, estimates = run(FLIGHT[:100], LivoParams(use_vision=False, use_degeneracy=use))
        figures = estimates[-1].diagnostics
        found = figures["lidar_weak_translation"], figures["lidar_weak_rotation"]
        assert found == expected


def test_where_intensities_measure_the_covariance_counts_their_noise_that_repeats() -> None:
    fractions = []
    for after_s in (0.2, 60.0):
        params = LivoParams(use_vision=False, use_intensity=True, intensity_after_s=after_s)
        livo, estimates = run(FLIGHT[:120], params)
        jump, floor = livo._filter.jump[3:6], np.diag([0.005] * 3) ** 2
        spread = estimates[-1].position_covariance - floor - jump * jump[:, None]
        fractions.append(np.trace(spread[:2, :2]) / np.trace(livo._filter.covariance[3:5, 3:5]))
    assert fractions == pytest.approx([2.7, 1.8])


def test_the_map_belongs_to_clones_of_the_poses_that_made_it() -> None:
    """Without images a new one comes every 0.45 of the height of 6 m; 0.16 s pass until a scan is
    used."""
    flight = observations(RIG, 840, accelerated(14.0, 0.0, 0.0), seen=False)
    livo = Livo(RIG)
    counts = [len(livo._eskf.clones) for obs in flight if livo.update(obs)]
    assert (counts[600 // IMU_TICKS], counts[-1]) == (1, 2)
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(-6.0, 15.0), [-1.0, 0.0, 1.0]))
    matched = livo._map.planes.match(np.column_stack([x, y, np.zeros(x.size)]) + [0.4, 0.4, 0.0])
    assert matched.found.sum() > 40 and set(matched.anchors[matched.found].tolist()) == {0, 1}


@pytest.mark.parametrize(("way", "turn_deg", "lacks"), [
    ([0.0, 0.0, 0.0], 19.0, False), ([0.0, 0.0, 0.0], 21.0, True), ([2.6, -3.5, 0.0], 0.0, False),
    ([2.8, -3.7, 0.0], 0.0, True), ([0.0, 0.0, 2.9], 0.0, False), ([0.0, 0.0, -3.1], 0.0, True),
])  # fmt: skip
def test_turns_ways_and_climbs_in_the_dark_add_to_the_map(
    way: list[float], turn_deg: float, lacks: bool
) -> None:
    livo, _ = run(FLIGHT[:100], LivoParams(use_vision=False))
    livo._height = 10.0
    clone = livo._eskf.clones[-1]
    livo._eskf.state = dataclasses.replace(
        livo._eskf.state,
        rotation=clone.rotation @ so3_exp(np.radians([0.0, 0.0, turn_deg])),
        position=clone.translation + way,
    )
    assert livo._lacks_anchor(livo._eskf.state.tick + 600) == lacks


def test_a_distorted_lens_is_corrected() -> None:
    """Two per cent of barrel distortion are up to two pixels, over which the features move."""
    rig = make_rig(distortion=-0.1)
    _, estimates = run(observations(rig, 600, accelerated(4.0, 2.0, 0.0)), rig=rig)
    figures = estimates[-1].diagnostics
    assert figures["features_tracked"] > 30.0 and figures["visual_rms_px"] < 0.15
    error = estimates[-1].world_from_body.translation - accelerated(4.0, 2.0, 0.0)(1.0)
    assert np.linalg.norm(error) < 0.015


def test_a_keyframe_gets_depth_from_scans_after_it() -> None:
    """Ahead the LIDAR sees less than the camera: what the flight brings under it comes later."""
    flight = observations(RIG, 780, accelerated(6.0, 0.0, 0.0))
    livo = Livo(RIG, LivoParams())
    counts = []
    for obs in flight:
        livo.update(obs)
        seeing = [k for k in livo._vision.keyframes if k.pixels.size]
        counts += [int(seeing[0].valid.sum())] if seeing else []
    assert counts[0] > 30 and counts[-1] > counts[0] + 5


def at_rest(seconds: float, rotor: Callable[[int], float], tilt: Array) -> list[Observation]:
    force, ticks = so3_exp(tilt).T @ UP, range(0, round(seconds * HZ) + 1, IMU_TICKS)
    return [inertial(tick, np.zeros(3), force.copy(), rotor(tick)) for tick in ticks]


@pytest.mark.parametrize("shaken_mps2", [0.0, 0.2])
def test_roll_and_pitch_of_the_start_are_found_at_rest(shaken_mps2: float) -> None:
    """Gravity shows them also where rotors shake the vehicle too much for zero-velocity updates."""
    tilt = np.array([0.03, -0.02, 0.0])
    rig = dataclasses.replace(RIG, start_tilt_sigma_rad=0.05)
    flight = at_rest(1.0, lambda _: 0.0, tilt)
    for obs in flight[1::2]:
        obs.imu[0].specific_force[0] += shaken_mps2
    for obs in flight[2::2]:
        obs.imu[0].specific_force[0] -= shaken_mps2
    _, estimates = run(flight, rig=rig)
    assert estimates[-1].diagnostics["stationary"] == (shaken_mps2 == 0.0)
    found = estimates[-1].odom_from_body.rotation[2]
    np.testing.assert_allclose(found, so3_exp(tilt)[2], atol=1.5e-3)


def test_slow_rotors_mean_rest_before_the_first_flight_alone() -> None:
    """200 rad/s carry a quarter of the weight: on the ground before the first lift-off, but after
    it a descent may need no more."""
    still = np.zeros(3)
    _, before = run(at_rest(1.0, lambda _: 200.0, still))
    assert before[-1].diagnostics["stationary"] == 1.0
    _, after = run(at_rest(1.0, lambda tick: 420.0 if tick < 60 else 200.0, still))
    assert after[-1].diagnostics["stationary"] == 0.0
    _, landed = run(at_rest(1.0, lambda tick: 420.0 if tick < 60 else 80.0, still))
    assert landed[-1].diagnostics["stationary"] == 1.0


@pytest.mark.parametrize("sigma_s", [0.005, 0.0])
def test_the_offset_of_the_cameras_clock_is_estimated(sigma_s: float) -> None:
    """20 ms at up to 4 m/s are 8 cm without online calibration of the clock."""
    livo = Livo(RIG, LivoParams(camera_clock_sigma_s=sigma_s))
    estimates = [livo.update(obs) for obs in observations(RIG, 3000, swaying, 12)]
    late = [e for e in estimates if e.time_s > 2.5]
    worst = max(np.linalg.norm(e.world_from_body.translation - swaying(e.time_s)) for e in late)
    clock_ms = late[-1].diagnostics["calibration_clock_ms"]
    if sigma_s:
        assert clock_ms == pytest.approx(20.0, abs=1.0) and worst < 0.02
    else:
        assert clock_ms == 0.0 and worst > 0.05


def test_biases_and_level_are_estimated_on_the_ground() -> None:
    """Two seconds at rest with a biased IMU: the turn-on biases of 3 mrad/s and 30 mm/s^2 shrink to
    the limits set by noise and by the attitude prior, and gravity stays vertical."""
    gyro, specific = np.array([2e-3, -3e-3, 1e-3]), np.array([0.02, -0.01, 0.03])
    livo = Livo(RIG, LivoParams())
    for tick in range(0, 1201, IMU_TICKS):
        estimate = livo.update(inertial(tick, gyro, specific + [0.0, 0.0, GRAVITY_MPS2]))
    np.testing.assert_allclose(estimate.angular_velocity_body, 0.0, atol=2e-4)
    np.testing.assert_allclose(estimate.acceleration_odom, 0.0, atol=2e-3)
    # three times the standard deviation of the attitude on the pad
    np.testing.assert_allclose(estimate.odom_from_body.rotation, np.eye(3), atol=6e-4)


def test_returns_of_long_ago_are_not_extended(monkeypatch: pytest.MonkeyPatch) -> None:
    """The LIDAR drops out from the scan at 0.6 s on; that of 0.5 s is fresh for three periods."""
    asked: list[tuple[int, float | None]] = []

    def note(
        self: VisualFrontEnd, *args: Any, delay_s: float = 0.0, ground_m: float | None = None
    ) -> None:
        assert delay_s == 0.0  # the images lie on the ticks of the IMU
        asked.append((args[3], ground_m))

    monkeypatch.setattr(VisualFrontEnd, "new_keyframe", note)
    reading = RangefinderSample(tick=480, time_s=0.8, range_m=2.5)
    silent = [dataclasses.replace(o, scans=()) if o.tick > 350 else o for o in FLIGHT]
    fly([dataclasses.replace(o, rangefinder=(reading,) * (o.tick == 480)) for o in silent])
    assert [ground for tick, ground in asked if tick <= 480] == [None] * 8
    below = [ground for tick, ground in asked if tick > 480]
    level = position_at(0.8)[2] - 2.5 + RIG.nav.rangefinder.position_body_m[2]
    assert len(below) == 4 and below == pytest.approx([level] * 4, abs=0.02)


def test_an_image_is_given_the_ground_that_the_beam_met_then(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Ranges grow by a metre a second, 50 of them a second; images come 60 ms late."""
    spots: dict[int, np.ndarray | None] = {}
    update = VisualFrontEnd.update

    def note(self: VisualFrontEnd, eskf: Any, *args: Any, spot: np.ndarray | None) -> Any:
        spots[eskf.state.tick] = spot
        return update(self, eskf, *args, spot=spot)

    monkeypatch.setattr(VisualFrontEnd, "update", note)

    def reading(tick: int) -> RangefinderSample:
        return RangefinderSample(tick=tick, time_s=tick / HZ, range_m=2.0 + tick / HZ)

    fly(
        [
            dataclasses.replace(o, rangefinder=(reading(o.tick),) * (o.tick % 12 == 0))
            for o in FLIGHT
        ]
    )
    assert len(spots) > 3
    beam = np.array(RIG.nav.rangefinder.position_body_m)
    for tick, spot in spots.items():
        met = RIG.body_from_imu.inverse().apply(beam - [0.0, 0.0, 2.0 + tick / HZ])
        np.testing.assert_allclose(spot, met, atol=0.011)


@pytest.mark.parametrize(
    "change",
    [{"use_lidar": False}, {"use_vision": False}, {"loose": True}, {"use_closures": False},
     {"use_calibration": False}],
)  # fmt: skip
def test_parts_can_be_left_out(change: dict[str, bool]) -> None:
    livo = Livo(RIG, LivoParams(**change))
    assert livo.needs.camera_hz == (0 if change == {"use_vision": False} else 5)
    last = [livo.update(obs) for obs in FLIGHT][-1]
    error = last.world_from_body.translation - position_at(last.time_s)
    # over a plane the LIDAR holds height only
    assert np.abs(error[2] if change == {"use_vision": False} else error).max() < 0.05
