"""Touchdown detection from the IMU and the motors' telemetry, without a contact sensor."""

import math

import numpy as np

from touchdown.estimator.api import Estimate
from touchdown.sim.api import GRAVITY_MPS2, Observation, SensorRig

_REACTION_FRACTION = 0.3
"""ground reaction relative to the weight, above that of ground effect and gusts"""
_STATIONARY_MPS = 0.10
_HOLD_S = 0.12
_SMOOTHING = 0.2
_CARRIED_FRACTION, _CARRIED_S = 0.2, 0.8
"""limit of the mean ground reaction relative to the weight, and the time constant of the mean: in
the air it is 0, or a tenth of the weight in ground effect"""


class TouchdownDetector:
    """Detects that the ground carries part of the weight.

    In the air the specific force along body z times the mass is the rotors' thrust; on the ground
    the legs add to it. The difference (IMU minus thrust from rotor telemetry), low-passed over
    about five samples, must stay above 30 % of the weight while the vehicle no longer sinks.

    Near the ground the LIDAR has no returns and the estimated vertical speed may be wrong, or the
    vehicle may bounce. Then the mean over about a second detects the ground later: no vehicle stays
    in the air with a fifth of its weight missing from the thrust.
    """

    def __init__(self, rig: SensorRig) -> None:
        self._vehicle = rig.vehicle
        self._up_in_imu = rig.body_from_imu.rotation[2]
        self._reaction_n = self._carried_n = 0.0
        self._slow_smoothing = 1.0 - math.exp(-rig.imu_ticks / rig.tick_hz / _CARRIED_S)
        self._since_s: float | None = None

    def update(self, obs: Observation, estimate: Estimate, ground_mps: float = 0.0) -> bool:
        """True from the touchdown on; called once a control step while close to the ground, which
        rises at ``ground_mps``."""
        thrust = self._vehicle.thrust_coefficient * float(np.sum(obs.rotor_speed_radps**2))
        for sample in obs.imu:
            force = self._vehicle.mass_kg * float(self._up_in_imu @ sample.specific_force)
            self._reaction_n += _SMOOTHING * (force - thrust - self._reaction_n)
            self._carried_n += self._slow_smoothing * (force - thrust - self._carried_n)
        weight = self._vehicle.mass_kg * GRAVITY_MPS2
        if self._carried_n > _CARRIED_FRACTION * weight:
            return True
        pressed = self._reaction_n > _REACTION_FRACTION * weight
        stationary = abs(float(estimate.velocity_odom[2]) - ground_mps) < _STATIONARY_MPS
        unloaded = thrust < (1.0 - 0.5 * _REACTION_FRACTION) * weight
        if not (pressed and stationary and unloaded):
            self._since_s = None
            return False
        if self._since_s is None:
            self._since_s = obs.time_s
        return obs.time_s - self._since_s >= _HOLD_S
