"""The synthetic world of examinations, by numpy alone: estimates, maps, a rigid airframe, and a
vehicle that follows its setpoints exactly. Its sensors are in `synthetic_stream`."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.controller.api import Setpoint
from touchdown.estimator.api import Estimate, GridMap, MapView
from touchdown.sim.api import GRAVITY_MPS2, ImuSample, Observation, SensorRig, VehicleModel
from touchdown.sim.frames import Pose, cross, rotation_from_yaw, so3_exp, yaw_from_rotation
from touchdown.sim.typing import Array

TICK_HZ = 600
_SUBSTEPS = 4
CELL_M = 0.25
DISC_XY, DISC_M = (12.0, -9.0), 5.0
"""Middle and radius of the flat disc of `synthetic_map`, m."""
_POND_XY, _POND_M = (-11.0, 8.0), 6.0
_BUMPS_M = 0.35
_BELOW_M = 0.3
"""Depth of a setpoint below the ground at which the rotors carry least."""


def estimate_at(
    time: dict[str, Any],
    pose: Pose,
    velocity: Array | None = None,
    rates: Array | None = None,
    acceleration: Array | None = None,
) -> Estimate:
    """A confident estimate; ``time`` holds ``tick`` and ``time_s``, motion is none by default."""
    none = np.zeros(3)
    return Estimate(
        **time,
        odom_from_body=pose,
        world_from_odom=Pose.identity(),
        velocity_odom=none if velocity is None else velocity.copy(),
        angular_velocity_body=none if rates is None else rates.copy(),
        acceleration_odom=none if acceleration is None else acceleration.copy(),
        position_covariance=1e-4 * np.eye(3),
        rotation_covariance=1e-6 * np.eye(3),
    )


def hovering() -> Estimate:
    """An estimate 15 m above the middle of the map, at rest."""
    pose = Pose(np.eye(3), np.array([1.0, 2.0, 15.0]))
    return estimate_at({"tick": 18000, "time_s": 30.0}, pose)


def _grid(origin: Array, height: Array, seen: NDArray[np.bool_], missing: Any, red: Any) -> GridMap:
    """A grid with what a mapper tells of ``seen`` cells."""
    shape = np.where(seen, 1.0, np.nan)

    def layer(values: Any) -> NDArray[np.float32]:
        return np.asarray(values * shape, np.float32)

    return GridMap(
        origin_xy_m=origin,
        cell_m=CELL_M,
        count=np.where(seen, 12.0, 0.0).astype(np.float32),
        height_m=layer(height),
        height_std_m=layer(0.02),
        min_height_m=layer(height - 0.03),
        max_height_m=layer(height + 0.03),
        rgb=np.stack([layer(red)] * 3, axis=-1),
        intensity=layer(60.0),
        missing=np.where(missing & np.ones_like(seen), 9.0, 0.0).astype(np.float32),
        last_seen_s=np.where(seen, np.float32(20.0), np.float32(-np.inf)),
    )


def synthetic_map(*, mirrored: bool = False, empty: bool = False) -> MapView:
    """A map of 60 m by 60 m about the take-off point: bumps of 0.35 m, a flat disc of 5 m radius at
    (12, -9), a pond of 6 m at (-11, 8) with missing pulses, nothing seen at the rim of 6 m.
    ``mirrored``: x and -x changed; ``empty``: nothing seen at all."""
    cells = 240
    origin = np.full(2, -0.5 * cells * CELL_M)
    at = origin[0] + (np.arange(cells) + 0.5) * CELL_M
    x, y = np.meshgrid(-at if mirrored else at, at)
    disc = np.hypot(x - DISC_XY[0], y - DISC_XY[1]) < DISC_M
    pond = np.hypot(x - _POND_XY[0], y - _POND_XY[1]) < _POND_M
    height = np.where(disc | pond, 0.0, _BUMPS_M * np.sin(1.7 * x + 0.4) * np.sin(1.3 * y))
    seen = (np.maximum(abs(x), abs(y)) < -origin[0] - 6.0) & ~pond & (not empty)
    noise = np.random.default_rng(7).normal(0.0, 0.01, height.shape)
    red = 90.0 + 20.0 * np.sin(x + y)
    grid = _grid(origin, height + noise, seen, pond & (not empty), red)
    return MapView(version=0 if empty else 200, coarse=grid, fine=None)


def flat_map(centre: Array) -> MapView:
    """120 m by 120 m of level ground at z = 0 about ``centre`` (2,), seen everywhere."""
    wide_m = 120.0
    side = round(wide_m / CELL_M)
    noise = np.random.default_rng(5).normal(0.0, 0.005, (side, side))
    grid = _grid(np.floor(centre - 0.5 * wide_m), noise, np.ones((side, side), bool), False, 90.0)
    return MapView(version=1, coarse=grid, fine=grid)


class SyntheticAirframe:
    """A rigid vehicle that flies from rest at ``position`` (3,), hovering; ``step_s`` is the
    control period. Rotors follow their commands with the time constant of the data sheet; there is
    drag but no wind."""

    def __init__(self, vehicle: VehicleModel, position: Array, step_s: float) -> None:
        self._vehicle, self._step_s = vehicle, step_s
        self.position: Array = np.array(position, np.float64)
        self.rotation: Array = np.eye(3)
        self._velocity, self._rates, self._acceleration = np.zeros(3), np.zeros(3), np.zeros(3)
        self._speeds: Array = np.full(len(vehicle.rotor_spin), hover_speed(vehicle))
        self._steps = 0

    def step(self, speeds: Array) -> None:
        """Flies one control period with commanded rotor speeds (R,) rad/s."""
        vehicle, step_s = self._vehicle, self._step_s / _SUBSTEPS
        wanted = np.clip(speeds, 0.0, vehicle.rotor_speed_max)
        follow = 1.0 - np.exp(-step_s / vehicle.motor_time_constant_s)
        before = self._velocity
        x, y = vehicle.rotor_xy_m.T
        spin = vehicle.rotor_spin * vehicle.torque_coefficient
        inertia = vehicle.inertia_kgm2
        gravity = np.array([0.0, 0.0, GRAVITY_MPS2])
        for _ in range(_SUBSTEPS):
            self._speeds = self._speeds + follow * (wanted - self._speeds)
            squared = self._speeds**2
            lift = vehicle.thrust_coefficient * squared
            torque = np.array([y @ lift, -x @ lift, spin @ squared])
            turn = cross(self._rates, inertia * self._rates)
            self._rates = self._rates + step_s * (torque - turn) / inertia
            drag = self.rotation.T @ self._velocity
            force = np.array([0.0, 0.0, lift.sum()]) - vehicle.linear_drag * drag * [1, 1, 0]
            self._velocity = self._velocity + step_s * (
                self.rotation @ force / vehicle.mass_kg - gravity
            )
            self.position = self.position + step_s * self._velocity
            self.rotation = self.rotation @ so3_exp(self._rates * step_s)
        self._acceleration = (self._velocity - before) / self._step_s
        self._steps += 1

    def estimate(self) -> Estimate:
        """The true state as an estimate."""
        time_s = self._steps * self._step_s
        pose = Pose(self.rotation.copy(), self.position.copy())
        time = {"tick": round(time_s * TICK_HZ), "time_s": time_s}
        return estimate_at(time, pose, self._velocity, self._rates, self._acceleration)


def hover_speed(vehicle: VehicleModel) -> float:
    """Rotor speed that carries the weight, rad/s."""
    weight = vehicle.mass_kg * GRAVITY_MPS2
    return float(np.sqrt(weight / len(vehicle.rotor_spin) / vehicle.thrust_coefficient))


class FollowedSetpoints:
    """A vehicle that is where its setpoint is, but for the ground at z = 0, and what its sensors
    and its map would be: no scan and no image ever arrives."""

    def __init__(self, sensors: SensorRig) -> None:
        self._sensors = sensors
        start = sensors.world_from_body_start
        self._low = sensors.vehicle.leg_height_m
        self._hover = hover_speed(sensors.vehicle)
        self._rotors = len(sensors.vehicle.rotor_spin)
        self._yaw = yaw_from_rotation(start.rotation)
        self._step_s = sensors.imu_ticks / sensors.tick_hz
        self._tick = 0
        self.position: Array = start.translation * [1.0, 1.0, 0.0] + [0.0, 0.0, self._low]
        self.velocity: Array = np.zeros(3)
        self._acceleration: Array = np.zeros(3)
        self._carried = 0.0
        self._map = flat_map(self.position[:2])

    @property
    def on_ground(self) -> bool:
        """True where the legs touch."""
        return bool(self.position[2] <= self._low)

    def seen(self) -> tuple[Observation, Estimate, MapView]:
        """What a lander is given now."""
        turn = rotation_from_yaw(self._yaw)
        time: dict[str, Any] = {"tick": self._tick, "time_s": self._tick / self._sensors.tick_hz}
        force = turn.T @ (self._acceleration + [0.0, 0.0, GRAVITY_MPS2])
        mount = self._sensors.body_from_imu.rotation
        imu = ImuSample(**time, angular_velocity=np.zeros(3), specific_force=mount.T @ force)
        obs = Observation(
            **time,
            imu=(imu,) if self._tick else (),
            rotor_speed_radps=np.full(self._rotors, self._hover * np.sqrt(self._carried)),
            battery_fraction=1.0 - 1e-6 * self._tick,
        )
        pose = Pose(turn, self.position.copy())
        estimate = estimate_at(time, pose, self.velocity, None, self._acceleration)
        return obs, estimate, self._map

    def follow(self, setpoint: Setpoint) -> None:
        """Goes where the setpoint is; stays where motors are off."""
        before, speed = self.position, self.velocity
        below = self._low - float(setpoint.position_odom[2])
        if setpoint.motors_on:
            self._yaw = float(setpoint.yaw_odom)
            if setpoint.thrust_limit is None:
                self.position = np.array(setpoint.position_odom, np.float64)
        self.position = np.maximum(self.position, [-np.inf, -np.inf, self._low])
        limit = np.inf if setpoint.thrust_limit is None else setpoint.thrust_limit
        fraction = 1.0 - min(max(below / _BELOW_M, 0.0), 0.8) if self.on_ground else 1.0
        self._carried = min(fraction, limit) if setpoint.motors_on else 0.0
        self.velocity = (self.position - before) / self._step_s
        self._acceleration = (self.velocity - speed) / self._step_s
        self._tick += self._sensors.imu_ticks
