"""The MAVLink messages of a simulator and of an onboard computer, from ours."""

from __future__ import annotations

import math
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.controller.api import Setpoint
from touchdown.estimator.api import Estimate
from touchdown.experiments.errors import UsageError
from touchdown.experiments.px4.frames import (
    frd,
    geodetic,
    ned,
    ned_covariance,
    ned_quaternion,
    ned_yaw,
)
from touchdown.sim.api import (
    GRAVITY_MPS2,
    BarometerSample,
    GpsFix,
    ImuSample,
    MagnetometerSample,
    SensorRig,
)

Array = NDArray[np.float64]

_IMU, _MAGNETOMETER, _BAROMETER = 0x3F, 0x1C0, 0x1A00
_TEMPERATURE_C = 15.0
_NO_Z, _NO_VZ, _NO_YAW_RATE = 4, 32, 2048
_UPPER = np.triu_indices(6)
_KNOWN_HEADING = 65535


class Px4Error(UsageError):
    """PX4 is missing, or broke the protocol in the middle of a flight; one line."""


def dialect() -> ModuleType:
    """pymavlink's messages. Raises Px4Error where it is not installed."""
    try:
        from pymavlink.dialects.v20 import common
    except ImportError as error:
        raise Px4Error(
            "controller px4 needs pymavlink: install it with pip install -c constraints.txt -e "
            "'.[px4]'"
        ) from error
    return common  # type: ignore[no-any-return]


def microseconds(time_s: float) -> int:
    """PX4's clock."""
    return round(1e6 * time_s)


class Messages:
    """Builds messages for one vehicle. Text of PX4's enumerations is in pymavlink."""

    def __init__(self, rig: SensorRig) -> None:
        self.common: Any = dialect()
        self._body_from_imu = rig.body_from_imu.rotation
        self._magnetic = [0.0, 0.0, 0.0]
        self._pressure_hpa = 0.0

    def sensors(
        self,
        imu: ImuSample,
        magnetometer: MagnetometerSample | None,
        barometer: BarometerSample | None,
    ) -> Any:
        """HIL_SENSOR at the time of an IMU sample, with what else has arrived: gauss, hPa."""
        fields = _IMU
        if magnetometer is not None:
            self._magnetic = [0.01 * value for value in frd(magnetometer.field_body_ut)]
            fields |= _MAGNETOMETER
        if barometer is not None:
            self._pressure_hpa = 0.01 * barometer.pressure_pa
            fields |= _BAROMETER
        return self.common.MAVLink_hil_sensor_message(
            microseconds(imu.time_s),
            *frd(self._body_from_imu @ imu.specific_force),
            *frd(self._body_from_imu @ imu.angular_velocity),
            *self._magnetic,
            self._pressure_hpa,
            0.0,
            0.0,
            _TEMPERATURE_C,
            fields,
        )

    def fix(self, fix: GpsFix, site_elevation_m: float) -> Any:
        """HIL_GPS of a satellite fix."""
        latitude, longitude = geodetic(fix.position_world)
        velocity = [round(100.0 * v) for v in ned(fix.velocity_world)]
        sigma = fix.sigma_position_m.tolist()
        return self.common.MAVLink_hil_gps_message(
            microseconds(fix.time_s),
            3,
            round(1e7 * latitude),
            round(1e7 * longitude),
            round(1e3 * (site_elevation_m + float(fix.position_world[2]))),
            round(100.0 * max(sigma[0], sigma[1], 0.01)),
            round(100.0 * max(sigma[2], 0.01)),
            round(math.hypot(*velocity)),
            *velocity,
            _KNOWN_HEADING,
            12,
        )

    def odometry(self, estimate: Estimate, resets: int) -> Any:
        """ODOMETRY: pose and velocity in the odom frame, as north, east, down. ``resets``: how
        often the estimate has been lost and found."""
        pose = estimate.odom_from_body
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = ned_covariance(estimate.position_covariance)
        attitude = pose.rotation @ estimate.rotation_covariance @ pose.rotation.T
        covariance[3:, 3:] = ned_covariance(attitude)
        common = self.common
        return common.MAVLink_odometry_message(
            microseconds(estimate.time_s),
            common.MAV_FRAME_LOCAL_NED,
            common.MAV_FRAME_LOCAL_NED,
            *ned(pose.translation),
            ned_quaternion(pose.rotation),
            *ned(estimate.velocity_odom),
            *frd(estimate.angular_velocity_body),
            covariance[_UPPER].tolist(),
            [math.nan] * 21,
            resets % 256,
            common.MAV_ESTIMATOR_TYPE_VIO,
        )

    def setpoint(self, setpoint: Setpoint, time_s: float, offset_ned: Array) -> Any:
        """SET_POSITION_TARGET_LOCAL_NED with position, velocity, acceleration, yaw and its rate.
        With a limit on the thrust the vertical axis is the acceleration that the limit means.
        ``offset_ned`` (3,) m: of PX4's local frame from the odom frame."""
        mask = 0
        acceleration = ned(setpoint.acceleration_odom)
        if setpoint.thrust_limit is not None:
            mask = _NO_Z | _NO_VZ
            acceleration[2] = GRAVITY_MPS2 * (1.0 - setpoint.thrust_limit)
        return self.common.MAVLink_set_position_target_local_ned_message(
            round(1e3 * time_s) % 2**32,
            0,
            0,
            self.common.MAV_FRAME_LOCAL_NED,
            mask,
            *(np.array(ned(setpoint.position_odom)) + offset_ned).tolist(),
            *ned(setpoint.velocity_odom),
            *acceleration,
            ned_yaw(setpoint.yaw_odom),
            -setpoint.yaw_rate,
        )

    def command(self, system: int, number: int, *values: float) -> Any:
        """COMMAND_LONG to the autopilot of a system: PX4 refuses one that is for everybody."""
        padded = [*values, *[0.0] * (7 - len(values))]
        autopilot = self.common.MAV_COMP_ID_AUTOPILOT1
        return self.common.MAVLink_command_long_message(system, autopilot, number, 0, *padded)

    def heartbeat(self) -> Any:
        """HEARTBEAT of an onboard computer."""
        common = self.common
        return common.MAVLink_heartbeat_message(
            common.MAV_TYPE_ONBOARD_CONTROLLER,
            common.MAV_AUTOPILOT_INVALID,
            0,
            0,
            common.MAV_STATE_ACTIVE,
            3,
        )
