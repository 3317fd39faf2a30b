"""Poses of bodies over time; moving bodies are mocap bodies on polylines, pure functions of time
but for intruders, which are sent once."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numba import njit

from touchdown.scenes.api import CARRIER, Limb, MovingBody, Scene
from touchdown.sim.api import MovingFrame
from touchdown.sim.frames import (
    Pose,
    matrix_from_quat_wxyz,
    quat_wxyz_from_matrix,
    so3_log,
)
from touchdown.sim.typing import Array, Indices

OUT_OF_THE_WORLD_M = -50.0
"""height of an intruder before it is sent"""
_DIFFERENCE_S = 1e-3
_GAIT_MPS = 0.3
"""speed from which on limbs swing by their whole amplitude"""


@dataclass(frozen=True, kw_only=True, slots=True)
class BodyTrack:
    """World poses of one body at ascending instants."""

    times_s: Array
    """(M,)"""
    positions: Array
    """(M, 3) m, body origin, world frame"""
    quats_wxyz: Array
    """(M, 4) world_from_body"""

    @staticmethod
    def at_rest(world_from_body: Pose, times_s: Array) -> "BodyTrack":
        """A body that keeps one pose at all of (M,) ``times_s``."""
        quat_wxyz = quat_wxyz_from_matrix(world_from_body.rotation)
        return BodyTrack(
            times_s=times_s,
            positions=np.tile(world_from_body.translation, (len(times_s), 1)),
            quats_wxyz=np.tile(quat_wxyz, (len(times_s), 1)),
        )

    @property
    def last_pose(self) -> Pose:
        """world_from_body at the last instant."""
        return Pose(matrix_from_quat_wxyz(self.quats_wxyz[-1]), self.positions[-1].copy())


class MovingBodies:
    """All moving bodies of a scene. Raises ValueError where one is no mocap body or its path has no
    length."""

    def __init__(self, scene: Scene) -> None:
        self._bodies = tuple(scene.moving)
        ids = [_mocap_id(scene.model, body) for body in self._bodies]
        self._ids = np.array(ids, np.int64)
        alive = [(i, body) for i, body in zip(ids, self._bodies, strict=True)
                 if body.alive and body.walker == body.body_name]  # fmt: skip
        self._living = np.array([i for i, _ in alive], np.int64)
        self._intruders = np.array([i for i, body in alive if body.intruder], np.int64)
        self._paths = _pack(self._bodies)
        self._carriers = [
            (index, int(scene.model.body(f"{body.body_name}{CARRIER}").id))
            for index, body in enumerate(self._bodies)
            if body.carries
        ]

    def write(self, data: Any, time_s: float) -> None:
        """Puts the mocap bodies of an MjData where they are at ``time_s``, and what carries a
        vehicle with the velocity that it has there."""
        if self._bodies:
            _locate(time_s, self._ids, *self._paths, data.mocap_pos, data.mocap_quat)
            times = np.array([time_s])
            for row, body in zip(self._ids, self._bodies, strict=True):
                if body.sway is not None:
                    places = data.mocap_pos[row : row + 1], data.mocap_quat[row : row + 1]
                    _sway(body, times, *places)
        for index, body_id in self._carriers:
            motion = self._motion(index, time_s)
            joint = data.model.body_jntadr[body_id]
            at, speed = data.model.jnt_qposadr[joint], data.model.jnt_dofadr[joint]
            data.qpos[at : at + 3] = motion.world_from_frame.translation
            data.qpos[at + 3 : at + 7] = data.mocap_quat[self._ids[index]]
            data.qvel[speed : speed + 3] = motion.velocity_world
            turned = motion.world_from_frame.rotation.T @ motion.angular_velocity_world
            data.qvel[speed + 3 : speed + 6] = turned

    def deck(self, time_s: float) -> MovingFrame | None:
        """Pose and motion of the body that carries a vehicle; None where there is none."""
        return self._motion(self._carriers[0][0], time_s) if self._carriers else None

    def _motion(self, index: int, time_s: float) -> MovingFrame:
        """By differences over two milliseconds."""
        times = time_s + _DIFFERENCE_S * np.array([-1.0, 0.0, 1.0])
        track = self.tracks(times)[self._bodies[index].body_name]
        first, now, last = (matrix_from_quat_wxyz(quat) for quat in track.quats_wxyz)
        moved = track.positions[2] - track.positions[0]
        return MovingFrame(
            world_from_frame=Pose(now, track.positions[1]),
            velocity_world=moved / (2.0 * _DIFFERENCE_S),
            angular_velocity_world=so3_log(last @ first.T) / (2.0 * _DIFFERENCE_S),
        )

    def living(self, data: Any, intruders: bool = False) -> Array:
        """(N, 3) places of persons, riders and animals in the world, on the ground; ``intruders``:
        of those alone."""
        places = data.mocap_pos[self._intruders if intruders else self._living]
        return np.asarray(places[places[:, 2] > OUT_OF_THE_WORLD_M])

    def tracks(self, times_s: Array) -> dict[str, BodyTrack]:
        """By body name: the poses at (M,) times."""
        count, bodies = len(times_s), len(self._bodies)
        positions, quats = np.empty((count, bodies, 3)), np.empty((count, bodies, 4))
        for m, time_s in enumerate(times_s):
            _locate(time_s, np.arange(bodies), *self._paths, positions[m], quats[m])
        for i, body in enumerate(self._bodies):
            if body.sway is not None:
                _sway(body, times_s, positions[:, i], quats[:, i])
        return {
            body.body_name: BodyTrack(
                times_s=times_s,
                positions=np.ascontiguousarray(positions[:, i]),
                quats_wxyz=np.ascontiguousarray(quats[:, i]),
            )
            for i, body in enumerate(self._bodies)
        }

    def send(self, walker: str, path_world: Array, times_s: Array) -> None:
        """Sends the intruder ``walker`` along (K, 3) vertices at (K,) times; poses before the first
        time stay as they were, so that what is drawn of the past stays the same."""
        self._bodies = tuple(
            replace(body, path_world=path_world, times_s=times_s)
            if body.walker == walker else body
            for body in self._bodies
        )  # fmt: skip
        self._paths = _pack(self._bodies)


def _sway(body: MovingBody, times_s: Array, positions: Array, quats: Array) -> None:
    """Moves (M, 3) positions and turns (M, 4) quaternions of ``body`` as it sways at (M,) times."""
    assert body.sway is not None
    heave, roll, pitch = body.sway.at(times_s).T
    positions[:, 2] += heave
    for row, (x, y) in enumerate(zip(0.5 * roll, 0.5 * pitch, strict=True)):
        heading = quats[row].copy()
        mujoco.mju_mulQuat(quats[row], np.array([math.cos(y), 0.0, math.sin(y), 0.0]),
                           np.array([math.cos(x), math.sin(x), 0.0, 0.0]))  # fmt: skip
        mujoco.mju_mulQuat(quats[row], heading, quats[row].copy())


class _Paths(NamedTuple):
    first: Indices
    """(B + 1,) first edge of each body, and the number of all"""
    starts: Array
    directions: Array
    """(E, 3) of edges: where they begin, unit vectors"""
    arc: Array
    """(E, 2) arc length at both ends"""
    times_s: Array
    """(E, 2) at both ends; NaN on closed paths"""
    motion: Array
    """(B, 3) speed and start on closed paths; time before which it is out of the world"""
    limbs: Array
    """(B, 7) joint, swing, way per radian, phase, bend"""


def _pack(bodies: Sequence[MovingBody]) -> _Paths:
    edges = [_edges(body) for body in bodies]
    first = np.cumsum([0, *(len(starts) for starts, *_ in edges)])
    stacked = [np.concatenate(arrays) for arrays in zip(*edges, strict=True)] if edges else []
    starts, directions, arc, times_s = stacked or [np.zeros((0, n)) for n in (3, 3, 2, 2)]
    motion = [[body.speed_mps, body.start_m, _sent_s(body)] for body in bodies]
    limbs = [_numbers(body.limb or Limb(joint_m=np.zeros(3))) for body in bodies]
    return _Paths(first, starts, directions, arc, times_s,
                  np.array(motion).reshape(-1, 3), np.array(limbs).reshape(-1, 7))  # fmt: skip


def _sent_s(body: MovingBody) -> float:
    if not body.intruder:
        return -math.inf
    return math.inf if body.times_s is None else float(body.times_s[0])


def _numbers(limb: Limb) -> list[float]:
    angles = [math.radians(a) for a in (limb.swing_deg, limb.phase_deg, limb.bend_deg)]
    return [*limb.joint_m, angles[0], 2.0 * math.pi / limb.stride_m, *angles[1:]]


def _edges(body: MovingBody) -> tuple[Array, Array, Array, Array]:
    """Starts, directions, arc lengths and times of the edges that have a length or take a time."""
    if len(body.path_world) == 1:
        heading = np.array([[math.cos(body.yaw), math.sin(body.yaw), 0.0]])
        never = np.full((1, 2), np.inf)
        return body.path_world, heading, np.zeros((1, 2)), never
    closed = body.times_s is None
    path = np.vstack([body.path_world, body.path_world[:1]]) if closed else body.path_world
    steps = np.diff(path, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    kept = lengths > 1e-9
    if not kept.any():
        raise ValueError(f"the path of moving body {body.body_name!r} has no length")
    arc = np.concatenate([[0.0], np.cumsum(lengths)])
    if body.times_s is None:
        times_s = np.full((len(steps), 2), np.nan)
    else:
        times_s = np.column_stack([body.times_s[:-1], body.times_s[1:]])
        moving = np.flatnonzero(kept)  # one that waits looks the way it came, at first that it goes
        before = np.maximum(np.searchsorted(moving, np.arange(len(steps)), side="right") - 1, 0)
        steps, lengths = steps[moving[before]], lengths[moving[before]]
        kept = np.ones(len(steps), bool)
    ends = np.column_stack([arc[:-1], arc[1:]])
    directions = steps[kept] / lengths[kept, None]
    return np.ascontiguousarray(path[:-1][kept]), directions, ends[kept], times_s[kept]


def _mocap_id(model: Any, body: MovingBody) -> int:
    body_id = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, body.body_name)
    if body_id < 0 or model.body_mocapid[body_id] < 0:
        raise ValueError(
            f'moving body {body.body_name!r} is not a mocap body of the scene; give it mocap="true"'
        )
    return int(model.body_mocapid[body_id])


@njit(cache=True, error_model="numpy")
def _locate(
    time_s: float,
    rows: Indices,
    first: Indices,
    starts: Array,
    directions: Array,
    arc: Array,
    times_s: Array,
    motion: Array,
    limbs: Array,
    positions: Array,
    quats: Array,
) -> None:
    """Writes the pose of body b at ``time_s`` into row ``rows[b]``."""
    for b in range(len(rows)):
        low, high, row = first[b], first[b + 1], rows[b]
        edge, speed = low, motion[b, 0]
        if np.isnan(times_s[low, 0]):
            travelled = (motion[b, 1] + speed * time_s) % arc[high - 1, 1]
            while edge < high - 1 and travelled >= arc[edge, 1]:
                edge += 1
        else:
            while edge < high - 1 and time_s >= times_s[edge, 1]:
                edge += 1
            begin, end = times_s[edge]
            since = min(max(time_s - begin, 0.0), end - begin) if end > begin else 0.0
            speed = 0.0
            if end > begin and begin <= time_s < end:
                speed = (arc[edge, 1] - arc[edge, 0]) / (end - begin)
            way = arc[edge, 1] - arc[edge, 0]
            travelled = arc[edge, 0] + (way * since / (end - begin) if end > begin else 0.0)
        along = travelled - arc[edge, 0]
        half = 0.5 * np.arctan2(directions[edge, 1], directions[edge, 0])
        c, s = np.cos(half), np.sin(half)
        gait = min(speed / _GAIT_MPS, 1.0)
        bend = limbs[b, 6] + gait * limbs[b, 3] * np.sin(travelled * limbs[b, 4] + limbs[b, 5])
        ch, sh = np.cos(0.5 * bend), np.sin(0.5 * bend)
        quats[row, 0], quats[row, 1] = c * ch, -s * sh
        quats[row, 2], quats[row, 3] = c * sh, s * ch
        cos, sin = c * c - s * s, 2.0 * s * c
        x, y = limbs[b, 0], limbs[b, 1]
        positions[row, 0] = starts[edge, 0] + along * directions[edge, 0] + cos * x - sin * y
        positions[row, 1] = starts[edge, 1] + along * directions[edge, 1] + sin * x + cos * y
        positions[row, 2] = starts[edge, 2] + along * directions[edge, 2] + limbs[b, 2]
        if time_s < motion[b, 2]:
            positions[row] = 0.0
            positions[row, 2] = OUT_OF_THE_WORLD_M
            quats[row] = 0.0
            quats[row, 0] = 1.0
