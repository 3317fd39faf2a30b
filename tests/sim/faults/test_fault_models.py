"""Faults of clocks, receivers, wind, rotors and mounts, against known answers."""

import math
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from touchdown.scenes.api import Scene
from touchdown.sim import api
from touchdown.sim.faults.disturbances import Disturbances, gust_speed
from touchdown.sim.frames import Pose, so3_log
from touchdown.sim.typing import Array
from touchdown.sim.world import MujocoWorld

from support.fault_support import HZ, STEP, delivered
from support.lidar_support import DOWN
from support.places import scene_of
from support.worlds import load_ideal_config as load_config


def test_a_skewed_clock_shifts_stamps_by_exactly_so_many_seconds() -> None:
    clean, skewed = dict(delivered()), dict(delivered("lidar_skew@1.06", skew_s=0.02))
    assert list(skewed) == list(clean)  # messages arrive as ever
    for tick, scan in skewed.items():
        shift = 12 if tick >= 636 else 0  # 0.02 s at 600 Hz
        assert scan.start_tick == clean[tick].start_tick + shift
        assert scan.end_tick == clean[tick].end_tick + shift
        assert scan.end_time_s == pytest.approx(scan.end_tick / HZ, abs=1e-12)
        assert scan.start_time_s == pytest.approx(scan.start_tick / HZ, abs=1e-12)
        np.testing.assert_array_equal(scan.ranges, clean[tick].ranges)
    (scan, *_) = dict(delivered("lidar_skew@0", skew_s=0.002)).values()
    assert scan.end_tick - (scan.end_time_s * HZ) == pytest.approx(-0.2)  # beside its tick
    late = dict(delivered("camera_skew@1.06+0.2", stream="images", skew_s=-0.05))
    assert [late[t].tick - t + 36 for t in (576, 636, 696, 756)] == [0, -30, -30, 0]
    assert dict(delivered("gps_skew@0", stream="gps", skew_s=0.1))[636].tick == 660
    assert dict(delivered("camera_skew@0"))[636].end_tick == 600  # of other sensors: nothing


def test_a_clock_that_runs_fast_is_off_by_more_and_more() -> None:
    # 10 000 millionths of the 2 s from tick 300 to 1500: 12 ticks; of the first 0.5 s: 3
    drift = dict(delivered("lidar_skew@0.5", skew_s=0.0, skew_ppm=1e4))
    assert drift[636].end_tick - 600 == 3 and drift[1476].end_tick - 1440 == 11


def test_a_spoofed_receiver_is_drawn_away_steadily() -> None:
    spoofed = dict(delivered("gps_spoof@1", stream="gps", gps_spoof_mps=(0.6, -0.3, 0.0)))
    for tick, message in spoofed.items():
        since = max(0.0, message.time_s - 1.0)
        if tick < 600:
            np.testing.assert_array_equal(message.velocity_world, 0.0)
        else:
            expected = [message.tick / HZ + 0.6 * since, -0.3 * since, 0.0]
            np.testing.assert_allclose(message.position_world, expected, atol=1e-12)
            np.testing.assert_allclose(message.velocity_world, [0.6, -0.3, 0.0])


ALONG = np.array([0.6, 0.8, 0.0])


def blown(*events: str, seconds: float = 20.0, **faults: Any) -> Array:
    """(N, 3) m/s that gusts add at every tick."""
    params = api.FaultParams(events=events, gust_kmh=30.0, gust_rise_s=1.5, **faults)
    disturbances, found = Disturbances(params, HZ, 12.0, 0), []
    for tick in range(round(seconds * HZ)):
        found.append(np.zeros(3))
        disturbances.add_gust(tick, ALONG, found[-1])
    return np.array(found)


def test_the_shape_of_a_gust() -> None:
    """V = Vm / 2 (1 - cos): its peak is Vm after the rise, its integral Vm times the rise."""
    assert [gust_speed(p, 4.0) for p in (0.0, 0.5, 1.0, 2.0)] == pytest.approx([0, 2, 4, 0])
    single = blown("gust@2*1")
    speed = single @ ALONG
    assert speed.max() == pytest.approx(5.0) and speed.argmax() == 3.5 * HZ  # 30 - 12 km/h
    np.testing.assert_allclose(single, speed[:, None] * ALONG, atol=1e-12)
    assert speed.sum() / HZ == pytest.approx(5.0 * 1.5, rel=1e-6)
    assert not speed[: 2 * HZ + 1].any() and not speed[5 * HZ :].any()
    row = blown("gust@2+10") @ ALONG  # three whole gusts of 3 s
    assert row.sum() / HZ == pytest.approx(3 * 7.5, rel=1e-6) and not row[11 * HZ :].any()
    assert blown("gust@2*3") @ ALONG == pytest.approx(row)
    endless = blown("gust@2") @ ALONG  # six whole gusts until 20 s
    assert endless.sum() / HZ == pytest.approx(6 * 7.5, rel=1e-6)
    across = blown("gust@2*1", gust_direction_deg=90.0)
    assert across[:, 1].max() == pytest.approx(5.0) and not across[:, [0, 2]].round(12).any()


def test_a_miscalibrated_mount_is_off_by_the_stated_amounts() -> None:
    nominal = Pose(DOWN.rotation, np.array([0.1, 0.0, -0.05]))

    def off(seed: int, tick: int) -> tuple[float, float]:
        true = Disturbances(
            api.FaultParams(events=("miscalibration@1",)), HZ, 0.0, seed
        ).lidar_mount(tick, nominal)
        turn = so3_log(nominal.rotation.T @ true.rotation)
        shift = true.translation - nominal.translation
        return math.degrees(float(np.linalg.norm(turn))), float(np.linalg.norm(shift))

    assert off(0, 599) == (0.0, 0.0)
    assert off(0, 600) == pytest.approx((1.0, 0.02))
    assert off(5, 10**6) == pytest.approx((1.0, 0.02))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scene_of(
        '<mujoco><worldbody><geom name="lawn" type="plane" size="60 60 0.1" rgba="0.3 0.5 0.2 1"/>'
        '<geom name="wall" type="box" size="1 4 2" pos="6 0 2"/></worldbody></mujoco>'
    )


def params_with(faults: api.FaultParams) -> api.WorldParams:
    return api.WorldParams(
        sim=api.SimParams(threads=1), camera=api.CameraParams(width=64, height=36),
        imu=load_config().imu, faults=faults,
    )  # fmt: skip


def half_seconds_in_flight(scene: Scene, *events: str) -> Iterator[bytes]:
    """All that is sensed and true of each half second in the air, as bytes."""
    needs = api.SensorNeeds(camera_hz=15, lidar=True, gps=True)
    with closing(
        MujocoWorld(scene, params_with(api.FaultParams(events=events)), 3, needs)
    ) as world:
        world.start_in_air(np.array([0.0, 0.0, 12.0]), 0.3)
        model = world.rig.vehicle
        hover = math.sqrt(model.mass_kg * 9.81 / (4.0 * model.thrust_coefficient))
        for _ in range(3):
            seen = []
            for _ in range(HZ // STEP // 2):
                obs = world.step(api.Command(rotor_speed_radps=np.full(4, hover)))
                seen += [m.ranges.tobytes() + m.intensity.tobytes() for m in obs.scans]
                seen += [m.rgb.tobytes() for m in obs.images]
                seen += [m.position_world.tobytes() for m in obs.gps]
                seen += [m.specific_force.tobytes() for m in obs.imu]
            yield b"".join([*seen, world.truth().world_from_body.translation.tobytes()])


ALL_LATER = tuple(
    f"{kind}@0.9"
    for kind in ("fog", "rain", "lens_dirt", "motor_loss", "gust", "miscalibration", "gps_spoof")
)


def test_faults_change_nothing_before_they_begin(scene: Scene) -> None:
    clean, faulty = (
        list(half_seconds_in_flight(scene)),
        list(half_seconds_in_flight(scene, *ALL_LATER)),
    )
    assert faulty[0] == clean[0]
    assert faulty[2] != clean[2]
    assert list(half_seconds_in_flight(scene, *ALL_LATER)) == faulty
    assert list(half_seconds_in_flight(scene, "fog@99", "gust@99", "lens_dirt@99")) == clean


def test_effects_of_faults_in_the_world_are_counted(scene: Scene) -> None:
    """Of delivered messages: scans end at 0.1, 0.2 ... s and arrive 0.06 s later."""
    events = ("fog@0.5", "rain@5", "lens_dirt@0.3+0.2", "miscalibration@0.6", "gust@0.1+3")
    needs = api.SensorNeeds(camera_hz=10, lidar=True)
    found = []
    for threads in (1, 2):
        params = replace(
            params_with(api.FaultParams(events=events)), sim=api.SimParams(threads=threads)
        )
        world = MujocoWorld(scene, params, 3, needs)
        world.start_in_air(np.array([0.0, 0.0, 12.0]), 0.3)
        for _ in range(HZ // STEP):
            world.step(api.Command(rotor_speed_radps=np.full(4, 300.0)))
        world.close()
        found.append({entry["fault"]: entry for entry in world.record().faults})
    assert found[0] == found[1]  # whatever is still being made when the flight ends
    fog, dirt, mount = (found[0][events[i]] for i in (0, 2, 3))
    assert fog["came"] == fog["messages"] == {"scans": 5, "images": 5}
    assert 0.5 < fog["returns_changed"] <= 1.0 and 1.0 < fog["grey_change"] < 100.0
    assert dirt["messages"] == {"images": 2} and dirt["grey_change"] > 0.1
    assert mount["messages"] == {"scans": 4} and mount["rotation_deg"] == pytest.approx(1.0)
    assert found[0]["rain@5"]["messages"] == {"scans": 0, "images": 0}
    gust = found[0]["gust@0.1+3"]
    assert gust["acted_s"] == pytest.approx(179 * STEP / HZ)  # 0.105 to 0.995 s
    assert gust["gust_mps"] == pytest.approx(gust_speed(0.895 / 1.5, 5.0), rel=1e-3)


def test_the_time_of_a_weak_motor_is_counted() -> None:
    disturbances = Disturbances(api.FaultParams(events=("motor_loss@1+1",)), HZ, 12.0, 0)
    weak = [t for t in range(0, 3 * HZ, 3) if disturbances.rotor_speed_fraction(t) is not None]
    assert (weak[0], weak[-1]) == (600, 1197)
    (found,) = disturbances.summary(0.005)
    assert found == {"fault": "motor_loss@1+1", "acted_s": pytest.approx(1.0), "began_s": 1.0}
