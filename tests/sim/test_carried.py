"""A vehicle that is carried along measured poses: its motion, its IMU, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from touchdown.scenes.compose import load_scene
from touchdown.sim.api import GRAVITY_MPS2, Command, SensorNeeds, WorldParams
from touchdown.sim.carried import EASE_S, REST_S, CarriedWorld, FlownPath
from touchdown.sim.typing import Array

from support.command import Says
from support.places import scene_of

RATE = 1.2
"""rad/s of the circle"""


def circle(axes: Array | None = None) -> tuple[Array, Array, Array]:
    """A circle of 3 m about a rising centre, banked as a vehicle without drag flies it, nose along
    the way; ``axes`` (3, 3): body axes as somebody else has them."""
    times = np.arange(0.0, 12.0, 0.01)
    angle = RATE * times
    radial = np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])
    ahead = np.column_stack([-np.sin(angle), np.cos(angle), 0.0 * angle])
    positions = 3.0 * radial + np.array([0.0, 0.0, 0.1]) * times[:, None]
    up = -3.0 * RATE**2 * radial + [0.0, 0.0, GRAVITY_MPS2]
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    left = np.cross(up, ahead)
    rotation = Rotation.from_matrix(np.stack([ahead, left, up], axis=-1))
    if axes is not None:
        rotation = rotation * Rotation.from_matrix(axes)
    return times + 100.0, positions, rotation.as_quat(scalar_first=True)


def test_the_motion_is_that_of_the_poses_after_a_gentle_start() -> None:
    path = FlownPath(*circle())
    assert path.duration_s == pytest.approx(REST_S + 0.5 * EASE_S + 11.99)
    rest, later = path.motion(np.array([0.0, 0.9])), path.motion(np.array([8.0, 8.01]))
    np.testing.assert_allclose(rest.position, 0.0, atol=1e-9)
    np.testing.assert_allclose(rest.velocity, 0.0)
    speed = np.linalg.norm(later.velocity[0])
    assert speed == pytest.approx(np.hypot(3.0 * RATE, 0.1), rel=1e-3)
    steps = (later.position[1] - later.position[0]) / 0.01
    np.testing.assert_allclose(steps, later.velocity.mean(axis=0), atol=1e-3)
    between = Rotation.from_quat(later.quat, scalar_first=True)
    turned = (between[0].inv() * between[1]).as_rotvec() / 0.01
    np.testing.assert_allclose(turned, later.rate.mean(axis=0), atol=1e-3)
    assert np.linalg.norm(later.rate[0]) == pytest.approx(RATE, rel=1e-3)
    assert later.thrust[0] == pytest.approx(np.hypot(3.0 * RATE**2, GRAVITY_MPS2), rel=1e-3)
    # the first pose heads along x: the circle lies to its left
    assert (
        later.position[0] @ np.array([1.0, 0.0, 0.0]) < 3.01
        and path.motion(np.array([REST_S + EASE_S])).position[0, 1] > 0.0
    )


def test_other_body_axes_are_turned_to_the_thrust() -> None:
    """Axes of a camera: z ahead, y down. The thrust is along -y, and the body's z along it."""
    camera = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    own, other = FlownPath(*circle()), FlownPath(*circle(camera))
    at = np.array([6.0])
    up = [Rotation.from_quat(path.motion(at).quat[0], scalar_first=True).as_matrix()[:, 2]
          for path in (own, other)]  # fmt: skip
    assert up[0][2] == pytest.approx(up[1][2], abs=1e-3)
    np.testing.assert_allclose(own.motion(at).thrust, other.motion(at).thrust, rtol=1e-6)


@pytest.mark.parametrize(("rows", "words"), [
    (range(10), "has 10 poses"),
    ([*range(200), *range(300, 1200)], "no pose between 1.99 and 3.00 s"),
])  # fmt: skip
def test_a_path_of_too_little_is_refused(rows: list[int], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        FlownPath(*(part[list(rows)] for part in circle()))


def _carried(height_m: float | None = 5.0) -> CarriedWorld:
    return CarriedWorld(load_scene("flat", 0), WorldParams(), 3, FlownPath(*circle()), height_m)


def test_the_vehicle_is_where_the_path_is_and_its_imu_feels_it() -> None:
    world = _carried()
    world.require(SensorNeeds())
    world.reset()
    start = world.truth().world_from_body.translation.copy()
    assert start[2] == pytest.approx(5.0 + world.rig.vehicle.leg_height_m, abs=0.02)
    assert not world.truth().rotor_speed_radps.any()
    np.testing.assert_array_equal(world.rig.world_from_body_start.translation, start)
    command = Command(rotor_speed_radps=np.zeros(4))
    gyro, force, seconds = [], [], 0.0
    while seconds < 8.0:
        obs = world.step(command)
        seconds = obs.time_s
        if seconds > 6.0:
            gyro += [sample.angular_velocity for sample in obs.imu]
            force += [sample.specific_force for sample in obs.imu]
    truth = world.truth()
    expected = FlownPath(*circle()).motion(np.array([truth.time_s]))
    heading = world._scene.takeoff_yaw
    turn = Rotation.from_euler("z", heading)
    np.testing.assert_allclose(
        truth.world_from_body.translation - start, turn.apply(expected.position[0]), atol=1e-6
    )
    assert np.linalg.norm(np.mean(gyro, axis=0)) == pytest.approx(RATE, abs=0.02)
    mean = np.mean(force, axis=0)
    assert mean[2] == pytest.approx(np.hypot(3.0 * RATE**2, GRAVITY_MPS2), abs=0.1)
    square = float(np.mean(truth.rotor_speed_radps**2)) * 4.0 * world.rig.vehicle.thrust_coefficient
    force_n = world.rig.vehicle.mass_kg * np.hypot(3.0 * RATE**2, GRAVITY_MPS2)
    assert square == pytest.approx(force_n, rel=0.02)
    world.close()


def test_a_trajectory_through_something_is_one_line(tmp_path: Path, says: Says) -> None:
    times, positions, quats = circle()
    file = tmp_path / "flown.tum"

    def write(scale: float) -> None:
        rows = np.column_stack([times, scale * positions, quats[:, [1, 2, 3, 0]]])
        np.savetxt(file, rows)

    write(1.0)
    out = ["--out", str(tmp_path / "run")]
    fly = ["fly", "flat", "--trajectory", str(file), *out]
    write(100.0)
    assert "leaves 'flat' after" in says(2, *fly).err
    write(1.0)
    land = ["land", "flat", "--set", f"survey.trajectory={file}", *out]
    assert "use `touchdown fly`" in says(2, *land).err
    assert (
        "does not exist" in says(2, "fly", "flat", "--trajectory", str(tmp_path / "no"), *out).err
    )
    file.write_text("1 2 3\n")
    assert "line 1 is not eight numbers" in says(2, *fly).err
    assert (
        "--trajectory does not go with --replay"
        in says(2, "fly", "--replay", str(tmp_path), "--trajectory", str(file)).err
    )


def test_a_path_through_something_is_refused() -> None:
    """The circle's far side lies 6 m to the left of the take-off spot."""
    xml = """<mujoco><worldbody><geom name="lawn" type="plane" size="60 60 1"/>
      <geom name="building" type="box" size="1 1 4" pos="0 6 4"/>
      <site name="takeoff" pos="0 0 0"/></worldbody></mujoco>"""
    scene, path = scene_of(xml), FlownPath(*circle())
    with pytest.raises(ValueError, match=r"m into something after .*trajectory_lowest_m"):
        CarriedWorld(scene, WorldParams(), 3, path)
    CarriedWorld(scene, WorldParams(), 3, path, height_m=9.0).close()
