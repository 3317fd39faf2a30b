"""Allocation for any number of rotors: known answers, priority in saturation, lost rotors; and the
gains that are designed for a vehicle."""

import dataclasses
from functools import cache

import numpy as np
import pytest

from touchdown.controller import design
from touchdown.controller.api import ControlParams, Setpoint
from touchdown.controller.cascade import CascadeController
from touchdown.controller.mixer import Mixer, uncontrolled_axis
from touchdown.scenes.api import VEHICLES
from touchdown.scenes.compose import vehicle_spec
from touchdown.sim.airframe.checks import checked_vehicle
from touchdown.sim.api import GRAVITY_MPS2, VehicleModel

from support.flight_dynamics import Flyer, example_vehicle

RATIO = 0.02


@cache
def shipped(name: str) -> VehicleModel:
    return checked_vehicle(vehicle_spec(name).compile())


def ring(spins: list[float], arm_m: float = 0.5, columns: int | None = None) -> VehicleModel:
    """Rotors evenly on a circle from ahead counter-clockwise, several on each of ``columns``
    hubs; kT 1e-4, so that 100 rad/s are 1 N."""
    count = len(spins)
    angles = 2.0 * np.pi * (np.arange(count) % (columns or count)) / (columns or count)
    return dataclasses.replace(
        example_vehicle(),
        rotor_xy_m=arm_m * np.stack([np.cos(angles), np.sin(angles)], axis=1),
        rotor_spin=np.array(spins), thrust_coefficient=1e-4, torque_coefficient=1e-4 * RATIO,
        rotor_speed_min=0.0, rotor_speed_max=500.0,
    )  # fmt: skip


HEXA = ring([1, 1, -1, -1, 1, -1])


def thrusts(mixer: Mixer, *wrench: float) -> np.ndarray:
    return 1e-4 * mixer.speeds(np.array(wrench)) ** 2


def test_thrust_is_shared_evenly() -> None:
    for vehicle in (ring([1, -1, 1, -1]), HEXA, ring([1, -1, 1, -1, -1, 1, -1, 1], columns=4)):
        count = len(vehicle.rotor_spin)
        np.testing.assert_allclose(thrusts(Mixer(vehicle), 12.0, 0, 0, 0), 12.0 / count)


def test_a_coaxial_pair_yaws_by_the_difference_of_its_rotors() -> None:
    mixer = Mixer(ring([1, -1, 1, -1, -1, 1, -1, 1], columns=4))
    found = thrusts(mixer, 8.0, 0.0, 0.0, 8.0 * RATIO * 0.5)
    np.testing.assert_allclose(found, 1.0 + 0.5 * np.array([1, -1, 1, -1, -1, 1, -1, 1]))


def test_roll_of_an_alternating_hexarotor_follows_the_arms() -> None:
    # y of the hubs is 0, s, s, 0, -s, -s; the least thrusts that roll by 1 N m are y / sum of y^2.
    y = 0.5 * np.sqrt(0.75) * np.array([0, 1, 1, 0, -1, -1])
    found = thrusts(Mixer(ring([1, -1, 1, -1, 1, -1])), 12.0, 1.0, 0.0, 0.0)
    np.testing.assert_allclose(found, 2.0 + y / (y @ y))


@pytest.mark.parametrize("vehicle", [HEXA, shipped("coaxial_x8")], ids=["hexa", "x8"])
def test_tilt_before_thrust_before_yaw(vehicle: VehicleModel) -> None:
    mixer = Mixer(vehicle)
    full = len(vehicle.rotor_spin) * vehicle.thrust_coefficient * vehicle.rotor_speed_max**2
    roll = 0.02 * full * np.abs(vehicle.rotor_xy_m).max()
    wanted = np.array([0.999 * full, roll, 0.0, 0.5 * full * RATIO])
    thrust, got_roll, pitch, yaw = mixer.wrench(mixer.speeds(wanted))
    assert got_roll == pytest.approx(roll) and pitch == pytest.approx(0.0, abs=1e-9 * full)
    assert 0.8 * full < thrust < wanted[0]
    assert 0.0 <= yaw < 0.1 * wanted[3]


def test_without_one_of_four_rotors_the_hexarotor_commands_all_axes() -> None:
    for lost in range(4):
        mixer = Mixer(HEXA, [lost])
        speeds = mixer.speeds(np.array([12.0, 0.1, -0.1, 0.01]))
        assert speeds[lost] == 0.0
        np.testing.assert_allclose(mixer.wrench(speeds), [12.0, 0.1, -0.1, 0.01], atol=1e-9)


@pytest.mark.parametrize("lost", [4, 5])
def test_without_the_others_it_gives_up_yaw(lost: int) -> None:
    mixer = Mixer(HEXA, [lost])
    wrench = mixer.wrench(mixer.speeds(np.array([40.0, 0.1, -0.1, 0.2])))
    np.testing.assert_allclose(wrench[:3], [40.0, 0.1, -0.1], atol=1e-2)
    assert abs(wrench[3]) < 0.25 * RATIO * 40.0


def test_alternating_spins_leave_the_opposite_rotor_idle() -> None:
    mixer = Mixer(dataclasses.replace(ring([1, -1, 1, -1, 1, -1]), rotor_speed_min=10.0), [0])
    speeds = mixer.speeds(np.array([12.0, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(1e-4 * speeds**2, [0.0, 3.0, 3.0, 0.01, 3.0, 3.0], atol=1e-3)


def test_what_cannot_be_flown_is_refused() -> None:
    assert uncontrolled_axis(ring([1, 1, 1, 1, 1, 1])) == "yaw"
    line = dataclasses.replace(HEXA, rotor_xy_m=HEXA.rotor_xy_m * [1.0, 0.0])
    assert uncontrolled_axis(line) == "roll"
    with pytest.raises(ValueError, match="cannot carry the vehicle upright"):
        Mixer(ring([1, -1, 1, -1]), [0])


@pytest.mark.parametrize("name", VEHICLES)
def test_designed_gains_keep_the_margins(name: str) -> None:
    vehicle = shipped(name)
    control = design.designed(vehicle, ControlParams())
    assert len(design.checked_margins(vehicle, control)) == 11
    if name == "quadrotor":
        assert control == ControlParams()  # whose defaults are its gains


def test_design_of_a_heavier_vehicle_with_slower_motors() -> None:
    quadrotor = shipped("quadrotor")
    slow = dataclasses.replace(
        quadrotor, mass_kg=3.0 * quadrotor.mass_kg, motor_time_constant_s=0.12,
        inertia_kgm2=5.0 * quadrotor.inertia_kgm2,
        thrust_coefficient=3.0 * quadrotor.thrust_coefficient,
    )  # fmt: skip
    with pytest.raises(ValueError, match="margins of"):
        design.checked_margins(slow, ControlParams())
    control = design.designed(slow, ControlParams())
    found = design.checked_margins(slow, control)
    least = min(margin.phase_margin_deg for margin in found)
    assert 50.0 <= least < 55.0  # no slower than it must
    ratio = control.rate_radps / control.attitude_radps
    assert ratio == pytest.approx(28.0 / 9.0)
    weak = dataclasses.replace(quadrotor, torque_coefficient=1e-9)
    with pytest.raises(ValueError, match="loops of yaw would be too slow"):
        design.designed(weak, ControlParams())


def test_authority_in_hover_by_hand() -> None:
    # Each rotor carries 1 N of at most 25: rolling by one pair, up or down by 1 N, at 0.5 m.
    vehicle = dataclasses.replace(
        ring([1, -1, 1, -1]), mass_kg=4.0 / GRAVITY_MPS2, inertia_kgm2=np.array([0.1, 0.2, 0.4])
    )
    found = design.angular_authority(vehicle)
    np.testing.assert_allclose(found, [10.0, 5.0, 4.0 * RATIO / 0.4])


def test_a_hexarotor_hovers_on_after_the_loss_of_a_rotor() -> None:
    vehicle = dataclasses.replace(
        HEXA, rotor_xy_m=0.8 * HEXA.rotor_xy_m, rotor_speed_min=20.0, motor_time_constant_s=0.04
    )
    flyer, control = Flyer(vehicle), CascadeController(vehicle, ControlParams())
    speed = np.sqrt(vehicle.mass_kg * GRAVITY_MPS2 / 6.0 / vehicle.thrust_coefficient)
    flyer.rotors = np.full(6, speed)
    still = Setpoint(position_odom=np.zeros(3), velocity_odom=np.zeros(3),
                     acceleration_odom=np.zeros(3), yaw_odom=0.0)  # fmt: skip
    farthest = 0.0
    for step in range(2400):
        command = control.update(flyer.estimate(), still).rotor_speed_radps.copy()
        command[1] = 0.0 if step >= 200 else command[1]
        flyer.advance(command)
        control.hear(flyer.rotors)
        farthest = max(farthest, float(np.linalg.norm(flyer.position)))
    assert farthest < 1.0
    assert np.linalg.norm(flyer.position) < 0.05
    assert abs(np.arctan2(flyer.rotation[1, 0], flyer.rotation[0, 0])) < 0.1
