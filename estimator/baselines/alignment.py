"""Attitude at rest from gravity and the earth's magnetic field, for estimators without a known
start."""

from __future__ import annotations

import math

import numpy as np

from touchdown.estimator.typing import Array
from touchdown.sim.api import MagnetometerParams, Observation, SensorRig
from touchdown.sim.frames import Pose

_DURATION_S = 0.25


def field_azimuth(params: MagnetometerParams) -> float:
    """Direction of the horizontal part of the earth's field, rad counter-clockwise from east."""
    return 0.5 * math.pi - math.radians(params.declination_deg)


def level_attitude(force_body: Array, field_body: Array, azimuth: float) -> Array:
    """world_from_body (3, 3) of a body at rest that measures ``force_body`` (3,), upward, and the
    field ``field_body`` (3,) whose horizontal part has ``azimuth`` (rad from east). The field
    determines the heading only (Black 1964, "TRIAD")."""
    up = force_body / np.linalg.norm(force_body)
    level = field_body - (field_body @ up) * up
    along = level / np.linalg.norm(level)
    body = np.column_stack([along, np.cross(up, along), up])
    cos, sin = math.cos(azimuth), math.sin(azimuth)
    world = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    attitude: Array = world @ body.T
    return attitude


class Alignment:
    """Averages the first samples of a stationary vehicle."""

    def __init__(self, rig: SensorRig) -> None:
        self._rig = rig
        self._force, self._field = np.zeros(3), np.zeros(3)
        self._forces = self._fields = 0

    def take(self, obs: Observation) -> Pose | None:
        """Returns world_from_body: the attitude found, at the origin of the odometry frame, which
        is the take-off spot by definition. None until there are enough samples."""
        for sample in obs.imu:
            force = self._rig.body_from_imu.rotation @ sample.specific_force
            if np.isfinite(force).all():
                self._force = self._force + force
                self._forces += 1
        for reading in obs.magnetometer:
            if np.isfinite(reading.field_body_ut).all():
                self._field = self._field + reading.field_body_ut
                self._fields += 1
        if obs.time_s < _DURATION_S or self._fields == 0:
            return None
        azimuth = field_azimuth(self._rig.nav.magnetometer)
        attitude = level_attitude(self._force, self._field, azimuth)
        return Pose(attitude, self._rig.world_from_body_start.translation)

    def mean_force(self) -> Array:
        """(3,) m/s^2, body axes."""
        mean: Array = self._force / max(self._forces, 1)
        return mean

    def heading_sigma(self) -> float:
        """rad: error of the heading from what remains of the magnetometer's calibration."""
        magnetometer = self._rig.nav.magnetometer
        level_ut = magnetometer.strength_ut * math.cos(math.radians(magnetometer.inclination_deg))
        return magnetometer.hard_iron_sigma_ut / level_ut + 2e-3
