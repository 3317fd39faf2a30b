"""The airframe's MJCF, its rotors and its contact with the ground."""

import mujoco
import numpy as np
import pytest

from touchdown.scenes.api import Scene
from touchdown.scenes.compose import VEHICLE_XML
from touchdown.sim.airframe.battery import DRIVE_EFFICIENCY, Battery, PowerSystem
from touchdown.sim.airframe.physics import prepare_physics, settle_on_ground
from touchdown.sim.airframe.rotors import Rotors, ground_effect
from touchdown.sim.airframe.vehicle import rotor_geometry, sensor_mounts, vehicle_model
from touchdown.sim.api import AIR_DENSITY_KGPM3, GRAVITY_MPS2, VehicleModel
from touchdown.sim.frames import matrix_from_quat_wxyz, rotation_from_yaw

from support.places import scene_of

TICK_HZ = 600
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
STILL = np.zeros(3)
HIGH = float("inf")

FLAT = """<mujoco><worldbody>
  <geom name="lawn_floor" type="plane" size="50 50 0.1"/><site name="takeoff" pos="1 2 0"/>
</worldbody></mujoco>"""
ROUGH = """<mujoco><asset>
  <hfield name="rough" nrow="41" ncol="41" size="4 4 0.2 0.5" elevation="{}"/>
</asset><worldbody>
  <geom name="lawn_floor" type="hfield" hfield="rough"/><site name="takeoff" pos="0.1 0.2 1"/>
</worldbody></mujoco>"""


@pytest.fixture(scope="module")
def alone() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(VEHICLE_XML))


@pytest.fixture(scope="module")
def vehicle(alone: mujoco.MjModel) -> VehicleModel:
    return vehicle_model(alone, prefix="")


def _scene(xml: str) -> Scene:
    scene = scene_of(xml)
    prepare_physics(scene.model, TICK_HZ)
    return scene


def _hover_speed(vehicle: VehicleModel) -> float:
    return float(np.sqrt(vehicle.mass_kg * GRAVITY_MPS2 / (4.0 * vehicle.thrust_coefficient)))


def _spinning(alone: mujoco.MjModel, vehicle: VehicleModel, speed: float) -> Rotors:
    rotors = Rotors(vehicle, rotor_geometry(alone, prefix=""), tick_s=1.0 / TICK_HZ)
    rotors.speeds[:] = speed
    rotors.demand(np.full(4, speed))
    return rotors


def test_mjcf_cameras_match_their_sites(alone: mujoco.MjModel) -> None:
    mounts = sensor_mounts(alone, prefix="")
    for name, pose in (("camera", mounts.camera), ("camera_right", mounts.camera_right)):
        camera = alone.camera(name)
        rotation = matrix_from_quat_wxyz(camera.quat)
        np.testing.assert_allclose(rotation, pose.rotation @ np.diag([1.0, -1.0, -1.0]), atol=1e-12)
        np.testing.assert_allclose(camera.pos, pose.translation)
        focal, sensor = alone.cam_intrinsic[camera.id, :2], alone.cam_sensorsize[camera.id]
        field_deg = np.degrees(2.0 * np.arctan(sensor / (2.0 * focal)))
        np.testing.assert_allclose(field_deg, [69.0, 42.0], atol=1e-3)


@pytest.mark.parametrize(
    ("sensor", "field_deg"),
    [("lidar", (81.7, 25.1)), ("camera", (69.0, 42.0)), ("camera_right", (69.0, 42.0))],
)
def test_nothing_of_the_vehicle_is_in_view(
    alone: mujoco.MjModel, sensor: str, field_deg: tuple[float, float]
) -> None:
    """Rays over the whole field of view, from the sensor's front, meet no part of the vehicle."""
    data = mujoco.MjData(alone)
    mujoco.mj_forward(alone, data)
    pose = getattr(sensor_mounts(alone, prefix=""), sensor)
    hit = np.zeros(1, dtype=np.int32)
    x, y = (np.tan(np.radians(np.linspace(-f / 2, f / 2, 41))) for f in field_deg)
    for direction in np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2):
        ray = pose.rotation @ np.append(direction, 1.0)
        start = pose.translation + 1e-4 * pose.rotation[:, 2]
        assert mujoco.mj_ray(alone, data, start, ray, None, True, -1, hit) < 0.0


def test_a_missing_part_is_named() -> None:
    empty = mujoco.MjModel.from_xml_string("<mujoco/>")
    with pytest.raises(ValueError, match=r"'vehicle/quadrotor' is missing"):
        vehicle_model(empty)
    bare = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body name="vehicle/quadrotor"><geom size="1"/></body></worldbody>'
        "</mujoco>"
    )
    with pytest.raises(ValueError, match=r"no site 'vehicle/rotor_0'"):
        vehicle_model(bare)


@pytest.mark.parametrize("rotor", range(4))
def test_one_rotors_wrench_matches_the_vehicle_model(
    alone: mujoco.MjModel, vehicle: VehicleModel, rotor: int
) -> None:
    rotors = _spinning(alone, vehicle, 0.0)
    rotors.speeds[rotor] = 300.0
    rotors.demand(np.where(np.arange(4) == rotor, 300.0, 0.0))
    x, y = vehicle.rotor_xy_m[rotor]
    thrust = vehicle.thrust_coefficient * 300.0**2
    yaw = vehicle.rotor_spin[rotor] * vehicle.torque_coefficient * 300.0**2
    expected = [0.0, 0.0, thrust, y * thrust, -x * thrust, yaw]
    np.testing.assert_allclose(rotors.step(LEVEL, STILL, STILL, STILL, HIGH), expected, atol=1e-9)


def test_motor_reaches_63_percent_at_its_time_constant(
    alone: mujoco.MjModel, vehicle: VehicleModel
) -> None:
    rotors = _spinning(alone, vehicle, 100.0)
    rotors.demand(np.full(4, 500.0))
    for _ in range(round(vehicle.motor_time_constant_s * TICK_HZ)):
        rotors.step(LEVEL, STILL, STILL, STILL, HIGH)
    np.testing.assert_allclose(rotors.speeds, 100.0 + 400.0 * (1.0 - np.exp(-1.0)), rtol=1e-12)


def test_demands_saturate_and_zero_stops(alone: mujoco.MjModel, vehicle: VehicleModel) -> None:
    rotors = _spinning(alone, vehicle, 200.0)
    rotors.demand(np.array([0.0, 1.0, 300.0, 9e9]))
    for _ in range(600):
        rotors.step(LEVEL, STILL, STILL, STILL, HIGH)
    expected = [0.0, vehicle.rotor_speed_min, 300.0, vehicle.rotor_speed_max]
    np.testing.assert_allclose(rotors.speeds, expected, atol=1e-6)
    with pytest.raises(ValueError, match=r"4 finite rotor speeds"):
        rotors.demand(np.array([1.0, 2.0, np.nan, 3.0]))


def test_rotor_drag_opposes_the_air_in_the_rotor_plane(
    alone: mujoco.MjModel, vehicle: VehicleModel
) -> None:
    rotors = _spinning(alone, vehicle, _hover_speed(vehicle))
    wind = np.array([2.0, -1.0, 0.0])
    force = rotors.step(LEVEL, STILL, STILL, wind, HIGH)[:3].copy()
    np.testing.assert_allclose(force[:2], vehicle.linear_drag * wind[:2], rtol=1e-9)
    moving = rotors.step(LEVEL, -wind, STILL, STILL, HIGH)[:3]
    np.testing.assert_allclose(force, moving)


def test_wrench_turns_with_the_body(alone: mujoco.MjModel, vehicle: VehicleModel) -> None:
    turn = rotation_from_yaw(0.7)
    quat = np.array([np.cos(0.35), 0.0, 0.0, np.sin(0.35)])
    velocity, rates = np.array([1.0, 2.0, -0.5]), np.array([0.3, -0.2, 0.1])
    rotors = _spinning(alone, vehicle, 350.0)
    level = rotors.step(LEVEL, velocity, rates, STILL, 1.0).copy()
    turned = rotors.step(quat, turn @ velocity, rates, STILL, 1.0)
    np.testing.assert_allclose(turned, np.concatenate([turn @ level[:3], turn @ level[3:]]))


def test_climbing_costs_thrust(alone: mujoco.MjModel, vehicle: VehicleModel) -> None:
    rotors = _spinning(alone, vehicle, _hover_speed(vehicle))
    thrusts = [
        rotors.step(LEVEL, np.array([0, 0, vz]), STILL, STILL, HIGH)[2] for vz in (-1.0, 0.0, 1.0)
    ]
    assert thrusts[0] > thrusts[1] > thrusts[2]
    geometry = rotor_geometry(alone, prefix="")
    slope = -4.0 * geometry.inflow * _hover_speed(vehicle)
    assert thrusts[2] - thrusts[1] == pytest.approx(slope)


def test_ground_effect_follows_cheeseman_and_bennett(
    alone: mujoco.MjModel, vehicle: VehicleModel
) -> None:
    assert ground_effect(0.19, 0.19) == pytest.approx(16.0 / 15.0)
    assert ground_effect(0.38, 0.19) == pytest.approx(64.0 / 63.0)
    assert ground_effect(0.0, 0.19) == ground_effect(0.095, 0.19) == pytest.approx(4.0 / 3.0)
    assert ground_effect(HIGH, 0.19) == 1.0
    rotors = _spinning(alone, vehicle, _hover_speed(vehicle))
    near, far = (
        rotors.step(LEVEL, STILL, STILL, STILL, h)[2] for h in (vehicle.leg_height_m, HIGH)
    )
    height = vehicle.leg_height_m + rotor_geometry(alone, prefix="").positions_body[0, 2]
    assert near / far == pytest.approx(ground_effect(height, 0.1905))


def test_fuselage_drag_is_that_of_a_bluff_body(vehicle: VehicleModel) -> None:
    """rho (C_blunt A_front + C_slender (A_max - A_front)) v^2, MuJoCo's ellipsoid model."""
    scene = _scene(FLAT)
    data = mujoco.MjData(scene.model)
    data.qpos[2] = 20.0
    data.qvel[0] = 5.0
    mujoco.mj_forward(scene.model, data)
    front, maximum = np.pi * 0.12 * 0.055, np.pi * 0.15 * 0.12
    expected = AIR_DENSITY_KGPM3 * (0.9 * front + 0.45 * (maximum - front)) * 25.0
    assert -data.qfrc_passive[0] == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("speed", [0.1, 0.2, 0.3])
@pytest.mark.parametrize("ground", ["flat", "rough"])
def test_touchdown_neither_bounces_nor_penetrates(speed: float, ground: str) -> None:
    heights = np.random.default_rng(0).uniform(0.0, 0.1, 41 * 41)
    xml = FLAT if ground == "flat" else ROUGH.format(" ".join(f"{h:.4f}" for h in heights))
    scene = _scene(xml)
    data = mujoco.MjData(scene.model)
    settle_on_ground(scene, data)
    rest = data.qpos[2]
    data.qpos[2] += 0.002  # rotors off: harsher than a landing
    data.qvel[:] = (0.0, 0.0, -speed, 0.0, 0.0, 0.0)
    deepest, touched, rebound = 0.0, False, 0.0
    for _ in range(600):
        mujoco.mj_step(scene.model, data)
        touched = touched or data.ncon > 0
        if data.ncon:
            deepest = max(deepest, -float(data.contact.dist.min()))
        if touched:
            rebound = max(rebound, float(data.qpos[2] - rest))
    assert touched
    assert deepest < 0.01
    assert rebound < 0.02
    assert data.qpos[2] == pytest.approx(rest, abs=0.003)


def test_battery_counts_shaft_and_hotel_power() -> None:
    battery = Battery(1000.0)
    battery.draw(shaft_power_w=75.0, duration_s=2.0)
    assert battery.energy_used_j == pytest.approx(
        2.0 * (75.0 / DRIVE_EFFICIENCY + PowerSystem().avionics_w)
    )
    assert battery.fraction == pytest.approx(1.0 - battery.energy_used_j / 1000.0)
    battery.draw(shaft_power_w=1e6, duration_s=1.0)
    assert battery.empty
    assert battery.fraction == 0.0
