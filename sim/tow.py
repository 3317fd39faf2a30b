"""Camera and LIDAR towed along a path at its planned poses: a survey without a flight.

No physics, no control and no estimate take part, so a survey costs what its rays and pixels cost,
and the poses are true by construction.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import Scene
from touchdown.sim.airframe.vehicle import sensor_poses
from touchdown.sim.api import (
    GRAVITY_MPS2,
    CameraImage,
    CameraParams,
    LidarParams,
    LidarScan,
    SimParams,
)
from touchdown.sim.camera.sensor import CameraSensor
from touchdown.sim.frames import (
    Pose,
    matrix_from_quat_wxyz,
    quat_wxyz_from_matrix,
    rotation_from_yaw,
)
from touchdown.sim.lidar.sensor import LidarSensor
from touchdown.sim.moving import MovingBodies

Array = NDArray[np.float64]


class Path(Protocol):
    """A position over time, world frame."""

    @property
    def duration_s(self) -> float: ...

    def sample(self, t: float) -> tuple[Array, Array, Array]:
        """Position (3,) m, velocity (3,) m/s, acceleration (3,) m/s^2 at ``t`` seconds."""
        ...


@dataclass(frozen=True, kw_only=True, slots=True)
class TowedLook:
    """One scan, the picture taken in its middle if one was, and the poses during it."""

    scan: LidarScan
    image: CameraImage | None
    times_s: Array
    """(N,) from the scan's start to its end"""
    positions_world: Array
    """(N, 3) of the body origin"""
    quats_wxyz: Array
    """(N, 4) world_from_body"""

    @property
    def world_from_body(self) -> Pose:
        """At the end of the scan."""
        return Pose(matrix_from_quat_wxyz(self.quats_wxyz[-1]), self.positions_world[-1].copy())


class SensorTow:
    """The sensors of the vehicle of ``scene``. ``close`` frees the camera; call it, like ``look``,
    in one thread. Noise is that of the parameters, keyed by the instant."""

    def __init__(
        self,
        scene: Scene,
        *,
        sim: SimParams,
        camera: CameraParams,
        lidar: LidarParams,
        seed: int,
    ) -> None:
        self._model, self._sim = scene.model, sim
        self._data = mujoco.MjData(scene.model)
        self._moving = MovingBodies(scene)
        self._camera = CameraSensor(scene, camera, seed)
        self._lidar = LidarSensor(scene, lidar, seed)
        self._body_from_lidar = sensor_poses(scene.model)[1]

    def look(
        self, start_tick: int, path: Path, path_start_s: float, yaw: float, *, picture: bool = True
    ) -> TowedLook:
        """The scan that begins at ``start_tick`` and its picture, on ``path``, which begins at
        ``path_start_s``; heading ``yaw`` (rad), thrust along the path's acceleration."""
        ticks, hz = self._sim.lidar_scan_ticks, self._sim.tick_hz
        end_tick = start_tick + ticks
        times_s = np.arange(start_tick, end_tick + 1) / hz
        sampled = [path.sample(float(t)) for t in times_s - path_start_s]
        positions = np.array([position for position, _, _ in sampled])
        quats = np.array([_attitude(acceleration, yaw) for _, _, acceleration in sampled])
        scan = self._lidar.scan(
            start_tick,
            end_tick,
            hz,
            times_s,
            positions,
            quats,
            self._body_from_lidar,
            self._moving.tracks(times_s),
        )
        middle = ticks // 2
        image = None
        if picture:
            image = self._picture(start_tick + middle, positions[middle], quats[middle])
        return TowedLook(
            scan=scan, image=image, times_s=times_s, positions_world=positions, quats_wxyz=quats
        )

    def close(self) -> None:
        self._camera.close()

    def _picture(self, tick: int, position: Array, quat_wxyz: Array) -> CameraImage:
        self._data.qpos[:3] = position
        self._data.qpos[3:7] = quat_wxyz
        self._moving.write(self._data, tick / self._sim.tick_hz)
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        rgb = self._camera.render(self._camera.snapshot(self._data), tick)
        return CameraImage(tick=tick, time_s=tick / self._sim.tick_hz, rgb=rgb)


def _attitude(acceleration: Array, yaw: float) -> Array:
    """Quaternion wxyz of the attitude that gives ``acceleration`` (3,) by thrust along body z."""
    up = acceleration + np.array([0.0, 0.0, GRAVITY_MPS2])
    up /= np.linalg.norm(up)
    ahead = rotation_from_yaw(yaw)[:, 0]
    left = np.cross(up, ahead)
    left /= np.linalg.norm(left)
    return quat_wxyz_from_matrix(np.column_stack([np.cross(left, up), left, up]))
