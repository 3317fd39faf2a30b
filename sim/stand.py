"""Camera and LIDAR of a vehicle that hangs still while something is moved in front of it."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import Scene
from touchdown.sim.airframe.vehicle import sensor_poses
from touchdown.sim.api import CameraIntrinsics, CameraParams, LidarParams, LidarScan, SimParams
from touchdown.sim.camera.sensor import CameraSensor
from touchdown.sim.frames import Pose, quat_wxyz_from_matrix
from touchdown.sim.lidar.sensor import LidarSensor

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class StandView:
    """What both sensors saw of one placement."""

    rgb: NDArray[np.uint8]
    """(H, W, 3)"""
    scans: tuple[LidarScan, ...]
    """in the order in which they were taken"""


class SensorStand:
    """The vehicle of ``scene`` level, ``height_m`` above where it stands, and the mocap body
    ``board`` in front of it. ``close`` frees the camera. Noise is that of the parameters; every
    look happens later than the one before, so that noise and scan pattern do not repeat.

    Raises ValueError for a scene without such a body.
    """

    intrinsics: CameraIntrinsics
    world_from_body: Pose
    body_from_lidar: Pose
    body_from_camera: Pose

    def __init__(
        self,
        scene: Scene,
        *,
        sim: SimParams,
        camera: CameraParams,
        lidar: LidarParams,
        seed: int,
        height_m: float,
        board: str,
    ) -> None:
        model = scene.model
        body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, board)
        if body < 0 or model.body_mocapid[body] < 0:
            raise ValueError(f"scene '{scene.name}' has no mocap body '{board}'")
        self._model, self._sim, self._board = model, sim, board
        self._mocap = int(model.body_mocapid[body])
        self._data = mujoco.MjData(model)
        self._data.qpos[2] += height_m
        self._camera = CameraSensor(scene, camera, seed)
        self._lidar = LidarSensor(scene, lidar, seed)
        self._tick = 0
        self.intrinsics = self._camera.intrinsics()
        _, self.body_from_lidar, self.body_from_camera, _ = sensor_poses(model)
        self.world_from_body = Pose(np.eye(3), self._data.qpos[:3].copy())

    def look(self, world_from_board: Pose, seconds: float) -> StandView:
        """A picture, and the scans of ``seconds``, of the board held at ``world_from_board``."""
        data = self._data
        data.mocap_pos[self._mocap] = world_from_board.translation
        data.mocap_quat[self._mocap] = quat_wxyz_from_matrix(world_from_board.rotation)
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_camlight(self._model, data)
        rgb = self._camera.render(self._camera.snapshot(data), self._tick)
        count = max(1, round(seconds * self._sim.tick_hz / self._sim.lidar_scan_ticks))
        return StandView(rgb=rgb, scans=tuple(self._scan(world_from_board) for _ in range(count)))

    def close(self) -> None:
        """Call it in the thread that looked."""
        self._camera.close()

    def _scan(self, world_from_board: Pose) -> LidarScan:
        start, self._tick = self._tick, self._tick + self._sim.lidar_scan_ticks
        times_s = np.array([start, self._tick]) / self._sim.tick_hz
        return self._lidar.scan(
            start,
            self._tick,
            self._sim.tick_hz,
            times_s,
            np.tile(self.world_from_body.translation, (2, 1)),
            np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)),
            self.body_from_lidar,
            {self._board: world_from_board},
        )
