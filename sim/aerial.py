"""A camera anywhere over a scene, with depth and geom of every pixel, and a LIDAR beside it: what
they see without a flight."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import Scene
from touchdown.sim.airframe.vehicle import sensor_poses
from touchdown.sim.api import CameraIntrinsics, CameraParams, LidarParams, LidarScan
from touchdown.sim.camera.sensor import CameraSensor
from touchdown.sim.frames import Pose, quat_wxyz_from_matrix
from touchdown.sim.lidar.sensor import LidarSensor
from touchdown.sim.moving import MovingBodies

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class AerialView:
    """One instant through the vehicle's camera."""

    rgb: NDArray[np.uint8]
    """(H, W, 3), with the sensor's noise"""
    depth_m: NDArray[np.float32]
    """(H, W) along the optical axis, inf where there is nothing"""
    geom_id: NDArray[np.int32]
    """(H, W), -1 where there is nothing"""
    world_from_camera: Pose


class AerialCamera:
    """The vehicle's camera, carried to any pose. ``close`` frees it, in the thread that looked."""

    intrinsics: CameraIntrinsics

    def __init__(self, scene: Scene, camera: CameraParams, seed: int) -> None:
        self._model = scene.model
        self._data = mujoco.MjData(scene.model)
        self._moving = MovingBodies(scene)
        self._sensor = CameraSensor(scene, camera, seed)
        self._body_from_camera = sensor_poses(scene.model)[2]
        self.intrinsics = self._sensor.intrinsics()

    def look(self, world_from_body: Pose, time_s: float, tick: int) -> AerialView:
        """What the vehicle at this pose sees at ``time_s``; ``tick`` numbers the noise."""
        self._data.qpos[:3] = world_from_body.translation
        self._data.qpos[3:7] = quat_wxyz_from_matrix(world_from_body.rotation)
        self._moving.write(self._data, time_s)
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        snapshot = self._sensor.snapshot(self._data)
        return AerialView(
            rgb=self._sensor.render(snapshot, tick),
            depth_m=self._sensor.render_depth(snapshot),
            geom_id=self._sensor.render_segmentation(snapshot),
            world_from_camera=world_from_body @ self._body_from_camera,
        )

    def close(self) -> None:
        self._sensor.close()


def still_scan(
    scene: Scene,
    lidar: LidarParams,
    seed: int,
    world_from_body: Pose,
    ticks: NDArray[np.int64],
    tick_hz: int,
) -> LidarScan:
    """The scan between two ``ticks`` (2,) of a vehicle that stands still in the air."""
    times_s = ticks / tick_hz
    quat = quat_wxyz_from_matrix(world_from_body.rotation)
    return LidarSensor(scene, lidar, seed).scan(
        int(ticks[0]),
        int(ticks[1]),
        tick_hz,
        times_s,
        np.tile(world_from_body.translation, (2, 1)),
        np.tile(quat, (2, 1)),
        sensor_poses(scene.model)[1],
        MovingBodies(scene).tracks(times_s),
    )
