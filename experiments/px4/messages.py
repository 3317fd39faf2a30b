"""The MAVLink messages of a simulator and of an onboard computer, from ours.

PX4's frames are local north-east-down and body forward-right-down; ours are east-north-up and
forward-left-up."""

import math
from types import ModuleType
from typing import Any

import numpy as np

from touchdown.controller.api import Setpoint
from touchdown.estimator.api import Estimate
from touchdown.experiments.errors import UsageError
from touchdown.sim.api import (
    GRAVITY_MPS2,
    BarometerSample,
    GpsFix,
    ImuSample,
    MagnetometerSample,
    SensorRig,
)
from touchdown.sim.frames import quat_wxyz_from_matrix, wrap_angle
from touchdown.sim.typing import Array

_IMU, _MAGNETOMETER, _BAROMETER = 0x3F, 0x1C0, 0x1A00
_TEMPERATURE_C = 15.0
_NO_Z, _NO_VZ, _NO_YAW_RATE = 4, 32, 2048
_UPPER = np.triu_indices(6)
_KNOWN_HEADING = 65535
NED_FROM_ENU: Array = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FRD_FROM_FLU: Array = np.diag([1.0, -1.0, -1.0])

_EARTH_RADIUS_M = 6_371_000.0
"""of PX4's map projection, which is spherical: an ellipsoid would put a fix off by up to 0.3 %"""
HOME_LATITUDE_DEG, HOME_LONGITUDE_DEG = 47.397742, 8.545594
"""of the world's origin, PX4's own default"""


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


def ned(enu: Array) -> list[float]:
    """North, east, down of a vector (3,) east, north, up."""
    x, y, z = enu.tolist()
    return [y, x, -z]


def frd(flu: Array) -> list[float]:
    """Forward, right, down of a vector (3,) forward, left, up."""
    x, y, z = flu.tolist()
    return [x, -y, -z]


def ned_yaw(enu_yaw: float) -> float:
    """Heading in rad, clockwise from north, of an angle counter-clockwise from east."""
    return float(wrap_angle(0.5 * math.pi - enu_yaw))


def ned_quaternion(rotation: Array) -> list[float]:
    """(w, x, y, z) of ned_from_frd, from the rotation (3, 3) enu_from_flu."""
    return [float(q) for q in quat_wxyz_from_matrix(NED_FROM_ENU @ rotation @ FRD_FROM_FLU)]


def ned_covariance(covariance: Array) -> Array:
    """(3, 3) of a covariance (3, 3) in east, north, up."""
    return NED_FROM_ENU @ covariance @ NED_FROM_ENU.T


def geodetic(enu: Array) -> tuple[float, float]:
    """Latitude and longitude, degrees, of a place (3,) m: the inverse of PX4's azimuthal
    equidistant projection about the world's origin."""
    east, north, _ = enu.tolist()
    lat0, lon0 = math.radians(HOME_LATITUDE_DEG), math.radians(HOME_LONGITUDE_DEG)
    arc = math.hypot(east, north) / _EARTH_RADIUS_M
    if arc == 0.0:
        return HOME_LATITUDE_DEG, HOME_LONGITUDE_DEG
    bearing = math.atan2(east, north)
    sine = math.sin(lat0) * math.cos(arc) + math.cos(lat0) * math.sin(arc) * math.cos(bearing)
    lat = math.asin(sine)
    lon = lon0 + math.atan2(
        math.sin(bearing) * math.sin(arc) * math.cos(lat0), math.cos(arc) - math.sin(lat0) * sine
    )
    return math.degrees(lat), math.degrees(lon)
