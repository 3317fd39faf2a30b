"""The true vehicle beside the nominal one: draws, physics, telemetry, battery, the IMU's place."""

from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest

from touchdown.scenes.api import Scene
from touchdown.sim import api as sim
from touchdown.sim.airframe.battery import (
    DRIVE_EFFICIENCY,
    Battery,
    PowerSystem,
    open_circuit_voltage,
)
from touchdown.sim.airframe.deviations import (
    Deviations,
    SpeedTelemetry,
    draw_deviations,
    nominal,
    true_model,
)
from touchdown.sim.airframe.rotors import Rotors
from touchdown.sim.airframe.vehicle import rotor_geometry, vehicle_body_id, vehicle_model
from touchdown.sim.typing import Array
from touchdown.sim.world import MujocoWorld

from support.places import scene_of
from support.worlds import NO_NOISE, STILL_AIR

XML = """<mujoco><asset>
  <texture name="checks" type="2d" builtin="checker" rgb1="1 1 1" width="256" height="256"/>
  <material name="lawn" texture="checks" texrepeat="600 600"/></asset><worldbody>
  <geom name="lawn_floor" type="plane" size="60 60 0.1" material="lawn"/>
  <site name="takeoff" pos="1 2 0"/>
</worldbody></mujoco>"""
ALL = sim.VehicleErrorParams(
    mass_fraction=0.05,
    center_of_mass_m=0.01,
    thrust_fraction=0.05,
    torque_fraction=0.05,
    rotor_fraction=0.02,
)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scene_of(XML)


def make(scene: Scene, seed: int = 3, **groups: Any) -> MujocoWorld:
    params = {"sim": sim.SimParams(threads=1), "wind": STILL_AIR, "imu": NO_NOISE} | groups
    return MujocoWorld(scene, sim.WorldParams(**params), seed)


def test_draws_are_uniform_within_their_bounds() -> None:
    found = [draw_deviations(ALL, seed) for seed in range(600)]
    mass = np.array([one.mass - 1.0 for one in found])
    centers = np.array([one.center_of_mass_m for one in found])
    thrust = np.array([one.thrust for one in found])
    for values, bound in ((mass, 0.05), (centers, 0.01), (thrust.mean(axis=1) - 1.0, 0.06)):
        assert np.abs(values).max() < bound
        assert np.abs(values).max() > 0.9 * min(bound, 0.05)
    assert mass.std() == pytest.approx(0.05 / np.sqrt(3.0), rel=0.08)
    single = thrust / thrust.mean(axis=1, keepdims=True) - 1.0
    assert np.abs(single).max() < 0.036 and single.std() > 0.008


def test_rotors_have_the_true_drag(scene: Scene) -> None:
    params = sim.VehicleErrorParams(drag_fraction=0.2)
    drawn = np.array([draw_deviations(params, seed).drag for seed in range(300)])
    assert 0.8 <= drawn.min() < 0.82 and 1.18 < drawn.max() <= 1.2
    model, level, zero = scene.model, np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3)
    forces = []
    for deviations in (nominal(), replace(nominal(), drag=1.2)):
        rotors = Rotors(vehicle_model(model), rotor_geometry(model), 1.0 / 600.0, deviations)
        rotors.speeds[:] = 400.0
        forces.append(rotors.step(level, np.array([5.0, 0.0, 0.0]), zero, zero, np.inf).copy())
    assert forces[1][0] == pytest.approx(1.2 * forces[0][0]) != 0.0
    assert forces[1][2] == forces[0][2]


def test_one_bound_leaves_the_draws_of_the_others_alone() -> None:
    both, alone = (
        draw_deviations(ALL, 4),
        draw_deviations(sim.VehicleErrorParams(mass_fraction=0.05), 4),
    )
    assert both.mass == alone.mass
    np.testing.assert_array_equal(alone.thrust, np.ones(4))
    assert not draw_deviations(sim.VehicleErrorParams(), 4).of_the_body


def test_true_model_is_a_copy_with_another_body(scene: Scene) -> None:
    body = vehicle_body_id(scene.model)
    shift = np.array([0.01, -0.005, 0.002])
    before = scene.model.body_mass[body], scene.model.body_ipos[body].copy()
    true = true_model(scene.model, replace(nominal(), mass=1.1, center_of_mass_m=shift))
    assert true.body_mass[body] == pytest.approx(1.1 * before[0])
    np.testing.assert_allclose(
        true.body_inertia[body], 1.1 * scene.model.body_inertia[body], rtol=1e-12
    )
    np.testing.assert_allclose(true.body_ipos[body], before[1] + shift)
    assert true.body_subtreemass[body] == pytest.approx(1.1 * before[0])
    assert scene.model.body_mass[body] == before[0]
    assert true_model(scene.model, nominal()) is scene.model


def test_cameras_keep_the_textures_that_the_scene_gives_back(closed: Any) -> None:
    scene, images = scene_of(XML), []
    for taken in (False, True):
        world = closed(make(scene, vehicle_error=ALL))
        world.require(sim.SensorNeeds(camera_hz=10))
        if taken:
            world.take_textures()
        arrived = (world.step(sim.Command(rotor_speed_radps=np.zeros(4))) for _ in range(200))
        images.append(next(obs.images[0].rgb for obs in arrived if obs.images))
    np.testing.assert_array_equal(*images)
    assert images[0].std() > 20.0 and scene.model.tex_data.mean() < 20.0


def test_the_rig_has_the_nominal_vehicle_and_the_physics_the_true_one(scene: Scene) -> None:
    world = make(scene, vehicle_error=ALL, imu=replace(NO_NOISE, offset_m=(0.03, 0.0, -0.02)))
    np.testing.assert_allclose(world.rig.body_from_imu.translation, [0.03, 0.0, -0.02])
    nominal = vehicle_model(scene.model)
    assert world.rig.vehicle.mass_kg == nominal.mass_kg == pytest.approx(4.2)
    true = vehicle_model(world._model).mass_kg
    assert true == pytest.approx(4.2 * draw_deviations(ALL, 3).mass) != nominal.mass_kg
    world.close()


def fall(scene: Scene, deviations: Deviations, speeds: Array) -> tuple[Array, Array]:
    """Accelerations at the start, linear of the body origin and angular, at rotor ``speeds``."""
    model = true_model(scene.model, deviations)
    model.opt.timestep, model.opt.density = 1.0 / 600.0, 0.0
    data = mujoco.MjData(model)
    data.qpos[2] = 50.0
    mujoco.mj_forward(model, data)
    rotors = Rotors(vehicle_model(scene.model), rotor_geometry(model), 1.0 / 600.0, deviations)
    rotors.speeds[:] = speeds
    rotors.demand(speeds)
    zero = np.zeros(3)
    wrench = rotors.step(np.array([1.0, 0.0, 0.0, 0.0]), zero, zero, zero, np.inf)
    data.xfrc_applied[vehicle_body_id(model)] = wrench
    mujoco.mj_forward(model, data)
    return data.qacc[:3].copy(), data.qacc[3:6].copy()


def test_thrust_through_the_origin_turns_a_body_with_its_mass_ahead(scene: Scene) -> None:
    """The same thrust on all rotors acts at the origin: a centre of mass 1 cm ahead of it gives the
    pitching moment of the thrust times 1 cm, nose up negative: nose down is + about y."""
    speeds = np.full(4, 398.0)
    ahead = replace(nominal(), center_of_mass_m=np.array([0.01, 0.0, 0.0]))
    _, level = fall(scene, nominal(), speeds)
    _, turned = fall(scene, ahead, speeds)
    vehicle = vehicle_model(scene.model)
    thrust = 4.0 * vehicle.thrust_coefficient * 398.0**2
    expected = 0.01 * thrust / vehicle.inertia_kgm2[1]
    assert (turned - level)[1] == pytest.approx(expected, rel=0.02)
    assert np.abs((turned - level)[[0, 2]]).max() < 0.02 * expected


def test_a_weak_rotor_tips_the_body_towards_itself(scene: Scene) -> None:
    weak = replace(nominal(), thrust=np.array([0.98, 1.0, 1.0, 1.0]))
    _, turned = fall(scene, weak, np.full(4, 398.0))
    _, level = fall(scene, nominal(), np.full(4, 398.0))
    # rotor 0 is front left: the front sinks (+y) and the left side sinks (-x)
    assert (turned - level)[1] > 0.05 and (turned - level)[0] < -0.05


def test_torque_share_turns_about_the_vertical_and_costs_power(scene: Scene) -> None:
    speeds = np.full(4, 398.0)
    spin = vehicle_model(scene.model).rotor_spin
    uneven = replace(nominal(), torque=1.0 + 0.05 * (spin > 0))
    _, turned = fall(scene, uneven, speeds)
    vehicle = vehicle_model(scene.model)
    expected = 2 * 0.05 * vehicle.torque_coefficient * 398.0**2 / vehicle.inertia_kgm2[2]
    assert turned[2] == pytest.approx(expected, rel=0.02)
    rotors = Rotors(vehicle, rotor_geometry(scene.model), 1 / 600, uneven)
    rotors.speeds[:] = speeds
    assert rotors.shaft_power() == pytest.approx(
        1.025 * 4 * vehicle.torque_coefficient * 398.0**3, rel=1e-9
    )


def test_telemetry_has_noise_and_resolution() -> None:
    params = sim.VehicleErrorParams(telemetry_sigma_radps=1.0, telemetry_step_radps=1.5)
    sensor = SpeedTelemetry(params, 2)
    speeds = np.array([398.2, 401.7, 380.0, 0.0])
    found = np.array([sensor.read(speeds) for _ in range(2000)])
    np.testing.assert_allclose(found / 1.5, np.round(found / 1.5), atol=1e-9)
    assert not found[:, 3].any()
    spread = np.sqrt(1.0 + 1.5**2 / 12.0)
    np.testing.assert_allclose(found[:, :3].mean(axis=0), speeds[:3], atol=0.12)
    np.testing.assert_allclose(found[:, :3].std(axis=0), spread, rtol=0.06)
    np.testing.assert_array_equal(SpeedTelemetry(sim.VehicleErrorParams(), 2).read(speeds), speeds)


def test_the_world_reports_noisy_speeds_and_keeps_the_true_ones(scene: Scene, closed: Any) -> None:
    params = sim.VehicleErrorParams(telemetry_sigma_radps=2.0)
    world = closed(make(scene, vehicle_error=params))
    for _ in range(50):
        obs = world.step(sim.Command(rotor_speed_radps=np.full(4, 300.0)))
    off = obs.rotor_speed_radps - world.truth().rotor_speed_radps
    assert 0.0 < np.abs(off).max() < 10.0


def test_open_circuit_voltage_of_a_cell() -> None:
    """Chen and Rincon-Mora (2006): 4.10 V full, about 3.8 V at half, steep at the end."""
    assert open_circuit_voltage(1.0) / 6.0 == pytest.approx(4.103, abs=0.001)
    assert open_circuit_voltage(0.5) / 6.0 == pytest.approx(3.803, abs=0.005)
    assert open_circuit_voltage(0.02) / 6.0 < 3.3
    charge = np.linspace(0.0, 1.0, 50)
    assert (np.diff([open_circuit_voltage(float(c)) for c in charge]) > 0.0).all()


def test_voltage_sags_under_load_by_ohms_law() -> None:
    battery = Battery(700e3, sag=True, resistance_ohm=0.025)
    battery.draw(500.0, 0.005)
    power = 500.0 / DRIVE_EFFICIENCY + PowerSystem().avionics_w
    current = power / battery.voltage
    assert open_circuit_voltage(1.0) - 0.025 * current == pytest.approx(battery.voltage, rel=1e-6)
    assert battery.speed_fraction == pytest.approx(battery.voltage / open_circuit_voltage(1.0))
    assert 0.9 < battery.speed_fraction < 0.98
    lost = 0.025 * current**2
    assert battery.energy_used_j == pytest.approx((power + lost) * 0.005, rel=1e-6)


def test_sag_grows_with_what_was_used_and_is_off_by_default() -> None:
    fresh, used = (Battery(700e3, True, 0.025) for _ in range(2))
    used.energy_used_j = 0.8 * 700e3
    for battery in (fresh, used):
        battery.draw(400.0, 0.005)
    assert used.speed_fraction < fresh.speed_fraction - 0.05
    plain = Battery(700e3)
    plain.draw(400.0, 0.005)
    assert plain.speed_fraction == 1.0
    assert plain.energy_used_j == (400.0 / DRIVE_EFFICIENCY + PowerSystem().avionics_w) * 0.005


def test_sag_limits_the_rotors(scene: Scene, closed: Any) -> None:
    fastest = {}
    for sag in (False, True):
        world = closed(make(scene, sim=sim.SimParams(threads=1, battery_sag=sag)))
        maximum = world.rig.vehicle.rotor_speed_max
        for _ in range(80):
            world.step(sim.Command(rotor_speed_radps=np.full(4, maximum)))
        fastest[sag] = float(world.truth().rotor_speed_radps.mean())
    assert fastest[False] == pytest.approx(maximum, rel=1e-3)
    assert 0.85 * maximum < fastest[True] < 0.97 * maximum


def flown(scene: Scene, offset: tuple[float, float, float]) -> tuple[list[Any], list[Any]]:
    """IMU samples and truths of a short climb with a roll and yaw kick, IMU at ``offset``."""
    world = make(scene, imu=replace(NO_NOISE, offset_m=offset))
    samples, truths = [], [world.truth()]
    for k in range(120):
        kick = 60.0 * np.array([1.0, -1.0, -1.0, 0.6]) * np.sin(0.25 * k)
        obs = world.step(sim.Command(rotor_speed_radps=430.0 + kick))
        samples += obs.imu
        truths.append(world.truth())
    world.close()
    return samples, truths


def test_specific_force_is_that_of_the_imus_own_point(scene: Scene) -> None:
    """The force minus that at the origin: angular and centripetal acceleration, exactly the change
    of omega x r over the sample."""
    lever = np.array([0.03, -0.02, 0.015])
    there, truths = flown(scene, (0.03, -0.02, 0.015))
    here, same = flown(scene, (0.0, 0.0, 0.0))
    np.testing.assert_array_equal(truths[-1].velocity_world, same[-1].velocity_world)
    largest = 0.0
    for k, (at_lever, at_origin) in enumerate(zip(there, here, strict=True)):
        swing = [
            t.world_from_body.rotation @ np.cross(t.angular_velocity_body, lever)
            for t in (truths[k], truths[k + 1])
        ]
        middle = truths[k].world_from_body.rotation  # to first order in the turn of 5 ms
        expected = middle.T @ (swing[1] - swing[0]) * 200.0
        found = at_lever.specific_force - at_origin.specific_force
        np.testing.assert_allclose(found, expected, atol=0.02)
        np.testing.assert_array_equal(at_lever.angular_velocity, at_origin.angular_velocity)
        largest = max(largest, float(np.abs(expected).max()))
    assert largest > 0.2
