"""Observations of a policy: arrays made of the newest sensor measurements."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.sim.api import Observation, SensorNeeds, SensorRig, Truth
from touchdown.sim.typing import Array

CAMERA_HZ = 10
_FAR_M = 1000.0


@dataclass(frozen=True, slots=True)
class Bounds:
    """Shape, dtype and limits of one array of an observation. Values are clipped to the limits."""

    shape: tuple[int, ...]
    low: NDArray[Any]
    high: NDArray[Any]

    @property
    def dtype(self) -> Any:
        """Numpy dtype of the array."""
        return self.low.dtype


SENSORS: Mapping[str, SensorNeeds] = {
    "imu": SensorNeeds(),
    "rangefinder": SensorNeeds(rangefinder=True),
    "barometer": SensorNeeds(barometer=True),
    "magnetometer": SensorNeeds(magnetometer=True),
    "rotors": SensorNeeds(),
    "gps": SensorNeeds(gps=True),
    "camera": SensorNeeds(camera_hz=CAMERA_HZ),
}
"""By name: the sensors that the world simulates for it."""

_GYRO_LIMIT, _ACCEL_LIMIT = float(np.radians(2000.0)), 24.0 * 9.81
"""Full scale of a BMI088."""
_LIMITS: Mapping[str, tuple[float, Array]] = {
    "imu": (-1.0, np.array([_GYRO_LIMIT] * 3 + [_ACCEL_LIMIT] * 3)),
    "rangefinder": (0.0, np.array([_FAR_M])),
    "barometer": (-1.0, np.array([_FAR_M])),
    "magnetometer": (-1.0, np.full(3, 100.0)),
    "rotors": (0.0, np.full(4, 2.0)),
    "gps": (-1.0, np.array([1e4] * 3 + [100.0] * 3)),
    "state": (-1.0, np.array([1e4] * 3 + [100.0] * 3 + [1.0] * 9 + [100.0] * 3 + [_FAR_M])),
}
"""By name: the low limit as a factor of the high one, and the high limits."""


def sensor_needs(sensors: tuple[str, ...]) -> SensorNeeds:
    """Returns the union of the needs of the named sensors."""
    needs = SensorNeeds()
    for name in sensors:
        needs |= SENSORS[name]
    return needs


class ObservationBuffer:
    """Keeps the newest measurement of every sensor and returns observations."""

    def __init__(
        self, sensors: tuple[str, ...], privileged: bool, camera_pixels: tuple[int, int]
    ) -> None:
        names = (*dict.fromkeys(sensors), *(("state",) if privileged else ()))
        width, height = camera_pixels
        self.bounds: dict[str, Bounds] = {
            name: _image_bounds(width, height) if name == "camera" else _number_bounds(name)
            for name in names
        }

    def reset(self, rig: SensorRig) -> None:
        """Clears all measurements for a new episode."""
        self._start_position = rig.world_from_body_start.translation
        self._full_speed = rig.vehicle.rotor_speed_max
        self._latest: dict[str, NDArray[Any]] = {
            name: np.zeros(b.shape) for name, b in self.bounds.items()
        }
        self._imu: list[Array] = []
        self._first_altitude: float | None = None

    def update(self, obs: Observation) -> None:
        """Stores the measurements that arrived in one control step."""
        latest = self._latest
        self._imu += [np.concatenate([s.angular_velocity, s.specific_force]) for s in obs.imu]
        latest["rotors"] = obs.rotor_speed_radps / self._full_speed
        if obs.rangefinder:
            latest["rangefinder"] = np.array([obs.rangefinder[-1].range_m])
        if obs.barometer:
            altitude = obs.barometer[-1].altitude_m
            if self._first_altitude is None:
                self._first_altitude = altitude
            latest["barometer"] = np.array([altitude - self._first_altitude])
        if obs.magnetometer:
            latest["magnetometer"] = obs.magnetometer[-1].field_body_ut
        if obs.gps:
            fix = obs.gps[-1]
            position = fix.position_world - self._start_position
            latest["gps"] = np.concatenate([position, fix.velocity_world])
        if obs.images:
            latest["camera"] = obs.images[-1].rgb

    def observation(
        self, truth: Truth, home: Array, height_over_ground_m: float
    ) -> dict[str, NDArray[Any]]:
        """Returns new arrays within ``bounds`` and restarts the mean of the IMU. home: (3,) origin
        of the true position in ``state``."""
        if self._imu:
            self._latest["imu"] = np.mean(self._imu, axis=0)
            self._imu.clear()
        if "state" in self.bounds:
            pose = truth.world_from_body
            self._latest["state"] = np.concatenate(
                [
                    pose.translation - home,
                    truth.velocity_world,
                    pose.rotation.ravel(),
                    truth.angular_velocity_body,
                    [height_over_ground_m],
                ]
            )
        return {
            name: np.clip(self._latest[name], bounds.low, bounds.high).astype(bounds.dtype)
            for name, bounds in self.bounds.items()
        }


def _number_bounds(name: str) -> Bounds:
    factor, high = _LIMITS[name]
    high = high.astype(np.float32)
    return Bounds(shape=high.shape, low=np.float32(factor) * high, high=high)


def _image_bounds(width: int, height: int) -> Bounds:
    shape = (height, width, 3)
    return Bounds(
        shape=shape, low=np.zeros(shape, np.uint8), high=np.full(shape, 255, dtype=np.uint8)
    )
