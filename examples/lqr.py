"""A controller: LQR with integral action about hover, by python-control.

touchdown land crossroad --controller examples.lqr:build
"""

import control
import numpy as np

from touchdown.controller.api import ControllerRig, Setpoint
from touchdown.estimator.api import Estimate
from touchdown.sim.api import GRAVITY_MPS2, Command
from touchdown.sim.frames import rotation_from_yaw, yaw_from_rotation

ERRORS = (0.6, 0.6, 0.4, 0.8, 0.8, 0.6, 0.15, 0.15, 0.3, 1.2, 1.2, 1.0, 0.8, 0.8, 0.6)
"""tolerated: position, velocity, attitude, rates, integral of position (Bryson's rule)"""
EFFORTS = (12.0, 1.5, 1.5, 0.4)
"""tolerated: thrust N, torques N m"""


class Lqr:
    """State: errors of position, velocity (heading frame), roll, pitch, yaw, body rates, and the
    integral of position. Input: thrust beside the weight, and torques."""

    def __init__(self, params: dict, rig: ControllerRig) -> None:
        self.vehicle, self.step_s = rig.vehicle, 1.0 / rig.control_hz
        self.lean = np.tan(np.radians(rig.control.max_tilt_deg))
        a, b = np.zeros((15, 15)), np.zeros((15, 4))
        a[0:3, 3:6] = a[6:9, 9:12] = a[12:15, 0:3] = np.eye(3)
        a[3, 7], a[4, 6] = GRAVITY_MPS2, -GRAVITY_MPS2  # pitch drives x, roll drives -y
        b[5, 0] = 1.0 / self.vehicle.mass_kg
        b[9:12, 1:4] = np.diag(1.0 / self.vehicle.inertia_kgm2)
        weights = np.diag(np.array(ERRORS) ** -2.0), np.diag(np.array(EFFORTS) ** -2.0)
        self.gain = np.asarray(control.lqr(a, b, *weights)[0])
        x, y = self.vehicle.rotor_xy_m.T
        lift, spin = self.vehicle.thrust_coefficient, self.vehicle.rotor_spin
        rows = (np.full(4, lift), lift * y, -lift * x, self.vehicle.torque_coefficient * spin)
        self.speeds_of_wrench = np.linalg.inv(np.stack(rows))  # squares of the rotor speeds
        self.integral = np.zeros(3)

    def update(self, estimate: Estimate, setpoint: Setpoint) -> Command:
        if not setpoint.motors_on:
            self.integral = np.zeros(3)
            return Command(rotor_speed_radps=np.zeros(4))
        body = estimate.odom_from_body
        heading = rotation_from_yaw(yaw_from_rotation(body.rotation))
        level = heading.T @ body.rotation  # roll and pitch alone
        place = heading.T @ np.clip(body.translation - setpoint.position_odom, -1.5, 1.5)
        speed = heading.T @ (estimate.velocity_odom - setpoint.velocity_odom)
        ahead = heading.T @ setpoint.acceleration_odom
        limit = setpoint.thrust_limit
        if limit is None:  # on the ground the integral would wind up
            self.integral = np.clip(self.integral + place * self.step_s, -2.0, 2.0)
        yaw = yaw_from_rotation(rotation_from_yaw(-setpoint.yaw_odom) @ body.rotation)
        lean = np.array([-ahead[1], ahead[0]]) / GRAVITY_MPS2
        tilt = np.array([level[2, 1], level[0, 2]]) - np.clip(lean, -self.lean, self.lean)
        rates = estimate.angular_velocity_body - [0.0, 0.0, setpoint.yaw_rate]
        wrench = -self.gain @ np.concatenate([place, speed, tilt, [yaw], rates, self.integral])
        weight = self.vehicle.mass_kg * GRAVITY_MPS2
        wrench[0] += weight + self.vehicle.mass_kg * ahead[2]
        wrench[0] = np.clip(wrench[0], 0.3 * weight, 1.8 * weight) / max(level[2, 2], 0.5)
        wrench[0] = min(wrench[0], np.inf if limit is None else limit * weight)
        squares = self.speeds_of_wrench @ wrench
        low, high = self.vehicle.rotor_speed_min, self.vehicle.rotor_speed_max
        speeds = np.sqrt(np.clip(squares, low**2, high**2))
        if limit is not None:  # idle speeds would add up to more
            speeds *= min(1.0, np.sqrt(max(wrench[0], 0.0) / self._thrust(speeds)))
        return Command(rotor_speed_radps=speeds)

    def _thrust(self, speeds: np.ndarray) -> float:
        return self.vehicle.thrust_coefficient * float(speeds @ speeds)


def build(params: dict, rig: ControllerRig) -> Lqr:
    return Lqr(params, rig)
