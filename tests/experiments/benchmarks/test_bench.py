"""The bare computation equals that of the flight, and the parts of the overhead add up."""

import threading
from collections.abc import Iterator
from pathlib import Path

import numba
import numpy as np
import pytest

from touchdown.experiments.benchmarks import loop_overhead
from touchdown.experiments.benchmarks.bare_world import BareWorld, _world_rays
from touchdown.experiments.benchmarks.jit_warmup import compiled_before
from touchdown.experiments.flight.wiring import build_scene
from touchdown.scenes.api import Scene
from touchdown.sim.api import CameraParams, LidarScan, Truth, WorldParams
from touchdown.sim.frames import Pose, rotation_from_yaw

from support.worlds import load_ideal_config as load_config

LAWN = """<mujoco><worldbody>
<light pos="0 0 50" dir="0 0 -1"/>
<geom name="lawn" type="plane" size="60 60 1" rgba="0.2 0.6 0.2 1"/>
<geom name="road_box" type="box" pos="3 2 0.5" size="1 1 0.5" rgba="0.8 0.2 0.2 1"/>
</worldbody></mujoco>"""
SHORT_FLIGHT = (
    "sim.threads=1", "landing.survey_only=true", "survey.height_m=5.0", "survey.legs=1",
    "survey.leg_length_m=6.0", "survey.duration_s=5.0",
)  # fmt: skip


@pytest.fixture(scope="module")
def lawn_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("lawn") / "lawn.xml"
    path.write_text(LAWN)
    return path


@pytest.fixture(scope="module")
def lawn(lawn_file: Path) -> Scene:
    return build_scene(load_config(scene=str(lawn_file), as_is=True))


@pytest.fixture(scope="module")
def bare(lawn: Scene) -> Iterator[BareWorld]:
    world = BareWorld(lawn, WorldParams(camera=CameraParams(noise_sigma=0.0)), 0)
    yield world
    world.close()


def truth_at(height_m: float, *, rotor_speed: float = 0.0) -> Truth:
    zero = np.zeros(3)
    return Truth(
        tick=60, time_s=0.1, world_from_body=Pose(np.eye(3), np.array([0.0, 0.0, height_m])),
        velocity_world=np.array([1.0, 0.0, 0.0]), acceleration_world=zero,
        angular_velocity_body=zero, wind_world=zero, rotor_speed_radps=np.full(4, rotor_speed),
        contacts=(), peak_contact_accel=0.0, energy_used_j=0.0,
    )  # fmt: skip


def test_bare_rays_start_at_the_lidar_of_their_instant() -> None:
    down = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    body_from_lidar = Pose(down, np.array([0.1, 0.0, -0.2]))
    scan = LidarScan(
        start_tick=0, end_tick=60, start_time_s=0.0, end_time_s=0.1,
        directions=np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8]], np.float32),
        ranges=np.ones(2, np.float32), time_offsets=np.array([0.01, 0.1], np.float32),
        intensity=np.ones(2, np.uint8),
    )  # fmt: skip
    poses = [
        Pose(np.eye(3), np.array([0.0, 0.0, 30.0])),
        Pose(rotation_from_yaw(0.5 * np.pi), np.array([5.0, 0.0, 30.0])),
        Pose(np.eye(3), np.array([9.0, 0.0, 30.0])),
    ]
    rays = _world_rays(scan, poses, body_from_lidar)
    assert rays.dtype == np.float32
    np.testing.assert_allclose(rays[0], [0.1, 0.0, 29.8, 0.0, 0.0, -1.0], atol=1e-6)
    # The second pulse leaves in the second half: turned to the left by 90 degrees, LIDAR x, which
    # is body y, points to world -x.
    np.testing.assert_allclose(rays[1], [5.0, 0.1, 29.8, -0.6, 0.0, -0.8], atol=1e-6)


def test_bare_pixels_are_the_camera_s(bare: BareWorld) -> None:
    truth = truth_at(12.0)
    assert bare.pixels(truth) >= 0.0
    drawn = bare._eye._pixels[::-1]
    image = bare._camera.render(bare._snapshot(truth), 0)
    assert np.ptp(image.reshape(-1, 3).astype(int), axis=0).max() > 50  # the box is in view
    np.testing.assert_array_equal(drawn, image)


def test_ratio_leaves_estimator_and_lander_out_and_the_excess_adds_up() -> None:
    sums = loop_overhead._Sums()
    for name, ms in {"physics": 1.0, "rays": 4.0, "pixels": 5.0}.items():
        sums.add(name, 1e-3 * ms)
        sums.add(name, 1e-3 * ms)
    sums.add("lidar_sensor", 6e-3)
    sums.add("camera_sensor", 5.5e-3)
    loop = {"world": 13.0, "estimator": 50.0, "lander": 7.0, "mapper": 1.5, "rest": 0.5}
    found = loop_overhead._compare(loop, sums)
    assert found["ratio"] == pytest.approx(1.5) and found["bare_ms"]["all"] == pytest.approx(10.0)
    assert found["excess_ms"] == pytest.approx(
        {
            "lidar_beyond_rays": 2.0, "camera_beyond_pixels": 0.5, "world_beyond_physics": 0.5,
            "mapper": 1.5, "rest": 0.5,
        }
    )  # fmt: skip
    assert sum(found["excess_ms"].values()) == pytest.approx(15.0 - 10.0)


def test_overhead_of_a_short_flight(lawn_file: Path, tmp_path: Path) -> None:
    config = load_config(None, SHORT_FLIGHT, scene=str(lawn_file), estimator="oracle", record=True)
    figures = loop_overhead.measure_overhead(config, tmp_path / "run")
    assert figures["outcome"] == "COMPLETED"
    assert (tmp_path / "run" / "flight.rrd").stat().st_size > 0
    bare_ms, loop_ms = figures["bare_ms"], figures["loop_ms"]
    assert all(bare_ms[name] > 0.0 for name in ("physics", "rays", "pixels"))
    assert figures["ratio"] == pytest.approx(loop_ms["all"] / bare_ms["all"])
    excess = sum(figures["excess_ms"].values())
    assert excess == pytest.approx(loop_ms["all"] - bare_ms["all"])
    counted = {name for name in loop_ms if name not in ("all", *loop_overhead.NOT_OVERHEAD)}
    assert loop_ms["all"] == pytest.approx(sum(loop_ms[name] for name in counted))


def test_a_measurement_during_compilation_is_repeated() -> None:
    @numba.njit
    def kernel(x: float) -> float:
        return 2.0 * x

    calls: list[float] = []
    cleared: list[bool] = []

    def measure() -> int:
        worker = threading.Thread(target=lambda: calls.append(kernel(1.0)))
        worker.start()
        worker.join()
        return len(calls)

    assert compiled_before(measure, again=lambda: cleared.append(True)) == 2 and cleared == [True]
    assert compiled_before(measure) == 3  # all compiled
