"""Scans that begin and end between two samples of the IMU."""

import dataclasses
from types import ModuleType

import numpy as np
import pytest

from touchdown.estimator.filtering.inertial_filter import InertialFilter
from touchdown.sim.api import GRAVITY_MPS2, LidarScan, Observation
from touchdown.sim.frames import Pose, rotation_from_yaw

from support import livo_flight, zou2024_flight
from support.livo_flight import HZ, IMU_TICKS, RIG, SCAN_TICKS, START_Z
from support.messages import make_scan

RATE, PUSH = 0.5, np.array([0.2, -0.1, 0.1])
"""rad/s about the vertical, and m/s^2"""


def imu_at(time_s: float) -> Pose:
    """World from IMU: turns and is pushed from rest."""
    start = RIG.world_from_body_start @ RIG.body_from_imu
    return Pose(rotation_from_yaw(RATE * time_s), start.translation + 0.5 * PUSH * time_s**2)


def sample(tick: int) -> Observation:
    """In the air, at the end of the mean over a step."""
    middle = rotation_from_yaw(RATE * (tick - 0.5 * IMU_TICKS) / HZ)
    force = middle.T @ (PUSH + [0.0, 0.0, GRAVITY_MPS2])
    return livo_flight.inertial(tick, np.array([0.0, 0.0, RATE]), force, 400.0)


def scan_of(targets: np.ndarray, end: int) -> LidarScan:
    """Of points in the world, one after the other, from the true poses."""
    start_s, offsets = (end - SCAN_TICKS) / HZ, np.linspace(0.0, SCAN_TICKS / HZ, len(targets))
    mount = RIG.body_from_imu.inverse() @ RIG.body_from_lidar
    eyes = [imu_at(start_s + t) @ mount for t in offsets]
    seen = [eye.inverse().apply(point) for eye, point in zip(eyes, targets, strict=True)]
    ranges = np.linalg.norm(seen, axis=1)
    return make_scan(end, np.array(seen) / ranges[:, None], ranges, offsets)


@pytest.mark.parametrize(("shift", "newest"), [(0, 75), (1, 75), (2, 75), (1, 72), (2, 72)])
def test_a_scan_between_two_samples_lies_where_it_was_measured(shift: int, newest: int) -> None:
    """``newest`` 72: the sample after the scan's end has not come."""
    targets = np.random.default_rng(0).uniform(-0.5, 0.5, (3000, 3)) + [0.0, 0.0, START_Z - 1.5]
    inertial = InertialFilter(RIG)
    for tick in range(IMU_TICKS, newest + 1, IMU_TICKS):
        inertial.take_imu(sample(tick))
    scan = scan_of(targets, 72 + shift)
    inertial.carry_to(scan.end_tick)
    placed = inertial.place_scan(scan)
    assert placed is not None and len(placed) == len(targets) and inertial.tick == 72
    np.testing.assert_allclose(inertial.eskf.state.pose.apply(placed.points), targets, atol=3e-6)
    track = inertial.track_of(scan)
    assert track is not None
    assert track.times_s[0] <= scan.start_time_s and track.times_s[-1] >= scan.end_time_s
    last = imu_at(track.times_s[-1]) @ RIG.body_from_imu.inverse()
    np.testing.assert_allclose(track.positions_odom[-1], last.translation, atol=5e-6)
    late = dataclasses.replace(scan, end_tick=scan.end_tick + 2 * IMU_TICKS)
    assert inertial.place_scan(late) is None


@pytest.mark.parametrize("flown", [livo_flight, zou2024_flight])
def test_an_estimator_flies_on_scans_between_two_samples(flown: ModuleType) -> None:
    """Stamped a tick later than in the plain flight: all are used, and no error is larger."""
    flight = [
        dataclasses.replace(
            obs, scans=tuple(flown.scan_ending_at(scan.end_tick + 1) for scan in obs.scans)
        )
        for obs in flown.FLIGHT
    ]
    plain, shifted = flown.clean(), flown.fly(flight)
    errors = [max(livo_flight.error(e) for e in estimates) for estimates in (plain, shifted)]
    assert errors[1] < errors[0] + 1e-3 < 0.01
    assert shifted[-1].diagnostics["skipped"] == plain[-1].diagnostics["skipped"]
    tracks = [sum(e.scan_track is not None for e in estimates) for estimates in (plain, shifted)]
    assert tracks[0] == tracks[1] > 5
