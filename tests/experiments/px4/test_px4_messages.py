"""What PX4 is told: frames, units, order and spin of the motors, gains."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from touchdown.controller.api import Setpoint
from touchdown.controller.mixer import allocation_matrix
from touchdown.estimator.api import Estimate
from touchdown.experiments.api import Px4Params
from touchdown.experiments.external.synthetic_stream import synthetic_rig
from touchdown.experiments.px4 import airframe, messages
from touchdown.experiments.px4.commander import LocalFrame, mode_name, version_text
from touchdown.experiments.px4.messages import Messages, Px4Error, dialect
from touchdown.sim.api import BarometerSample, GpsFix, ImuSample, MagnetometerSample
from touchdown.sim.frames import Pose, rotation_from_yaw

pytest.importorskip("pymavlink")
RIG = synthetic_rig()
VEHICLE = RIG.vehicle
PARAMETERS = airframe.parameters(RIG, Px4Params(), 35.0)
HOVER_N = VEHICLE.mass_kg * 9.81 / 4.0


def estimate(yaw: float = 0.0) -> Estimate:
    return Estimate(
        tick=600, time_s=1.0,
        odom_from_body=Pose(rotation_from_yaw(yaw), np.array([1.0, 2.0, 3.0])),
        world_from_odom=Pose.identity(), velocity_odom=np.array([0.1, 0.2, 0.3]),
        angular_velocity_body=np.array([0.01, 0.02, 0.03]), acceleration_odom=np.zeros(3),
        position_covariance=np.diag([1.0, 4.0, 9.0]), rotation_covariance=1e-4 * np.eye(3),
    )  # fmt: skip


def sensors(mag: bool, baro: bool) -> Any:
    imu = ImuSample(tick=3, time_s=0.005, angular_velocity=np.array([0.1, 0.2, 0.3]),
                    specific_force=np.array([1.0, 2.0, 9.81]))  # fmt: skip
    field = MagnetometerSample(tick=3, time_s=0.005, field_body_ut=np.array([20.0, 10.0, -40.0]))
    air = BarometerSample(tick=3, time_s=0.005, pressure_pa=100_710.0, altitude_m=0.0)
    return Messages(RIG).sensors(imu, field if mag else None, air if baro else None)


def test_sensors_are_forward_right_down_in_gauss_and_hectopascals() -> None:
    message = sensors(mag=True, baro=True)
    assert (message.time_usec, message.fields_updated) == (5000, 0x1BFF)
    assert (message.xacc, message.yacc, message.zacc) == (1.0, -2.0, -9.81)
    assert (message.xgyro, message.ygyro, message.zgyro) == (0.1, -0.2, -0.3)
    assert (message.xmag, message.ymag, message.zmag) == pytest.approx((0.2, -0.1, 0.4))
    assert message.abs_pressure == pytest.approx(1007.1)
    assert sensors(mag=False, baro=False).fields_updated == 0x3F
    assert sensors(mag=False, baro=True).fields_updated == 0x1A3F


def test_a_fix_is_where_px4_projects_it_to() -> None:
    """A kilometre north is that arc of PX4's sphere; east shrinks with the latitude's cosine."""
    arc = np.degrees(1000.0 / 6_371_000.0)
    north = messages.geodetic(np.array([0.0, 1000.0, 0.0]))
    assert north == pytest.approx((messages.HOME_LATITUDE_DEG + arc, messages.HOME_LONGITUDE_DEG))
    east = messages.geodetic(np.array([1000.0, 0.0, 0.0]))
    cosine = np.cos(np.radians(messages.HOME_LATITUDE_DEG))
    assert east[1] - messages.HOME_LONGITUDE_DEG == pytest.approx(arc / cosine, rel=1e-4)
    fix = GpsFix(tick=600, time_s=1.0, position_world=np.array([0.0, 0.0, 7.0]),
                 velocity_world=np.array([3.0, 4.0, 1.0]), sigma_velocity_mps=0.05,
                 sigma_position_m=np.array([0.5, 0.5, 0.8]))  # fmt: skip
    message = Messages(RIG).fix(fix, 50.0)
    assert (message.alt, message.vn, message.ve, message.vd) == (57_000, 400, 300, -100)
    assert (message.eph, message.epv, message.fix_type) == (50, 80, 3)
    assert (message.lat, message.lon) == (473_977_420, 85_455_940)


def test_odometry_is_north_east_down_with_its_variances() -> None:
    """Heading east is 90 degrees from north."""
    message = Messages(RIG).odometry(estimate(), 2)
    assert (message.x, message.y, message.z) == (2.0, 1.0, -3.0)
    assert (message.vx, message.vy, message.vz) == (0.2, 0.1, -0.3)
    assert (message.rollspeed, message.pitchspeed, message.yawspeed) == (0.01, -0.02, -0.03)
    assert message.q == pytest.approx([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
    assert [message.pose_covariance[i] for i in (0, 6, 11)] == [4.0, 1.0, 9.0]
    assert [message.pose_covariance[i] for i in (15, 18, 20)] == pytest.approx([1e-4] * 3)
    assert message.reset_counter == 2
    north = Messages(RIG).odometry(estimate(0.5 * np.pi), 0)
    assert np.abs(north.q) == pytest.approx([1.0, 0.0, 0.0, 0.0])


def test_a_setpoint_has_feed_forward_and_a_limit_on_thrust_is_an_acceleration() -> None:
    wanted = Setpoint(
        position_odom=np.array([1.0, 2.0, 3.0]), velocity_odom=np.array([0.1, 0.2, 0.3]),
        acceleration_odom=np.array([0.4, 0.5, 0.6]), yaw_odom=0.0, yaw_rate=0.1,
    )  # fmt: skip
    message = Messages(RIG).setpoint(wanted, 1.0, np.array([100.0, 10.0, 1.0]))
    assert message.type_mask == 0
    assert (message.x, message.y, message.z) == (102.0, 11.0, -2.0)
    assert (message.vx, message.vy, message.vz) == (0.2, 0.1, -0.3)
    assert (message.afx, message.afy, message.afz) == (0.5, 0.4, -0.6)
    assert (message.yaw, message.yaw_rate) == pytest.approx((0.5 * np.pi, -0.1))
    limited = replace(wanted, yaw_rate=0.0, thrust_limit=0.4)
    message = Messages(RIG).setpoint(limited, 1.0, np.zeros(3))
    assert message.type_mask == 4 + 32 and message.afz == pytest.approx(0.6 * 9.81)


def test_with_satellites_setpoints_follow_px4s_frame() -> None:
    """PX4 says where it was 20 ms ago; since then the vehicle has moved."""
    frame, alone = LocalFrame(moves=True), LocalFrame(moves=False)
    assert alone.known and not frame.known
    for step in range(5):
        there = replace(estimate(), time_s=1.0 + 0.005 * step, odom_from_body=Pose(
            np.eye(3), np.array([0.1 * step, 2.0, 3.0])))  # fmt: skip
        frame.note(there)
    said = dialect().MAVLink_local_position_ned_message(1005, 52.0, 20.1, -3.5, 0, 0, 0)
    frame.take(said)
    alone.take(said)
    assert frame.offset_ned == pytest.approx([50.0, 20.0, -0.5])
    assert alone.offset_ned.tolist() == [0.0, 0.0, 0.0]
    said.x = 52.5
    frame.take(said)
    assert 50.0 < frame.offset_ned[0] < 50.1, "smoothed"
    said.x = 60.0
    frame.take(said)
    assert frame.offset_ned[0] == pytest.approx(58.0), "a reset"


def wrench_of(thrust: float, roll: float, pitch: float, yaw: float) -> np.ndarray:
    """Of PX4's normalised thrust and torques, by its mixer and thrust curve: thrust, torque about
    forward, left, up. Motors: front right, rear left (both counter-clockwise), front left, rear
    right."""
    mix = np.sqrt(0.5) * (roll * np.array([-1, 1, 1, -1]) + pitch * np.array([1, -1, 1, -1]))
    fractions = thrust + mix + yaw * np.array([1, 1, -1, -1])
    factor = PARAMETERS["THR_MDL_FAC"]
    controls = (np.sqrt((1 - factor) ** 2 + 4 * factor * fractions) - (1 - factor)) / (2 * factor)
    speeds = airframe.Motors(VEHICLE).speeds(controls.tolist())
    return allocation_matrix(VEHICLE) @ speeds**2


def test_px4_hovers_at_its_hover_thrust_and_its_torques_turn_as_its_gains_say() -> None:
    hover = PARAMETERS["MPC_THR_HOVER"]
    level = wrench_of(hover, 0.0, 0.0, 0.0)
    assert level == pytest.approx([4.0 * HOVER_N, 0.0, 0.0, 0.0])
    per_unit = 1e3 * (wrench_of(hover, 1e-3, 0.0, 0.0) - level)
    assert per_unit[1] * PARAMETERS["MC_ROLLRATE_P"] / VEHICLE.inertia_kgm2[0] == pytest.approx(
        airframe.RATE_RADPS, rel=1e-3
    )
    pitching = 1e3 * (wrench_of(hover, 0.0, 1e-3, 0.0) - level)
    # nose up is about right, minus left
    assert -pitching[2] * PARAMETERS["MC_PITCHRATE_P"] / VEHICLE.inertia_kgm2[1] == pytest.approx(
        airframe.RATE_RADPS, rel=1e-3
    )
    yawing = 1e3 * (wrench_of(hover, 0.0, 0.0, 1e-3) - level)
    # clockwise is about down, minus up
    assert -yawing[3] * PARAMETERS["MC_YAWRATE_P"] / VEHICLE.inertia_kgm2[2] == pytest.approx(
        airframe.YAW_RATE_RADPS, rel=1e-3
    )


def test_motors_are_px4s_by_place_and_spin() -> None:
    assert airframe.Motors(VEHICLE).rotor_of_motor == [3, 1, 0, 2]
    assert airframe.Motors(VEHICLE).speeds([0.0, 0.0, 1.0, -1.0]).tolist() == [565.0, 80, 80, 80]
    assert (PARAMETERS["CA_ROTOR0_PX"], PARAMETERS["CA_ROTOR0_PY"]) == (0.24, 0.24)
    assert PARAMETERS["CA_ROTOR0_KM"] == pytest.approx(1.6e-6 / 6.5e-5)
    turned = airframe.Motors(replace(VEHICLE, rotor_spin=-VEHICLE.rotor_spin))
    assert turned.rotor_of_motor == [0, 1, 2, 3]


def test_geometry_of_a_hexarotor() -> None:
    angles = np.pi / 3.0 * np.arange(6)
    places = 0.5 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    hexa = replace(VEHICLE, rotor_xy_m=places, rotor_spin=np.array([1.0, -1, 1, -1, 1, -1]))
    found = airframe.parameters(replace(RIG, vehicle=hexa), Px4Params(), 35.0)
    assert found["CA_ROTOR_COUNT"] == 6 and "CA_ROTOR6_PX" not in found
    assert (found["CA_ROTOR1_PX"], found["CA_ROTOR1_PY"]) == pytest.approx((0.25, -0.433), abs=1e-3)
    assert found["CA_ROTOR1_KM"] == pytest.approx(1.6e-6 / 6.5e-5)
    # Roll: four motors act, y / sum of y^2; pitch: six, x / sum of x^2, whose scale is the smaller.
    roll, pitch, yaw = airframe.unit_torques_nm(hexa)
    range_n = airframe.thrust_curve(hexa).range_n
    assert roll == pitch == pytest.approx(range_n * np.sqrt(0.75 * 2.0))
    assert yaw == pytest.approx(6.0 * 1.6e-6 / 6.5e-5 * range_n)


def test_satellites_are_off_unless_asked_for_and_a_parameter_may_be_given() -> None:
    assert (PARAMETERS["EKF2_GPS_CTRL"], PARAMETERS["SYS_HAS_GPS"]) == (0, 0)
    given = Px4Params(aid="gps", parameters=("MPC_XY_P=0.5", "EKF2_HGT_REF=1"), ulog=True)
    found = airframe.parameters(RIG, given, 35.0)
    assert (found["EKF2_GPS_CTRL"], found["SYS_HAS_GPS"], found["SDLOG_MODE"]) == (7, 1, 0)
    assert (found["MPC_XY_P"], found["EKF2_HGT_REF"]) == (0.5, 1)
    assert isinstance(found["EKF2_HGT_REF"], int)
    for text in ("MPC_XY_P", "MPC_XY_P=a", "MPC_XY_P=nan", "A B=1", "$(ls)=1", "MPC=1;ls"):
        with pytest.raises(Px4Error, match="NAME=NUMBER"):
            airframe.parameter(text)


def test_modes_and_version_as_px4_writes_them() -> None:
    assert mode_name(6 << 16) == "OFFBOARD" and mode_name(4 << 16 | 6 << 24) == "AUTO.LAND"
    common = dialect()
    message = common.MAVLink_autopilot_version_message(
        0, 0x010E00FF, 0, 0, 0, bytes.fromhex("40c9789e7d7b3273")[::-1], [0] * 8, [0] * 8, 0, 0, 0
    )
    assert version_text(message) == "1.14.0 (40c9789e7d7b3273)"
