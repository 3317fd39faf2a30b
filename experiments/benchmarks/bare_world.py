"""Physics, rays and pixels alone: the least work of a simulated flight.

The cost of the loop beyond this is its overhead. Every method repeats one task of the flight with
the function of MuJoCo, Embree or OpenGL alone and returns its processor time in seconds.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import Scene
from touchdown.sim.airframe.vehicle import sensor_mounts, vehicle_body_id, vehicle_model
from touchdown.sim.api import LidarScan, Truth, WorldParams
from touchdown.sim.camera.gl import Snapshot, Stage
from touchdown.sim.camera.sensor import CAMERA_NAME, CameraSensor
from touchdown.sim.frames import Pose, quat_wxyz_from_matrix
from touchdown.sim.lidar.sensor import LidarSensor
from touchdown.sim.moving import BodyTrack, MovingBodies

Array = NDArray[np.float64]


class BareWorld:
    """Bare computation beside a flight in the same scene, with its own physics state, rays and
    OpenGL context.

    The scene's model must have been prepared by a world (time step, air).
    """

    def __init__(self, scene: Scene, params: WorldParams, seed: int) -> None:
        self._model, self._sim = scene.model, params.sim
        self._data = mujoco.MjData(scene.model)
        self._moving = MovingBodies(scene)
        self._body = vehicle_body_id(scene.model)
        self._thrust_coefficient = vehicle_model(scene.model).thrust_coefficient
        self._body_from_lidar = sensor_mounts(scene.model).lidar
        self._lidar = LidarSensor(scene, params.lidar, seed)
        self._camera = CameraSensor(scene, params.camera, seed)
        self._eye = _Eye(scene.model, self._camera, params.camera.samples)

    def physics(self, truth: Truth, steps: int) -> float:
        """``mj_step``, ``steps`` times, from the true state with the thrust of that moment."""
        data, pose = self._data, truth.world_from_body
        data.qpos[:3], data.qpos[3:7] = pose.translation, quat_wxyz_from_matrix(pose.rotation)
        data.qvel[:3], data.qvel[3:6] = truth.velocity_world, truth.angular_velocity_body
        thrust = self._thrust_coefficient * float(np.sum(truth.rotor_speed_radps**2))
        data.xfrc_applied[self._body, :3] = thrust * pose.rotation[:, 2]
        started = time.thread_time()
        mujoco.mj_step(self._model, data, nstep=steps)
        return time.thread_time() - started

    def rays(self, scan: LidarScan, poses: Sequence[Pose]) -> float:
        """Embree's cast of the pulses of a scan against the static triangles. ``poses``: world from
        body, evenly spaced over the scan, both ends included. The beams are the nominal ones."""
        rays = _world_rays(scan, poses, self._body_from_lidar)
        static = self._lidar.scene.static
        if static is None:
            return 0.0
        started = time.thread_time()
        static.embree(rays)
        return time.thread_time() - started

    def pixels(self, truth: Truth) -> float:
        """``mjr_render`` and ``mjr_readPixels`` of the camera's image."""
        self._eye.aim(self._snapshot(truth))
        started = time.thread_time()
        self._eye.draw()
        return time.thread_time() - started

    def lidar_sensor(self, scan: LidarScan, poses: Sequence[Pose]) -> float:
        """The whole LIDAR sensor on the same scan: aiming, casting, returns, noise."""
        track = BodyTrack(
            times_s=np.linspace(scan.start_time_s, scan.end_time_s, len(poses)),
            positions=np.array([pose.translation for pose in poses]),
            quats_wxyz=np.array([quat_wxyz_from_matrix(pose.rotation) for pose in poses]),
        )
        started = time.thread_time()
        self._lidar.scan(
            scan.start_tick,
            scan.end_tick,
            self._sim.tick_hz,
            track,
            self._body_from_lidar,
            self._moving.tracks(track.times_s),
        )
        return time.thread_time() - started

    def camera_sensor(self, truth: Truth) -> float:
        """The whole camera on the same image: scene update, rendering, noise."""
        snapshot = self._snapshot(truth)
        started = time.thread_time()
        self._camera.render(snapshot, truth.tick)
        return time.thread_time() - started

    def close(self) -> None:
        """Frees the OpenGL contexts."""
        self._eye.close()
        self._camera.close()

    def _snapshot(self, truth: Truth) -> Snapshot:
        data, pose = self._data, truth.world_from_body
        data.qpos[:3], data.qpos[3:7] = pose.translation, quat_wxyz_from_matrix(pose.rotation)
        self._moving.write(data, truth.time_s)
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_camlight(self._model, data)
        return self._camera.snapshot(data)


class _Eye(Stage):
    """Stage of the camera, with preparation and rendering as separate steps."""

    def __init__(self, model: Any, camera: CameraSensor, samples: int) -> None:
        super().__init__(model, camera.intrinsics(), samples)
        self._camera_id = model.camera(CAMERA_NAME).id

    def aim(self, snapshot: Snapshot) -> None:
        self._viewport = self._look(snapshot, self._camera_id, 0, self._pinhole.height)

    def draw(self) -> None:
        mujoco.mjr_render(self._viewport, self._scene, self._context)
        mujoco.mjr_readPixels(self._pixels, None, self._viewport, self._context)


def _world_rays(
    scan: LidarScan, poses: Sequence[Pose], body_from_lidar: Pose
) -> NDArray[np.float32]:
    """(N, 6) float32 origins and directions, each pulse from the last pose before it."""
    span = scan.end_time_s - scan.start_time_s
    steps = len(poses) - 1
    index = np.minimum((scan.time_offsets / span * steps).astype(int), steps - 1)
    lidar = [pose @ body_from_lidar for pose in poses]
    rotations = np.array([pose.rotation for pose in lidar], dtype=np.float32)
    origins = np.array([pose.translation for pose in lidar], dtype=np.float32)
    directions = np.einsum("nij,nj->ni", rotations[index], scan.directions)
    return np.ascontiguousarray(np.hstack([origins[index], directions]))
