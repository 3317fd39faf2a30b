"""Things that move by themselves: mocap bodies on closed polylines, a pure function of time."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numba import njit
from numpy.typing import NDArray

from touchdown.scenes.api import MovingBody, Scene

Array = NDArray[np.float64]


class MovingBodies:
    """All moving bodies of a scene. ValueError: a body is not a mocap body, or its path has no
    length."""

    def __init__(self, scene: Scene) -> None:
        self._paths = [_Path(body, scene.model) for body in scene.moving]

    def write(self, data: Any, time_s: float) -> None:
        """Puts the mocap bodies of an MjData where they are at ``time_s``."""
        if not self._paths:
            return
        positions, quats = data.mocap_pos, data.mocap_quat
        for path in self._paths:
            path.put(time_s, positions[path.mocap_id], quats[path.mocap_id])

    def tracks(self, times_s: Array) -> dict[str, tuple[Array, Array]]:
        """By body name: positions (M, 3) world metres and quaternions wxyz (M, 4) at (M,) times."""
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

    def put(self, time_s: float, position: Array, quat_wxyz: Array) -> None:
        """Writes (3,) and (4,) of one instant."""
        travelled = self._start + self._speed * time_s
        _locate(self._starts, self._directions, self._arc, travelled, position, quat_wxyz)

    def at(self, times_s: Array) -> tuple[Array, Array]:
        positions = np.empty((len(times_s), 3))
        quats = np.empty((len(times_s), 4))
        travelled = self._start + self._speed * times_s
        _locate_each(self._starts, self._directions, self._arc, travelled, positions, quats)
        return positions, quats


@njit(cache=True)
def _locate(
    starts: Array, directions: Array, arc: Array, travelled: float, position: Array, quat: Array
) -> None:
    distance = travelled % arc[-1]
    edge = min(max(np.searchsorted(arc, distance, side="right") - 1, 0), len(starts) - 1)
    for axis in range(3):
        position[axis] = starts[edge, axis] + (distance - arc[edge]) * directions[edge, axis]
    half_yaw = 0.5 * np.arctan2(directions[edge, 1], directions[edge, 0])
    quat[0], quat[1], quat[2], quat[3] = np.cos(half_yaw), 0.0, 0.0, np.sin(half_yaw)


@njit(cache=True)
def _locate_each(
    starts: Array, directions: Array, arc: Array, travelled: Array, positions: Array, quats: Array
) -> None:
    for m in range(len(travelled)):
        _locate(starts, directions, arc, travelled[m], positions[m], quats[m])
