"""A world in which the vehicle is carried along a trajectory that somebody flew: real motion, with
simulated sensors and a known truth. Nothing steers it, and nothing is in its way."""

import math
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.interpolate import make_lsq_spline
from scipy.spatial.transform import Rotation

from touchdown.scenes.api import Scene
from touchdown.sim import api
from touchdown.sim.frames import rotation_from_yaw, yaw_from_rotation
from touchdown.sim.typing import Array
from touchdown.sim.world import MujocoWorld

REST_S, EASE_S = 1.0, 2.0
"""at the first pose, before the trajectory gathers speed"""
_KNOT_S = 0.05
"""between knots of the spline: what measured truth holds of shorter motion is its noise"""
_DEGREE = 5
_FEWEST = 20
_LARGEST_GAP_S = 0.5
_UPRIGHT_RAD = math.radians(15.0)
"""of the mean thrust from the body's z axis, within which z is taken to be up"""
_STANDING_M = 0.3
"""of the first pose above the lowest, within which the trajectory starts on the ground"""
_DEPARTED_M = 0.05
_CLEAR_M = 0.02
_LOOK_S = 0.1
_ABOVE_M = 500.0


class Motion(NamedTuple):
    """The state of the body at N instants."""

    position: Array
    """(N, 3) m, world"""
    quat: Array
    """(N, 4) world_from_body, wxyz"""
    velocity: Array
    """(N, 3) m/s, world"""
    rate: Array
    """(N, 3) rad/s, body"""
    thrust: Array
    """(N,) m/s^2, length of the specific force"""


class FlownPath:
    """A smooth motion through measured poses, which starts at rest.

    ``times_s`` (N,) ascending, ``positions`` (N, 3) m, ``quats_wxyz`` (N, 4) world_from_body, world
    z up. The body's axes may be any: where the mean thrust is not along z, z is turned to it. The
    first pose comes to lie at the origin, heading along x. Raises ValueError for fewer than 20
    poses and a gap of more than half a second."""

    def __init__(self, times_s: Array, positions: Array, quats_wxyz: Array) -> None:
        times, rows = np.unique(
            times_s - times_s[0] if len(times_s) else times_s, return_index=True
        )
        if len(times) < _FEWEST:
            raise ValueError(f"the trajectory has {len(times)} poses; give {_FEWEST} or more")
        gap = int(np.argmax(np.diff(times)))
        if times[gap + 1] - times[gap] > _LARGEST_GAP_S:
            raise ValueError(
                f"the trajectory has no pose between {times[gap]:.2f} and {times[gap + 1]:.2f} s; "
                f"give one at least every {_LARGEST_GAP_S} s, or cut it there"
            )
        every = max(2, round(_KNOT_S / float(np.median(np.diff(times)))))
        inner = times[every : -max(every, 3) : every]
        knots = np.concatenate([[times[0]] * (_DEGREE + 1), inner, [times[-1]] * (_DEGREE + 1)])
        quats = quats_wxyz[rows].copy()
        flips = np.cumprod(np.sign(np.einsum("ij,ij->i", quats[1:], quats[:-1])))
        quats[1:] *= flips[:, None]
        self._place = make_lsq_spline(times, positions[rows], knots, _DEGREE)
        self._turn = make_lsq_spline(times, quats, knots, _DEGREE)
        self.duration_s = REST_S + EASE_S + float(times[-1]) - 0.5 * EASE_S
        self._level = np.eye(3)
        self._level = self._thrust_axes(times)
        start = self._rotation(np.zeros(1)).as_matrix()[0]
        self._to_world = rotation_from_yaw(-yaw_from_rotation(start))
        self._origin = self._place(0.0)

    def motion(self, times_s: Array) -> Motion:
        """The motion at (N,) times after the start; the last pose, at rest, beyond the end."""
        at, speed, gain = self._eased(times_s)
        first, second = self._place.derivative(1), self._place.derivative(2)
        velocity = first(at) * speed[:, None]
        acceleration = second(at) * speed[:, None] ** 2 + first(at) * gain[:, None]
        force = acceleration + [0.0, 0.0, api.GRAVITY_MPS2]
        turned = Rotation.from_matrix(self._to_world) * self._rotation(at)
        return Motion(
            position=(self._place(at) - self._origin) @ self._to_world.T,
            quat=turned.as_quat(scalar_first=True),
            velocity=velocity @ self._to_world.T,
            rate=self._rate(at) * speed[:, None],
            thrust=np.linalg.norm(force, axis=1),
        )

    @staticmethod
    def _ramp(u: Array) -> Array:
        return u**3 - 0.5 * u**4

    def _eased(self, times_s: Array) -> tuple[Array, Array, Array]:
        """Place on the trajectory (N,) s, its first and second derivative by time."""
        u = np.clip((times_s - REST_S) / EASE_S, 0.0, 1.0)
        at = EASE_S * self._ramp(u) + np.maximum(times_s - REST_S - EASE_S, 0.0)
        end = float(self._place.t[-1])
        moving = at < end
        speed = np.where(moving, 3.0 * u**2 - 2.0 * u**3, 0.0)
        gain = np.where(moving, 6.0 * u * (1.0 - u) / EASE_S, 0.0)
        return np.minimum(at, end), speed, gain

    def _rotation(self, at: Array) -> Rotation:
        turned = Rotation.from_quat(self._turn(at), scalar_first=True)
        return turned * Rotation.from_matrix(self._level)

    def _rate(self, at: Array) -> Array:
        """(N, 3) rad/s, body: twice the vector part of the conjugate times the derivative."""
        q, d = self._turn(at), self._turn.derivative(1)(at)
        square = np.einsum("ij,ij->i", q, q)[:, None]
        vector = q[:, :1] * d[:, 1:] - d[:, :1] * q[:, 1:] - np.cross(q[:, 1:], d[:, 1:])
        return 2.0 * vector / square @ self._level

    def _thrust_axes(self, times: Array) -> Array:
        """(3, 3) old body from new: z along the mean thrust, x as near to the old x as it may."""
        force = self._place.derivative(2)(times) + [0.0, 0.0, api.GRAVITY_MPS2]
        up = self._rotation(times).inv().apply(force).mean(axis=0)
        up /= np.linalg.norm(up)
        if math.acos(min(float(up[2]), 1.0)) < _UPRIGHT_RAD:
            return np.eye(3)
        ahead = np.eye(3)[0 if abs(up[0]) < 0.8 else 1]
        ahead = ahead - (ahead @ up) * up
        ahead /= np.linalg.norm(ahead)
        return np.column_stack([ahead, np.cross(up, ahead), up])


class CarriedWorld(MujocoWorld):
    """As `MujocoWorld`, but for its motion, which is that of ``path`` from the take-off spot.

    The rotors stand until it departs from the first pose, and then turn as fast as the thrust asks
    for, which the vibration and the battery follow; commands are not. ``height_m``: of the legs at
    the lowest pose over the take-off ground; None: the vehicle starts standing where the first pose
    is about the lowest, else the lowest is 2 m up. Raises ValueError where the path leaves the
    scene or runs through something."""

    def __init__(
        self, scene: Scene, params: api.WorldParams, seed: int, path: FlownPath,
        height_m: float | None = None, drawn: bool = False,
    ) -> None:  # fmt: skip
        self._path: FlownPath | None = None
        super().__init__(scene, params, seed, drawn=drawn)
        self._motion = self._placed(path, height_m)
        self._path = path
        away = np.linalg.norm(self._motion.position - self._motion.position[0], axis=1)
        self._departure = int(np.argmax(away > _DEPARTED_M))
        self._check_clear()
        self.rig = self._make_rig_at_start()

    @property
    def duration_s(self) -> float:
        """until the trajectory ends"""
        assert self._path is not None
        return self._path.duration_s

    def reset(self) -> api.Observation:
        """Returns to tick 0, at the first pose."""
        obs = super().reset()
        if self._path is None:  # of the constructor, before there is a path
            return obs
        self._carry(0)
        mujoco.mj_forward(self._model, self._data)
        self._mark_start()
        self._truth = None
        return obs

    def _make_rig_at_start(self) -> api.SensorRig:
        self.reset()
        return self._make_rig()

    def _placed(self, path: FlownPath, height_m: float | None) -> Motion:
        ticks = np.arange(math.ceil(path.duration_s * self._sim.tick_hz) + self._sim.tick_hz)
        own = path.motion(ticks / self._sim.tick_hz)
        heading = rotation_from_yaw(self._scene.takeoff_yaw)
        turned = Rotation.from_matrix(heading) * Rotation.from_quat(own.quat, scalar_first=True)
        start = self._position.copy()
        drop = float(own.position[:, 2].min())
        if height_m is not None:
            start[2] += height_m - drop
        elif drop < -_STANDING_M:
            start[2] += 2.0 - drop
        else:
            start[2] -= min(drop, 0.0)
        return Motion(
            position=own.position @ heading.T + start,
            quat=turned.as_quat(scalar_first=True),
            velocity=own.velocity @ heading.T,
            rate=own.rate,
            thrust=own.thrust,
        )

    def _check_clear(self) -> None:
        """Looks down on the path from high above: nothing is higher than the vehicle's legs."""
        hz = self._sim.tick_hz
        probe = np.zeros(3)
        for tick in range(hz, len(self._motion.thrust), round(_LOOK_S * hz)):
            position = self._motion.position[tick]
            low, high = self._scene.bounds_xy_m
            if not ((low <= position[:2]) & (position[:2] <= high)).all():
                raise ValueError(
                    f"the trajectory leaves '{self._scene.name}' after {tick / hz:.0f} s; take a "
                    "larger scene or cut it there"
                )
            probe[:] = *position[:2], position[2] + _ABOVE_M
            below = self._ground.clearance(self._data, probe) - _ABOVE_M
            short = self._vehicle.leg_height_m + _CLEAR_M - below
            if short > 2.0 * _CLEAR_M and position[2] > self._motion.position[0, 2] + _CLEAR_M:
                raise ValueError(
                    f"the trajectory runs {short:.1f} m into something after {tick / hz:.0f} s; "
                    "raise it by survey.trajectory_lowest_m"
                )

    def _carry(self, tick: int) -> None:
        motion, row = self._motion, min(tick, len(self._motion.thrust) - 1)
        self._position[:], self._quat[:] = motion.position[row], motion.quat[row]
        self._velocity[:], self._angular_velocity[:] = motion.velocity[row], motion.rate[row]
        speed = 0.0
        if row >= self._departure:
            hover = math.sqrt(self._hover_square / self._count)
            speed = hover * math.sqrt(motion.thrust[row] / api.GRAVITY_MPS2)
            speed = min(max(speed, self._vehicle.rotor_speed_min), self._vehicle.rotor_speed_max)
        self._rotors.speeds[:] = speed

    def _advance_tick(self, clearance_m: float) -> None:
        self._tick += 1
        self._carry(self._tick)
        self._data.time = self._tick / self._sim.tick_hz
        if self._tick % self._sim.control_ticks == 0:
            mujoco.mj_kinematics(self._model, self._data)
