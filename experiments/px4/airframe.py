"""The airframe as PX4 knows it: order and spin of the motors, thrust curve, gains, parameters."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from touchdown.experiments.api import Px4Params
from touchdown.experiments.px4.messages import Px4Error
from touchdown.sim.api import GRAVITY_MPS2, SensorRig, VehicleModel
from touchdown.sim.typing import Array

RATE_RADPS, YAW_RATE_RADPS = 16.0, 5.0
"""crossover of the rate loops: the motors' lag of 40 ms allows no more"""
_RATE_LEAD_S = 0.025
_RATE_INTEGRAL_S = 0.6
_MOTOR_S = 0.04
ATTITUDE_RADPS, YAW_RADPS = 6.0, 2.0
_X_PLACES = ((True, False), (False, True), (True, True), (False, False))
_X_TURNS = (-1.0, -1.0, 1.0, 1.0)
"""ahead, left; and the reaction torque about up: of a quadrotor X in PX4's order"""


class Motors:
    """PX4's motors as rotors: motor ``i`` of PX4's list is our rotor ``rotor_of_motor[i]``.

    A quadrotor X in PX4's order: front right and rear left, which turn counter-clockwise, then
    front left and rear right; a vehicle of another shape in its own.
    """

    def __init__(self, vehicle: VehicleModel) -> None:
        corners = [(x > 0.0, y > 0.0) for x, y in vehicle.rotor_xy_m.tolist()]
        self.rotor_of_motor = list(range(len(corners)))
        if sorted(corners) == sorted(_X_PLACES):
            order = [corners.index(corner) for corner in _X_PLACES]
            if tuple(vehicle.rotor_spin[order].tolist()) == _X_TURNS:
                self.rotor_of_motor = order
        self.count = len(corners)
        self._low, self._high = vehicle.rotor_speed_min, vehicle.rotor_speed_max

    def speeds(self, controls: list[float]) -> Array:
        """(R,) rad/s of our rotors for PX4's controls, 0 to 1: idle to full speed."""
        speeds = np.zeros(self.count)
        for rotor, control in zip(self.rotor_of_motor, controls, strict=True):
            speeds[rotor] = self._low + min(max(control, 0.0), 1.0) * (self._high - self._low)
        return speeds


@dataclass(frozen=True, slots=True)
class ThrustCurve:
    """Thrust of the rotors over PX4's control u: idle and (1 - f) u + f u^2 of the range above."""

    factor: float
    """f, PX4's THR_MDL_FAC"""
    hover: float
    """fraction of the range in hover, MPC_THR_HOVER"""
    range_n: float
    """of one rotor, from idle to full speed"""


def thrust_curve(vehicle: VehicleModel) -> ThrustCurve:
    """The curve of a motor whose speed is linear in the control, from idle to full speed."""
    idle = vehicle.rotor_speed_min / vehicle.rotor_speed_max
    full_n = vehicle.thrust_coefficient * vehicle.rotor_speed_max**2
    range_n = (1.0 - idle**2) * full_n
    hover_n = vehicle.mass_kg * GRAVITY_MPS2 / len(vehicle.rotor_spin)
    return ThrustCurve((1.0 - idle) / (1.0 + idle), (hover_n - idle**2 * full_n) / range_n, range_n)


def unit_torques_nm(vehicle: VehicleModel) -> list[float]:
    """Torques about roll, pitch and yaw for a whole unit of PX4's torque setpoints.

    PX4 scales the columns of the pseudo-inverse: of roll and pitch by the larger root of their
    square sum over half the motors that act, of yaw by the largest entry.
    """
    ratio = vehicle.torque_coefficient / vehicle.thrust_coefficient
    x, y = vehicle.rotor_xy_m.T
    mix = np.linalg.pinv(np.stack([y, -x, ratio * vehicle.rotor_spin, np.ones(len(x))]))
    acting = (np.abs(mix[:, :2]) > 1e-3).sum(axis=0)
    tilting = float(np.sqrt((mix[:, :2] ** 2).sum(axis=0) / (acting / 2.0)).max())
    range_n = thrust_curve(vehicle).range_n
    return [range_n / tilting, range_n / tilting, range_n / float(np.abs(mix[:, 2]).max())]


def parameters(rig: SensorRig, params: Px4Params, max_tilt_deg: float) -> dict[str, float | int]:
    """PX4's parameters for this vehicle and these sensors, by name."""
    found: dict[str, float | int] = {
        **_estimation(rig, params),
        **_control(rig.vehicle, max_tilt_deg),
        **_mission(params),
    }
    for text in params.parameters:
        name, value = parameter(text)
        found[name] = value
    return found


def parameter_lines(found: Mapping[str, float | int]) -> list[str]:
    """Lines of PX4's start script that set parameters."""
    return [f"param set {name} {value}" for name, value in found.items()]


def parameter(text: str) -> tuple[str, float | int]:
    """Name and value of ``NAME=VALUE``. Raises Px4Error."""
    name, _, value = text.partition("=")
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not (name.isidentifier() and name.isascii() and name.isupper() and math.isfinite(number)):
        raise Px4Error(f"px4.parameters: '{text[:60]}' is not of the form NAME=NUMBER")
    return name, int(value) if value.strip("+-").isdigit() else number


def _estimation(rig: SensorRig, params: Px4Params) -> dict[str, float | int]:
    with_gps = params.aid == "gps"
    imu, antenna = rig.body_from_imu.translation, rig.nav.gps.antenna_body_m
    tick_ms = 1e3 / rig.tick_hz
    return {
        "EKF2_EV_CTRL": 15,  # position, height, velocity and yaw
        "EKF2_HGT_REF": 3,
        "EKF2_EV_DELAY": 0,  # the estimate is propagated to now
        "EKF2_EV_NOISE_MD": 0,  # noise as the messages state it, no less than the following
        "EKF2_EVP_NOISE": 0.03,
        "EKF2_EVV_NOISE": 0.1,
        "EKF2_EVA_NOISE": 0.02,
        "EKF2_GPS_CTRL": 7 if with_gps else 0,
        "SYS_HAS_GPS": int(with_gps),
        "EKF2_MAG_TYPE": 5,
        "SYS_HAS_MAG": 0,
        "EKF2_BARO_DELAY": rig.nav.barometer.latency_ticks * tick_ms,
        "EKF2_GPS_DELAY": rig.nav.gps.latency_ticks * tick_ms,
        "EKF2_IMU_POS_X": float(imu[0]),
        "EKF2_IMU_POS_Y": -float(imu[1]),
        "EKF2_IMU_POS_Z": -float(imu[2]),
        "EKF2_GPS_POS_X": antenna[0],
        "EKF2_GPS_POS_Y": -antenna[1],
        "EKF2_GPS_POS_Z": -antenna[2],
        "EKF2_MULTI_IMU": 0,  # one filter on the one IMU that there is
        "SENS_IMU_MODE": 1,
        "IMU_INTEG_RATE": round(rig.tick_hz / rig.imu_ticks),
        "IMU_GYRO_FFT_EN": 0,
    }


def _control(vehicle: VehicleModel, max_tilt_deg: float) -> dict[str, float | int]:
    curve = thrust_curve(vehicle)
    found: dict[str, float | int] = {
        "CA_AIRFRAME": 0, "CA_ROTOR_COUNT": len(vehicle.rotor_spin)
    }  # fmt: skip
    ratio = vehicle.torque_coefficient / vehicle.thrust_coefficient
    order = Motors(vehicle).rotor_of_motor
    for motor, rotor in enumerate(order):
        x, y = vehicle.rotor_xy_m[rotor].tolist()
        found[f"CA_ROTOR{motor}_PX"], found[f"CA_ROTOR{motor}_PY"] = x, -y
        found[f"CA_ROTOR{motor}_KM"] = -float(vehicle.rotor_spin[rotor]) * ratio
    # PX4 turns faster motors' loops no faster; slower motors' in proportion to their lag.
    slower = min(1.0, _MOTOR_S / vehicle.motor_time_constant_s)
    authority = dict(zip(("ROLL", "PITCH", "YAW"), unit_torques_nm(vehicle), strict=True))
    for axis, (name, torque_nm) in enumerate(authority.items()):
        crossover = YAW_RATE_RADPS if name == "YAW" else RATE_RADPS
        gain = float(vehicle.inertia_kgm2[axis]) * slower * crossover / torque_nm
        found[f"MC_{name}RATE_K"] = 1.0
        found[f"MC_{name}RATE_P"] = gain
        found[f"MC_{name}RATE_I"] = gain / _RATE_INTEGRAL_S
        found[f"MC_{name}RATE_D"] = 0.0 if name == "YAW" else gain * _RATE_LEAD_S
    return found | {
        "MC_ROLL_P": slower * ATTITUDE_RADPS,
        "MC_PITCH_P": slower * ATTITUDE_RADPS,
        "MC_YAW_P": slower * YAW_RADPS,
        "THR_MDL_FAC": curve.factor,
        "MPC_THR_HOVER": curve.hover,
        "MPC_THR_MIN": 0.08,
        "MPC_TILTMAX_AIR": max_tilt_deg,
        "MPC_XY_P": 1.3,
        "MPC_XY_VEL_P_ACC": 3.2,
        "MPC_XY_VEL_I_ACC": 2.0,
        "MPC_XY_VEL_D_ACC": 0.2,
        "MPC_Z_P": 1.5,
        "MPC_Z_VEL_P_ACC": 7.0,
        "MPC_Z_VEL_I_ACC": 3.0,
        "MPC_Z_VEL_MAX_UP": 6.0,
        "MPC_Z_VEL_MAX_DN": 4.0,
        "MPC_TKO_RAMP_T": 0.3,
        "COM_SPOOLUP_TIME": 0.5,
    }


def _mission(params: Px4Params) -> dict[str, float | int]:
    return {
        "COM_RC_IN_MODE": 4,  # no radio, no ground station, no battery of its own
        "NAV_RCL_ACT": 0,
        "NAV_DLL_ACT": 0,
        "COM_LOW_BAT_ACT": 0,
        "COM_OBL_RC_ACT": 4,  # land when setpoints fail to come
        "COM_OF_LOSS_T": 1.0,
        "SDLOG_MODE": 0 if params.ulog else -1,
    }
