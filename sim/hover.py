"""What camera and LIDAR of a hovering vehicle see of a scene, without a flight."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import Scene
from touchdown.sim.airframe.vehicle import sensor_poses
from touchdown.sim.api import CameraParams, LidarParams, SimParams
from touchdown.sim.camera.sensor import CameraSensor
from touchdown.sim.frames import quat_wxyz_from_matrix, rotation_from_yaw
from touchdown.sim.lidar.sensor import LidarSensor
from touchdown.sim.moving import MovingBodies

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class HoverView:
    """One picture, its depth, and the LIDAR returns of some time."""

    rgb: NDArray[np.uint8]
    """(H, W, 3), image up = where the vehicle looks"""
    depth_m: NDArray[np.float32]
    """(H, W) along the optical axis, inf where there is nothing"""
    points_world: Array
    """(N, 3) m"""
    intensity: NDArray[np.uint8]
    """(N,)"""


def hover_view(
    scene: Scene,
    *,
    sim: SimParams,
    camera: CameraParams,
    lidar: LidarParams,
    seed: int,
    height_m: float,
    seconds: float,
) -> HoverView:
    """Hovers ``height_m`` above the take-off pose from time 0 on, heading as at take-off."""
    model = scene.model
    data = mujoco.MjData(model)
    data.qpos[:2] = scene.takeoff_xy_m
    data.qpos[2] += height_m
    rotation = rotation_from_yaw(scene.takeoff_yaw)
    data.qpos[3:7] = quat_wxyz_from_matrix(rotation)
    MovingBodies(scene).write(data, 0.0)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    eye = CameraSensor(scene, camera, seed)
    try:
        snapshot = eye.snapshot(data)
        rgb, depth_m = eye.render(snapshot, 0), eye.render_depth(snapshot)
    finally:
        eye.close()
    points, intensity = _returns(scene, sim, lidar, seed, data.qpos[:7].copy(), seconds)
    return HoverView(rgb=rgb, depth_m=depth_m, points_world=points, intensity=intensity)


def _returns(
    scene: Scene, sim: SimParams, lidar: LidarParams, seed: int, qpos: Array, seconds: float
) -> tuple[Array, NDArray[np.uint8]]:
    """Returns in the world frame, (N, 3) and (N,), of ``seconds`` worth of scans from a pose."""
    sensor, moving = LidarSensor(scene, lidar, seed), MovingBodies(scene)
    body_from_lidar = sensor_poses(scene.model)[1]
    rotation = rotation_from_yaw(scene.takeoff_yaw)
    ticks = sim.lidar_scan_ticks
    points, intensity = [], []
    for start in range(0, round(seconds * sim.tick_hz), ticks):
        times_s = np.arange(start, start + ticks + 1) / sim.tick_hz
        scan = sensor.scan(
            start,
            start + ticks,
            sim.tick_hz,
            times_s,
            np.tile(qpos[:3], (ticks + 1, 1)),
            np.tile(qpos[3:], (ticks + 1, 1)),
            body_from_lidar,
            moving.tracks(times_s),
        )
        back = scan.ranges > 0.0
        body = body_from_lidar.apply(scan.points[back].astype(np.float64))
        points.append(body @ rotation.T + qpos[:3])
        intensity.append(scan.intensity[back])
    return np.concatenate(points), np.concatenate(intensity)
