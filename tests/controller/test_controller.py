import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from touchdown.controller.api import ControlParams, Setpoint
from touchdown.controller.cascade import (
    CascadeController,
    DisturbanceObserver,
    _forces,
    _outer_errors,
    _rate_setpoint,
    _undelivered,
    _wrench,
)
from touchdown.controller.mixer import Mixer, MotorLead, allocation_matrix, lead_coefficients
from touchdown.controller.pid import PidGains, VectorPid
from touchdown.sim.api import GRAVITY_MPS2
from touchdown.sim.frames import rotation_from_yaw, so3_exp, yaw_from_rotation
from touchdown.sim.typing import Array

from support.flight_dynamics import Flyer, example_vehicle, fly

VEHICLE = example_vehicle()
WEIGHT = VEHICLE.mass_kg * GRAVITY_MPS2
STEP_S = 0.005


def hold(position: Array, yaw: float = 0.0, **changes: Any) -> Callable[[float], Setpoint]:
    setpoint = Setpoint(
        position_odom=position, velocity_odom=np.zeros(3), acceleration_odom=np.zeros(3),
        yaw_odom=yaw,
    )  # fmt: skip
    return lambda t: dataclasses.replace(setpoint, **changes)


def flying_controller(params: ControlParams | None = None) -> tuple[CascadeController, Flyer]:
    """A controller whose motor model has run up, as the vehicle's rotors have."""
    controller, flyer = CascadeController(VEHICLE, params or ControlParams()), Flyer(VEHICLE)
    for _ in range(60):
        controller.update(flyer.estimate(), hold(np.zeros(3))(0.0))
    return controller, flyer


def test_allocation_of_one_rotor_by_hand() -> None:
    # Rotor 0 stands 0.2 m ahead and 0.2 m to the right: its push lifts the nose (torque about -y)
    # and the right side (torque about -x); its reaction turns the body to the left.
    thrust = VEHICLE.thrust_coefficient * 500.0**2
    wrench = allocation_matrix(VEHICLE) @ np.array([500.0**2, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(
        wrench, [thrust, -0.2 * thrust, -0.2 * thrust, VEHICLE.torque_coefficient * 500.0**2]
    )


def test_mixer_inverts_the_rotors_exactly_within_their_range_and_never_leaves_it() -> None:
    mixer, rng = Mixer(VEHICLE), np.random.default_rng(5)
    low, high = VEHICLE.rotor_speed_min, VEHICLE.rotor_speed_max
    for _ in range(50):
        speeds = rng.uniform(low, high, 4)
        np.testing.assert_allclose(mixer.speeds(mixer.wrench(speeds)), speeds, rtol=1e-9)
    for wrench in rng.normal(0.0, 1.0, (500, 4)) * np.array([200.0, 30.0, 30.0, 3.0]):
        speeds = mixer.speeds(wrench)
        assert (speeds >= low * (1 - 1e-9)).all() and (speeds <= high * (1 + 1e-9)).all()


def test_mixer_gives_roll_and_pitch_before_thrust_before_yaw() -> None:
    mixer = Mixer(VEHICLE)
    full = 4 * VEHICLE.thrust_coefficient * VEHICLE.rotor_speed_max**2
    got = mixer.wrench(mixer.speeds(np.array([full, 2.0, -1.0, 0.3])))
    np.testing.assert_allclose(got[1:3], [2.0, -1.0], rtol=1e-9)
    # Each N m takes 1 / (4 * 0.2) N per rotor; the strongest rotor's share is what thrust loses.
    np.testing.assert_allclose(got[0], full - 4 * 3.0 / 0.8, rtol=1e-9)
    assert 0.0 <= got[3] < 0.3


def test_mixer_raises_the_thrust_where_a_torque_needs_it() -> None:
    mixer = Mixer(VEHICLE)
    got = mixer.wrench(mixer.speeds(np.array([0.0, 1.5, 0.0, 0.0])))
    idle = VEHICLE.thrust_coefficient * VEHICLE.rotor_speed_min**2
    np.testing.assert_allclose(got[:3], [4 * (idle + 1.5 / 0.8), 1.5, 0.0], rtol=1e-9, atol=1e-12)


def test_thrust_limit_holds_against_torque_and_thrust() -> None:
    mixer = Mixer(VEHICLE)
    got = mixer.wrench(mixer.speeds(np.array([WEIGHT, 3.0, 0.0, 0.0]), 0.3 * WEIGHT))
    np.testing.assert_allclose(got[0], 0.3 * WEIGHT, rtol=1e-9)
    assert 0.0 < got[1] < 3.0


def test_mixer_refuses_rotors_that_all_turn_alike() -> None:
    with pytest.raises(ValueError, match="cannot yaw"):
        Mixer(dataclasses.replace(VEHICLE, rotor_spin=np.ones(4)))


def test_motor_lead_makes_the_rotor_follow_the_faster_lag() -> None:
    lead, speed = MotorLead(VEHICLE, response_s=0.01, step_s=STEP_S), np.full(4, 400.0)
    lead.modelled_radps = speed.copy()
    decay = np.exp(-STEP_S / VEHICLE.motor_time_constant_s)
    for step in range(1, 9):
        command = lead.command(np.full(4, 420.0))
        speed = command + decay * (speed - command)
        np.testing.assert_allclose(speed, 420.0 - 20.0 * np.exp(-step * STEP_S / 0.01))
        np.testing.assert_allclose(lead.modelled_radps, speed)


def test_a_response_slower_than_the_motors_leaves_commands_alone() -> None:
    motor = VEHICLE.motor_time_constant_s
    assert lead_coefficients(motor, 3.0 * motor, STEP_S)[0] == pytest.approx(1.0)
    assert lead_coefficients(0.0, 0.01, STEP_S) == (1.0, 0.0)


def one_axis_pid(limit: float = 10.0) -> VectorPid:
    gains = PidGains(
        kp=np.array([2.0]), ki=np.array([1.0]), kd=np.array([0.5]), integral_limit=np.array([limit])
    )
    return VectorPid(gains, 0.1)


def test_pid_adds_its_three_terms() -> None:
    pid = one_axis_pid()
    pid.output(np.array([3.0]), np.array([0.0]))
    pid.settle(np.array([0.0]))  # integral: 1.0 * 3.0 * 0.1
    assert pid.output(np.array([3.0]), np.array([4.0]))[0] == pytest.approx(6.0 + 0.3 - 2.0)


def test_pid_integral_stops_at_its_limit_and_forgets_on_reset() -> None:
    pid = one_axis_pid(limit=0.5)
    for _ in range(100):
        pid.output(np.array([-3.0]), np.zeros(1))
        pid.settle(np.zeros(1))
    assert pid.integral[0] == -0.5
    pid.reset()
    assert pid.output(np.zeros(1), np.zeros(1))[0] == 0.0


def test_pid_integral_stands_still_where_the_actuator_is_saturated() -> None:
    # Back-calculation rests where ki e = (ki / kp) (demand - delivered): 2 e beyond the actuator.
    pid = one_axis_pid(limit=1e3)
    for _ in range(500):
        demand = pid.output(np.array([1.0]), np.zeros(1))
        pid.settle(np.minimum(demand, 1.0) - demand)
    assert demand[0] == pytest.approx(1.0 + 2.0, rel=1e-3)


def test_errors_and_feed_forward_of_the_outer_loops_by_hand() -> None:
    """2 m behind at a gain of 1.5, bounded at 2 m/s; a jerk of 0.02 / 0.005, and one beyond the
    bound of 12 m/s^3; drag of the reference's speed in the plane."""
    zero, x, y = np.zeros(3), *np.eye(3)[:2]
    lead = np.array([0.1, 0.1, 0.01])
    velocity_error, acceleration_error, forward, drag = _outer_errors.py_func(
        2.0 * x, zero, 3.0 * x + 5.0 * np.eye(3)[2], x, 0.5 * y, 0.02 * x, zero, STEP_S,
        np.full(3, 1.5), 2.0, lead, 0.1, 12.0,
    )  # fmt: skip
    np.testing.assert_allclose(velocity_error, [3.0 - 1.0 + 2.0, 0.0, 5.0])
    np.testing.assert_allclose(acceleration_error, [-0.02, 0.5, 0.0])
    np.testing.assert_allclose(forward, [0.02 + 0.1 * 4.0, 0.0, 0.0])
    np.testing.assert_allclose(drag, [-0.3, 0.0, 0.0])
    slow = (0.5 * y, zero, zero, zero, zero, y, zero, STEP_S, np.full(3, 1.5), 2.0, lead, 0.1, 12.0)
    velocity_error, _, forward, _ = _outer_errors.py_func(*slow)
    np.testing.assert_allclose(velocity_error, [0.0, 0.75, 0.0])
    np.testing.assert_allclose(forward, [0.0, 1.0 + 0.1 * 12.0, 0.0])


def test_force_by_hand_and_what_was_not_delivered() -> None:
    zero, x = np.zeros(3), np.array([1.0, 0.0, 0.0])
    force, limited = _forces.py_func(2.0 * x, 3.0 * x, -0.5 * x, 1.5 * x, 2.0, 20.0, 1.0, np.inf)
    np.testing.assert_allclose(force, [2.0 * (2.0 + 3.0 + 0.5 - 1.5), 0.0, 20.0])
    np.testing.assert_array_equal(limited, force)
    _, low = _forces.py_func(
        -20.0 * np.eye(3)[2] + 9.0 * x, zero, zero, zero, 2.0, 20.0, 0.5, np.inf
    )
    np.testing.assert_allclose(low, [0.5 * 6.0, 0.0, 6.0])  # 0.3 of the weight, and the tilt of it
    _, high = _forces.py_func(20.0 * np.eye(3)[2], zero, zero, zero, 2.0, 20.0, 0.5, np.inf)
    np.testing.assert_allclose(high, [0.0, 0.0, 36.0])
    wrench, achieved = np.array([20.0, 0.4, 0.0, 0.1]), np.array([15.0, 0.4, 0.0, 0.0])
    missing, angular = _undelivered.py_func(
        np.array([4.0, 0.0, 20.0]), np.array([6.0, 0.0, 20.0]), achieved, wrench, 2.0,
        np.array([0.1, 0.1, 0.2]),
    )  # fmt: skip
    np.testing.assert_allclose(missing, [(3.0 - 6.0) / 2.0, 0.0, (15.0 - 20.0) / 2.0])
    np.testing.assert_allclose(angular, [0.0, 0.0, -0.5])


@pytest.mark.parametrize(
    ("rotation", "force", "yaw", "yaw_rate", "expected"),
    [
        (np.eye(3), [0.0, 0.0, 1.0], 0.0, 0.0, [0.0, 0.0, 0.0]),
        (np.eye(3), [np.sin(0.2), 0.0, np.cos(0.2)], 0.0, 0.0, [0.0, 0.6, 0.0]),
        (np.eye(3), [0.0, np.sin(0.2), np.cos(0.2)], 0.0, 0.0, [-0.4, 0.0, 0.0]),
        (so3_exp(np.array([0.1, 0.0, 0.0])), [0.0, 0.0, 1.0], 0.0, 0.0, [-0.2, 0.0, 0.0]),
        (rotation_from_yaw(np.pi / 2), [0.2, 0.0, 1e3], np.pi / 2, 0.0, [4e-4, 0.0, 0.0]),
        (rotation_from_yaw(3.0), [0.0, 0.0, 1.0], -3.0, 0.1, [0.0, 0.0, 0.1 + 2 * np.pi - 6.0]),
        (so3_exp(np.array([0.0, 0.5, 0.0])), [np.tan(0.5), 0.0, 1.0], 0.0, 0.4,
         [0.0, 0.0, 0.4 * np.cos(0.5)]),
        (np.eye(3), [1.0, 0.0, -1.0], 3.0, 0.0, [0.0, 4.0, 1.5]),
    ],
    ids=["level", "ahead", "left", "rolled", "turned", "shorter way", "leaning", "limits"],
)  # fmt: skip
def test_rates_of_known_attitude_errors(
    rotation: Array, force: list[float], yaw: float, yaw_rate: float, expected: list[float]
) -> None:
    rates = _rate_setpoint.py_func(
        rotation, np.array(force), yaw, yaw_rate, np.array([2.0, 3.0, 1.0]),
        np.array([4.0, 4.0, 1.5]),
    )  # fmt: skip
    np.testing.assert_allclose(rates, expected, atol=1e-6)


def test_torque_is_eulers_equation() -> None:
    inertia, rates = np.array([0.06, 0.07, 0.10]), np.array([0.5, -1.0, 2.0])
    wanted = np.array([3.0, -2.0, 1.0])
    wrench = _wrench.py_func(41.0, wanted, rates, inertia)
    torque = inertia * wanted + np.cross(rates, inertia * rates)
    np.testing.assert_allclose(wrench, [41.0, *torque])


def test_hovering_vehicle_gets_its_hover_speed() -> None:
    controller, flyer = flying_controller()
    command = controller.update(flyer.estimate(), hold(np.zeros(3))(0.0))
    np.testing.assert_allclose(command.rotor_speed_radps, flyer.rotors, rtol=1e-6)


@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_a_reference_ahead_tilts_the_vehicle_towards_it(yaw: float) -> None:
    controller, flyer = flying_controller()
    flyer.rotation = rotation_from_yaw(yaw)
    ahead = flyer.rotation @ np.array([1.0, 0.0, 0.0])
    controller.reset()
    command = controller.update(flyer.estimate(), hold(ahead, yaw)(0.0))
    wrench = Mixer(VEHICLE).wrench(command.rotor_speed_radps)
    assert wrench[2] > 0.1  # nose down
    assert abs(wrench[1]) < 1e-6


def test_motors_off_stops_the_rotors_and_resets() -> None:
    controller, flyer = flying_controller()
    fly(flyer, controller, hold(np.array([0.5, 0.0, 0.2])), 0.5)
    stopped = controller.update(flyer.estimate(), hold(np.zeros(3), motors_on=False)(0.0))
    assert not stopped.rotor_speed_radps.any()
    fresh = CascadeController(VEHICLE, ControlParams())
    level, setpoint = Flyer(VEHICLE).estimate(), hold(np.zeros(3))(0.0)
    for _ in range(20):  # at first both command the highest speed
        np.testing.assert_array_equal(
            controller.update(level, setpoint).rotor_speed_radps,
            fresh.update(level, setpoint).rotor_speed_radps,
        )


def test_thrust_limit_bounds_the_thrust_and_freezes_the_integrals() -> None:
    controller, flyer = flying_controller()
    high = hold(np.array([0.0, 0.0, 5.0]), thrust_limit=0.4)(0.0)
    for _ in range(100):
        command = controller.update(flyer.estimate(), high)
    assert Mixer(VEHICLE).wrench(command.rotor_speed_radps)[0] == pytest.approx(
        0.4 * WEIGHT, rel=1e-3
    )
    fresh, _ = flying_controller()
    after = controller.update(flyer.estimate(), hold(np.zeros(3))(0.0))
    expected = fresh.update(flyer.estimate(), hold(np.zeros(3))(0.0))
    for _ in range(100):  # both motor models come to the same rest
        after = controller.update(flyer.estimate(), hold(np.zeros(3))(0.0))
        expected = fresh.update(flyer.estimate(), hold(np.zeros(3))(0.0))
    np.testing.assert_allclose(after.rotor_speed_radps, expected.rotor_speed_radps, rtol=1e-3)


def test_tilt_stays_within_its_limit() -> None:
    controller, flyer = flying_controller(ControlParams(max_tilt_deg=15.0))
    cosines = []
    for _ in range(600):
        setpoint = hold(np.array([40.0, -30.0, 0.0]))(0.0)
        flyer.advance(controller.update(flyer.estimate(), setpoint).rotor_speed_radps)
        cosines.append(flyer.rotation[2, 2])
    assert np.degrees(np.arccos(min(cosines))) < 15.0 + 2.0 and abs(flyer.position[2]) < 0.15


def test_step_of_one_metre_settles_without_much_overshoot() -> None:
    controller, flyer = flying_controller()
    errors = fly(flyer, controller, hold(np.array([1.0, 0.0, 1.0])), 8.0)
    assert errors[:, [0, 2]].max() < 0.35 and np.abs(errors[-200:]).max() < 0.01


def test_half_turn_of_yaw_and_a_tumble_are_recovered() -> None:
    controller, flyer = flying_controller()
    flyer.rotation = so3_exp(np.radians([50.0, -30.0, 120.0]))
    errors = fly(flyer, controller, hold(np.zeros(3), yaw=-1.0), 12.0)
    assert np.abs(errors[-200:]).max() < 0.02
    assert yaw_from_rotation(flyer.rotation) == pytest.approx(-1.0, abs=0.01)


def test_observer_finds_the_force_of_the_air_and_not_the_ground() -> None:
    observer = DisturbanceObserver(VEHICLE, bandwidth_radps=6.0, step_s=STEP_S)
    tilt = so3_exp(np.array([0.0, 0.1, 0.0]))
    rotors = np.full(4, np.sqrt(WEIGHT / (4 * VEHICLE.thrust_coefficient)))
    thrust = GRAVITY_MPS2 * tilt[:, 2] - np.array([0.0, 0.0, GRAVITY_MPS2])
    push = np.array([-0.7, 0.4, 0.3])
    for _ in range(400):
        observer.update(thrust + push, tilt, rotors, np.array([-0.2, 0.0, 0.0]))
    np.testing.assert_allclose(observer.acceleration, [-0.5, 0.4, 0.0], atol=1e-4)
    for _ in range(400):  # standing on a slope with idle rotors
        observer.update(np.zeros(3), tilt, 0.2 * rotors, np.zeros(3))
    np.testing.assert_allclose(observer.acceleration, 0.0, atol=1e-4)


def test_observer_finds_lost_thrust_but_no_lift() -> None:
    observer = DisturbanceObserver(VEHICLE, bandwidth_radps=6.0, step_s=STEP_S, vertical=True)
    rotors = np.full(4, np.sqrt(WEIGHT / (4 * VEHICLE.thrust_coefficient)))
    for _ in range(400):
        observer.update(np.array([0.3, 0.0, -2.0]), np.eye(3), rotors, np.zeros(3))
    np.testing.assert_allclose(observer.acceleration, [0.3, 0.0, -2.0], atol=1e-4)
    for _ in range(400):  # ground effect, or legs that begin to carry
        observer.update(np.array([0.0, 0.0, 1.0]), np.eye(3), rotors, np.zeros(3))
    np.testing.assert_allclose(observer.acceleration, 0.0, atol=1e-4)


def _storm(t: float) -> Array:
    """Rises to 11 m/s within two seconds, in which the rotors lose a third of their thrust."""
    return np.array([min(5.5 * t, 11.0), 0.0, 0.0])


def _held(vehicle_scale: float, thrust_scale: float, *, feed_forward: bool) -> Array:
    """(steps, 3) error of a hover in `_storm`, of a vehicle other than the nominal one."""
    true = dataclasses.replace(
        VEHICLE,
        mass_kg=vehicle_scale * VEHICLE.mass_kg,
        thrust_coefficient=thrust_scale * VEHICLE.thrust_coefficient,
    )
    params = ControlParams(wind_feed_forward=feed_forward)
    controller, _ = flying_controller(params)
    flyer = Flyer(true, _storm)
    return fly(flyer, controller, hold(np.zeros(3)), 25.0)


def test_feed_forward_holds_the_height_in_a_storm() -> None:
    without = _held(1.0, 1.0, feed_forward=False)
    with_it = _held(1.0, 1.0, feed_forward=True)
    assert np.abs(with_it[:, 2]).max() < 0.5 * np.abs(without[:, 2]).max()
    assert np.linalg.norm(with_it[-200:], axis=1).max() < 0.02


@pytest.mark.parametrize(("mass", "thrust"), [(0.95, 1.05), (1.05, 0.95), (1.05, 1.05)])
def test_feed_forward_is_stable_with_a_vehicle_other_than_modelled(
    mass: float, thrust: float
) -> None:
    errors = _held(mass, thrust, feed_forward=True)
    assert np.linalg.norm(errors[-400:], axis=1).max() < 0.03


def test_height_goes_before_place_where_thrust_does_not_last_for_both() -> None:
    # 5 N of lift beyond the weight of 40 N, 60 N asked for across, rotors that give 55 N.
    zero, across = np.zeros(3), np.array([15.0, 0.0, 1.25])
    _, limited = _forces(zero, across, zero, zero, 4.0, 40.0, np.tan(np.radians(60.0)), 55.0)
    np.testing.assert_allclose(limited, [np.sqrt(55.0**2 - 45.0**2), 0.0, 45.0])
    _, unbounded = _forces(zero, across, zero, zero, 4.0, 40.0, np.tan(np.radians(60.0)), np.inf)
    np.testing.assert_allclose(unbounded, [60.0, 0.0, 45.0])
