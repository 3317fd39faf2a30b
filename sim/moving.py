"""Poses of bodies over time; moving bodies are mocap bodies on closed polylines, a pure function
of time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numba import njit

from touchdown.scenes.api import MovingBody, Scene
from touchdown.sim.frames import Pose, matrix_from_quat_wxyz, quat_wxyz_from_matrix
from touchdown.sim.typing import Array


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
    def at_rest(world_from_body: Pose, times_s: Array) -> BodyTrack:
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
        self._paths = [_Path(body, scene.model) for body in scene.moving]

    def write(self, data: Any, time_s: float) -> None:
        """Puts the mocap bodies of an MjData where they are at ``time_s``."""
        if not self._paths:
            return
        positions, quats, times_s = data.mocap_pos, data.mocap_quat, np.array([time_s])
        for path in self._paths:
            at = slice(path.mocap_id, path.mocap_id + 1)
            path.locate(times_s, positions[at], quats[at])

    def tracks(self, times_s: Array) -> dict[str, BodyTrack]:
        """By body name: the poses at (M,) times."""
        return {path.name: path.at(times_s) for path in self._paths}


class _Path:
    def __init__(self, body: MovingBody, model: Any) -> None:
        body_id = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, body.body_name)
        if body_id < 0 or model.body_mocapid[body_id] < 0:
            raise ValueError(
                f"moving body {body.body_name!r} is not a mocap body of the scene; "
                'give it mocap="true"'
            )
        closed = np.vstack([body.path_world, body.path_world[:1]])
        edges = np.diff(closed, axis=0)
        lengths = np.linalg.norm(edges, axis=1)
        kept = lengths > 1e-9
        if not kept.any():
            raise ValueError(f"the path of moving body {body.body_name!r} has no length")
        self.name = body.body_name
        self.mocap_id = int(model.body_mocapid[body_id])
        self._starts = np.ascontiguousarray(closed[:-1][kept])
        self._directions = edges[kept] / lengths[kept, None]
        self._arc = np.concatenate([[0.0], np.cumsum(lengths[kept])])
        self._speed = body.speed_mps
        self._start = body.start_m

    def at(self, times_s: Array) -> BodyTrack:
        positions = np.empty((len(times_s), 3))
        quats = np.empty((len(times_s), 4))
        self.locate(times_s, positions, quats)
        return BodyTrack(times_s=times_s, positions=positions, quats_wxyz=quats)

    def locate(self, times_s: Array, positions: Array, quats_wxyz: Array) -> None:
        """Writes (M, 3) and (M, 4) at (M,) times."""
        travelled = self._start + self._speed * times_s
        _locate(self._starts, self._directions, self._arc, travelled, positions, quats_wxyz)


@njit(cache=True, error_model="numpy")
def _locate(
    starts: Array, directions: Array, arc: Array, travelled: Array, positions: Array, quats: Array
) -> None:
    for m in range(len(travelled)):
        distance = travelled[m] % arc[-1]
        edge = min(max(np.searchsorted(arc, distance, side="right") - 1, 0), len(starts) - 1)
        for axis in range(3):
            way = (distance - arc[edge]) * directions[edge, axis]
            positions[m, axis] = starts[edge, axis] + way
        half_yaw = 0.5 * np.arctan2(directions[edge, 1], directions[edge, 0])
        quats[m, 0], quats[m, 3] = np.cos(half_yaw), np.sin(half_yaw)
        quats[m, 1], quats[m, 2] = 0.0, 0.0
