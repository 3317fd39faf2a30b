"""Vehicles from MJCF files: what is added, what is wrong with a file, what follows from it."""

import dataclasses
import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from touchdown.experiments.config.loading import load_config
from touchdown.experiments.config.settings import identity_of
from touchdown.experiments.config.vehicles import examined, values_of
from touchdown.scenes.api import VEHICLE_FOLDER, VEHICLES, Guests
from touchdown.scenes.compose import load_scene, vehicle_spec
from touchdown.sim.airframe.checks import checked_vehicle, induced_speed_mps, tipping_slope_deg
from touchdown.sim.airframe.vehicle import foot_positions, sensor_mounts, vehicle_model
from touchdown.sim.api import FaultParams
from touchdown.sim.faults.disturbances import Disturbances

from support.command import Says

TABLE = """
  <numeric name="thrust_coefficient" data="6e-5"/><numeric name="rotor_radius" data="0.12"/>
  <numeric name="torque_coefficient" data="1e-6"/><numeric name="rotor_speed_max" data="500"/>
  <numeric name="rotor_spin" data="1 -1 1 -1"/>"""
BODY = """
  <geom type="box" size="0.1 0.1 0.04" mass="2"/>
  <site name="imu"/>
  <site name="rotor_0" pos="0.2 0.2 0.05"/><site name="rotor_1" pos="-0.2 0.2 0.05"/>
  <site name="rotor_2" pos="-0.2 -0.2 0.05"/><site name="rotor_3" pos="0.2 -0.2 0.05"/>
  <site name="lidar_0" pos="0 0 -0.05" xyaxes="0 -1 0 -1 0 0"/>
  <site name="camera_0" pos="0.05 0 -0.05" xyaxes="0 -1 0 -1 0 0"/>
  <site name="leg_0" pos="0.15 0.15 -0.2"/><site name="leg_1" pos="-0.15 0.15 -0.2"/>
  <site name="leg_2" pos="-0.15 -0.15 -0.2"/><site name="leg_3" pos="0.15 -0.15 -0.2"/>"""


def write(folder: Path, body: str = BODY, table: str = TABLE, more: str = "") -> str:
    """A file as people have them: a free joint, a floor, a light, actuators, sensors, a key."""
    file = folder / "mine.xml"
    file.write_text(
        f"""<mujoco><custom>{table}</custom><worldbody><light pos="0 0 3"/>
        <geom name="floor" type="plane" size="1 1 1"/>
        <body name="mine" pos="0 0 1" euler="0 0 30"><freejoint/>{body}</body></worldbody>
        <actuator><motor site="rotor_0" gear="0 0 1 0 0 0"/></actuator>
        <sensor><gyro site="imu"/></sensor>
        <keyframe><key qpos="0 0 1 1 0 0 0" ctrl="1"/></keyframe>{more}</mujoco>""",
        encoding="utf-8",
    )
    return str(file)


def test_what_a_flight_needs_is_added(tmp_path: Path) -> None:
    model = vehicle_spec(write(tmp_path)).compile()
    assert (model.nbody, model.njnt, model.nu, model.nsensor, model.nkey) == (2, 0, 0, 0, 0)
    mounts = sensor_mounts(model, prefix="")
    np.testing.assert_allclose(mounts.camera_right.translation, [0.05, -0.05, -0.05])
    camera = model.camera("camera")
    axes = np.empty(9)
    mujoco.mju_quat2Mat(axes, camera.quat)
    expected = mounts.camera.rotation @ np.diag([1.0, -1.0, -1.0])
    np.testing.assert_allclose(axes.reshape(3, 3), expected, atol=1e-12)
    np.testing.assert_allclose(foot_positions(model, prefix="")[:, 2], -0.2)
    discs = [model.geom(f"rotor_{i}") for i in range(4)]
    assert [disc.size[0] for disc in discs] == [0.12] * 4
    vehicle = vehicle_model(model, prefix="")
    assert vehicle.mass_kg == pytest.approx(2.0)
    assert vehicle.rotor_inflow == pytest.approx(6e-5 / (0.1814 * 0.12))
    scene = load_scene("flat", 0, guests=Guests(vehicle=write(tmp_path)))
    assert scene.vehicle.endswith("mine.xml") and scene.model.body("vehicle/quadrotor").mass == 2.0


def test_options_of_its_file_are_dropped_without_a_word(
    tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    more = '<option timestep="0.01" density="1" integrator="RK4" gravity="0 0 -1"/>'
    scene = load_scene("flat", 0, guests=Guests(vehicle=write(tmp_path, more=more)))
    assert str(scene.model.opt) == str(load_scene("flat", 0).model.opt)
    assert not [str(one.message) for one in recwarn.list]


def test_bodies_inside_are_one_with_it_and_the_origin_is_the_centre_of_mass(tmp_path: Path) -> None:
    part = '<body pos="0.2 0 0.1"><joint/><geom type="sphere" size="0.05" mass="2"/></body>'
    model = vehicle_spec(write(tmp_path, BODY + part)).compile()
    vehicle = vehicle_model(model, prefix="")
    box = 2.0 / 3.0 * np.array([0.1**2 + 0.04**2, 0.1**2 + 0.04**2, 2 * 0.1**2])
    ball, offset = 0.4 * 2.0 * 0.05**2, 2 * 2.0 * np.array([0.05**2, 0.1**2 + 0.05**2, 0.1**2])
    assert vehicle.mass_kg == model.body_subtreemass[0] == pytest.approx(4.0)
    np.testing.assert_allclose(vehicle.inertia_kgm2, box + ball + offset)
    np.testing.assert_allclose(vehicle.rotor_xy_m[0], [0.1, 0.2])  # half-way to the part
    assert vehicle.leg_height_m == pytest.approx(0.25)
    np.testing.assert_allclose(sensor_mounts(model, prefix="").imu.translation, [-0.1, 0, -0.05])


def test_splayed_legs_reach_no_lower_than_their_ends(tmp_path: Path) -> None:
    """The boxes around them do, by 15 mm."""
    for end, is_low in ((-0.18, False), (-0.19, True)):
        legs = "".join(
            f'<geom type="capsule" size="0.02" fromto="0 0 0 {x} {y} {end}" mass="0.01"/>'
            for x in (0.15, -0.15) for y in (0.15, -0.15)
        )  # fmt: skip
        model = vehicle_spec(write(tmp_path, BODY + legs)).compile()
        if is_low:
            with pytest.raises(ValueError, match="below the feet"):
                checked_vehicle(model)
        else:
            checked_vehicle(model)


@pytest.mark.parametrize(
    ("old", "new", "says_"),
    [
        ('mass="2"', 'mass="5"', "too heavy for its thrust: 49.1 N of weight, 60.0 N of thrust"),
        ('<site name="imu"/>', "", "no site 'imu'; add it"),
        ("rotor_0", "motor", "no site 'rotor_0'"),
        ('name="camera_0"', "", "no site 'camera_0'"),
        ('name="lidar_0"', "", "no site 'lidar_0'; add it"),
        ("leg_0", "foot", "the vehicle has no feet"),
        ("leg_2", "foot", "the 2 feet, the sites leg_0 ..., do not stand around"),
        ('mass="2"', 'mass="0"', "no mass; give its geoms a mass"),
        ("1 -1 1 -1", "1 1 1 1", "the rotors cannot yaw"),
        ("1 -1 1 -1", "1 -1 1", "'rotor_spin'> must hold 4 value(s), not 3"),
        ("1 -1 1 -1", "2 -1 1 -1", "must hold 1 or -1 for each rotor"),
        ('"rotor_3" pos="0.2 -0.2', '"rotor_3" pos="0.2 0.2', "rotor_0 and rotor_3 lie on one"),
        ('"rotor_3" pos', '"rotor_3" euler="0 20 0" pos', "rotor_3 leans"),
        ('"0.05 0 -0.05" xyaxes="0 -1 0 -1 0 0"', '"0.05 0 0"', "camera_0 does not look down"),
        ('"0 0 -0.05" xyaxes="0 -1 0 -1 0 0"', '"0 0 0"', "lidar_0 looks up"),
        ("thrust_coefficient", "kT", "no <numeric name='thrust_coefficient'>; add it"),
        ("rotor_radius", "radius", "no <numeric name='rotor_radius'"),
        ('-0.2"/>', '-0.03"/>', "below the feet"),
        ('data="1e-6"', 'data="1e-4"', "torque_coefficient is more than a fifth"),
        ('mass="2"/>', 'mass="2"/', "not a valid MJCF file"),
    ],
)
def test_a_wrong_vehicle_is_one_line(
    tmp_path: Path, says: Says, old: str, new: str, says_: str
) -> None:
    text = BODY if old in BODY else TABLE
    assert old in text
    changed = text.replace(old, new)
    file = write(tmp_path, *((changed, TABLE) if text is BODY else (BODY, changed)))
    said = says(2, "vehicles", "check", file).err
    assert says_ in said and said.count("\n") == 1 and "mine.xml" in said


def test_zero_inertia_and_too_many_rotors(tmp_path: Path, says: Says) -> None:
    point = '<inertial pos="0 0 0" mass="2" diaginertia="0 0 0"/>'
    assert "are those of no solid body" in says(2, "vehicles", "check", write(
        tmp_path, point + BODY)).err  # fmt: skip
    more = "".join(f'<site name="rotor_{i}" pos="0.2 0.2 0.05"/>' for i in range(4, 13))
    said = says(2, "vehicles", "check", write(tmp_path, BODY + more)).err
    assert "it has 13 rotors" in said and said.count("\n") == 1
    assert "unknown vehicle 'hexa'" in says(2, "land", "flat", "--vehicle", "hexa").err
    assert "does not exist" in says(2, "land", "flat", "--vehicle", "no/such.xml").err


def test_the_shipped_vehicles_are_listed_and_checked(says: Says) -> None:
    assert set(json.loads(says(0, "vehicles", "list", "--json").out)) == set(VEHICLES)
    assert {file.stem for file in VEHICLE_FOLDER.glob("*.xml")} == set(VEHICLES)
    found = json.loads(says(0, "vehicles", "check", "hexarotor", "--json").out)
    assert found["rotors"] == 6 and len(found["loops"]) == 11
    assert found["mass_kg"] == pytest.approx(6.0)


def test_the_default_has_the_defaults_of_the_keys() -> None:
    assert values_of(examined("quadrotor"), {}) == {}
    for more in ({"profile": "field"}, {"profile": "harsh", "preset": "short"}):
        plain = load_config(None, more)
        assert load_config(None, {**more, "vehicle": "quadrotor"}) == plain


def test_keys_that_a_vehicle_sets_stand_below_all_others() -> None:
    config = load_config(None, {"control.yaw_radps": 1.5}, vehicle="small_quadrotor")
    assert config.lidar.preset == "mid360" and config.control.yaw_radps == 1.5
    assert config.sim.battery_capacity_j == pytest.approx(72 * 3600)
    slow = load_config(None, vehicle="coaxial_x8")
    assert slow.control.rate_radps < 28.0 and slow.control.wind_feed_forward  # that of `field`
    slower = slow.control.velocity_z_radps / 7.0
    assert slower < 1.0 and slow.landing.climb_speed_mps == pytest.approx(3.0 * slower)
    assert identity_of(slow)["vehicle"] == "coaxial_x8" and len(identity_of(slow)) == 6


def test_limits_by_hand(tmp_path: Path) -> None:
    model = vehicle_spec(write(tmp_path)).compile()
    # 2 kg on four discs of 12 cm: v^2 = m g / (2 rho A).
    expected = np.sqrt(2.0 * 9.81 / (2.0 * 1.225 * 4.0 * np.pi * 0.12**2))
    assert induced_speed_mps(model) == pytest.approx(expected)
    vehicle, reach = vehicle_model(model, prefix=""), np.hypot(0.15, 0.2)
    inertia = vehicle.inertia_kgm2[:2].max() + 2.0 * reach**2
    spin = 2.0 * 0.5 * 0.2 / inertia
    # Tilted by the slope, the centre of mass has that much less to rise over the lower feet.
    slope = np.radians(tipping_slope_deg(model))
    rise = reach * (1.0 - np.cos(np.arctan2(0.15, 0.2) - slope))
    assert 0.5 * inertia * spin**2 == pytest.approx(2.0 * 9.81 * rise)


def test_a_rotor_stops_only_where_others_are_left() -> None:
    with pytest.raises(ValueError, match="motor = 4 is none of the vehicle's rotors, 0 to 3"):
        Disturbances(FaultParams(motor=4), 600, 0.0, 0)
    whole = FaultParams(events=("motor_loss@0",), motor=4, motor_loss_fraction=1.0)
    with pytest.raises(ValueError, match="without a level hover"):
        Disturbances(dataclasses.replace(whole, motor=0), 600, 0.0, 0)
    fraction = Disturbances(whole, 600, 0.0, 0, rotors=6).rotor_speed_fraction(0)
    np.testing.assert_array_equal(fraction, [1, 1, 1, 1, 0, 1])
