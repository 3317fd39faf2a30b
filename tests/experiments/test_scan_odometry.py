"""`examples/scan_odometry.py`: poses of another program are followed until the IMU contradicts."""

import dataclasses
import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchdown.sim.api import GRAVITY_MPS2, LidarScan
from touchdown.sim.frames import Pose, rotation_from_yaw, so3_exp

from support.livo_flight import HZ, IMU_TICKS, inertial, make_rig, scan_ending_at

FRAME = Pose(rotation_from_yaw(1.2), np.array([5.0, 6.0, 7.0]))
"""own_from_world of the odometry"""
REST, TRUE_S, LAST = 240, 0.9, 1200


def wrong_after(fault: str, late_s: float) -> Pose:
    """How far the odometry has left the world ``late_s`` after it was true."""
    if fault == "turns":
        return Pose(rotation_from_yaw(late_s), np.zeros(3))
    return Pose(np.eye(3), np.array([3.0 * late_s * (fault == "slides"), 0.0, 0.0]))


@pytest.mark.parametrize(
    ("fault", "event"), [("", ""), ("slides", "slip"), ("turns", "turn by"), ("ends", "no pose")]
)
def test_poses_are_followed_until_the_imu_contradicts_them(
    fault: str, event: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A climb of 1.6 s with an accelerometer that is off; the odometry is true for half a second.
    Then it slides by 3 m/s, turns by a radian a second or ends."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2]))
    base = importlib.import_module("examples.scan_odometry")
    monkeypatch.setattr(base, "SILENT_S", 0.4)
    rig = dataclasses.replace(make_rig(), body_from_imu=Pose.identity())
    pose, velocity, truth = rig.world_from_body_start, np.zeros(3), {}
    heard = []

    class Told(base.ScanOdometry):  # type: ignore[misc, name-defined]
        def begin(self, level_from_imu: Pose, level_from_lidar: Pose) -> None:
            turned = level_from_lidar.rotation.T @ rig.body_from_lidar.rotation
            assert np.abs(turned - np.eye(3)).max() < 0.1

        def register(self, scan: LidarScan, samples: list[Any]) -> Any:
            heard.extend(samples)
            late_s = max(scan.end_time_s - TRUE_S, 0.0) if fault else 0.0
            if fault == "ends" and late_s:
                return None
            true = truth[scan.end_tick] @ self.level_from_body.inverse()
            return base.Seen(scan.end_time_s, FRAME @ wrong_after(fault, late_s) @ true)

    estimator, events = Told({"start_m": 0.01}, rig), []
    for tick in range(IMU_TICKS, LAST + 1, IMU_TICKS):
        flying, step = float(tick > REST), IMU_TICKS / HZ
        push, rate = flying * np.array([1.5, -0.8, 0.5]), flying * np.array([0.1, -0.1, 0.4])
        force = pose.rotation.T @ (push + [0.0, 0.0, GRAVITY_MPS2]) + [0.0, 0.0, 0.1]
        velocity = velocity + step * push
        pose = Pose(pose.rotation @ so3_exp(step * rate), pose.translation + step * velocity)
        truth[tick] = pose
        scans = (scan_ending_at(tick - 60),) if tick % 60 == 0 and tick > REST else ()
        given = inertial(tick, rate + 0.01, force, 400.0 * flying, scans=scans)
        estimate = estimator.update(given)
        events += estimate.events
    wrong = np.linalg.norm(estimate.odom_from_body.translation - pose.translation)
    sigma = np.sqrt(estimate.position_covariance[0, 0])
    assert estimate.healthy is not bool(fault) and len(events) == bool(fault)
    assert all(event in text for text in events)
    assert wrong < (3.0 * sigma if fault else 0.05) and sigma < 4.0
    assert np.linalg.norm(estimate.velocity_odom - velocity) < 0.3
    times = [time_s for time_s, *_ in heard]
    assert len(times) > 80 and np.ptp(np.diff(times)) < 1e-9
    biases = np.mean([rates for _, rates, _ in heard], axis=0) - [0.1, -0.1, 0.4]
    assert np.abs(biases).max() < 0.06
