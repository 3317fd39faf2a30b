"""Camera and LIDAR of the vehicle at given poses: images and scans without a flight.

No physics, control or estimation takes part, so the cost is that of the rays and pixels, and the
poses are true by construction.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import mujoco
import numpy as np

from touchdown.scenes.api import Scene
from touchdown.sim.airframe.vehicle import sensor_mounts
from touchdown.sim.api import GRAVITY_MPS2, CameraImage, CameraIntrinsics, LidarScan, WorldParams
from touchdown.sim.camera.gl import Snapshot
from touchdown.sim.camera.sensor import CameraSensor, GroundEffects
from touchdown.sim.camera.vegetation import Vegetation
from touchdown.sim.frames import Pose, quat_wxyz_from_matrix, rotation_from_yaw
from touchdown.sim.lidar.pair import known_pair, merged
from touchdown.sim.lidar.sensor import LidarSensor
from touchdown.sim.lidar.surface_detail import SurfaceDetail
from touchdown.sim.moving import BodyTrack, MovingBodies
from touchdown.sim.typing import Array, Bytes, Float32, Int32


@dataclass(frozen=True, kw_only=True, slots=True)
class PosedView:
    """One instant through the vehicle's camera, with depth and geom of every pixel."""

    rgb: Bytes
    """(H, W, 3), with the sensor's noise"""
    depth_m: Float32
    """(H, W) along the optical axis, inf where there is nothing"""
    geom_id: Int32
    """(H, W), -1 where there is nothing"""
    time_s: float
    world_from_body: Pose
    world_from_camera: Pose


class Path(Protocol):
    """A position over time, world frame."""

    def sample(self, t: float) -> tuple[Array, Array, Array]:
        """Position (3,) m, velocity (3,) m/s, acceleration (3,) m/s^2 at ``t`` seconds."""
        ...


class PosedSensors:
    """Camera and LIDAR of the vehicle of ``scene``, with the parameters' noise, at any pose.

    Moving bodies are where they are at the time of a view; a body that `hold` has placed stays
    there. The sensors look along the poses they are given: nothing falls, and nothing collides.
    Image noise depends on the tick, LIDAR noise and pattern on the tick at which a scan starts.

    The GL context belongs to the thread of the first image; call ``close`` in that thread. Raises
    ValueError for impossible camera parameters; the first scan does so for those of the LIDAR.
    """

    def __init__(self, scene: Scene, params: WorldParams, seed: int) -> None:
        self._scene, self._params, self._seed = scene, params, seed
        self._model = scene.model
        self._data = mujoco.MjData(scene.model)
        self._moving = MovingBodies(scene)
        self._held: dict[str, Pose] = {}
        vegetation = Vegetation.of(scene, SurfaceDetail.plants_of(params.lidar, scene))
        self._camera = CameraSensor(
            scene,
            params.camera,
            seed,
            lamp=params.lamp,
            ground=GroundEffects(vegetation=vegetation),
        )
        self.mounts = sensor_mounts(scene.model)
        """True extrinsics of the sensors"""
        self.intrinsics: CameraIntrinsics = self._camera.intrinsics()

    @cached_property
    def _lidar(self) -> LidarSensor:
        return LidarSensor(self._scene, self._params.lidar, self._seed)

    @cached_property
    def _second_lidar(self) -> LidarSensor:
        return LidarSensor(self._scene, self._params.lidar, self._seed, number=1)

    def hold(self, body: str, world_from_body: Pose) -> None:
        """Places the mocap body ``body``. Raises ValueError where the scene has none."""
        body_id = mujoco.mj_name2id(self._model, mujoco.mjtObj.mjOBJ_BODY, body)
        if body_id < 0 or self._model.body_mocapid[body_id] < 0:
            raise ValueError(f"scene '{self._scene.name}' has no mocap body '{body}'")
        self._held[body] = world_from_body

    def view(self, world_from_body: Pose, time_s: float, tick: int) -> PosedView:
        """Image, depth and geoms from one pose at ``time_s``; ``tick`` selects the image noise."""
        quat_wxyz = quat_wxyz_from_matrix(world_from_body.rotation)
        snapshot = self._snapshot(world_from_body.translation, quat_wxyz, time_s)
        return PosedView(
            rgb=self._camera.render(snapshot, tick),
            depth_m=self._camera.render_depth(snapshot),
            geom_id=self._camera.render_segmentation(snapshot),
            time_s=time_s,
            world_from_body=world_from_body,
            world_from_camera=world_from_body @ self.mounts.camera,
        )

    def image(self, body: BodyTrack, tick: int) -> CameraImage:
        """The image at ``tick`` from the pose that the track has nearest to that instant."""
        time_s = tick / self._params.sim.tick_hz
        row = int(np.abs(body.times_s - time_s).argmin())
        snapshot = self._snapshot(body.positions[row], body.quats_wxyz[row], time_s)
        return CameraImage(tick=tick, time_s=time_s, rgb=self._camera.render(snapshot, tick))

    def scan(self, body: BodyTrack, start_tick: int) -> LidarScan:
        """The scan that begins at ``start_tick``, along a track of the body that covers it."""
        held = {
            name: BodyTrack.at_rest(pose, body.times_s[:1]) for name, pose in self._held.items()
        }
        end_tick = start_tick + self._params.sim.lidar_scan_ticks
        when = start_tick, end_tick, self._params.sim.tick_hz, body
        moving = self._moving.tracks(body.times_s) | held
        scan, second = self._lidar.scan(*when, self.mounts.lidar, moving), self.mounts.second_lidar
        if second is None:
            return scan
        pair = known_pair(self.mounts.lidar.inverse() @ second, self._params.lidar, self._seed)
        return merged(scan, self._second_lidar.scan(*when, second, moving), pair)

    def scan_times(self, start_tick: int) -> Array:
        """(M,) s: every tick of the scan that begins at ``start_tick``, both ends included."""
        end_tick = start_tick + self._params.sim.lidar_scan_ticks
        return np.arange(start_tick, end_tick + 1) / self._params.sim.tick_hz

    def close(self) -> None:
        """Frees the camera."""
        self._camera.close()

    def _snapshot(self, position: Array, quat_wxyz: Array, time_s: float) -> Snapshot:
        data = self._data
        data.qpos[:3], data.qpos[3:7] = position, quat_wxyz
        self._moving.write(data, time_s)
        for name, pose in self._held.items():
            mocap = self._model.body_mocapid[self._model.body(name).id]
            data.mocap_pos[mocap] = pose.translation
            data.mocap_quat[mocap] = quat_wxyz_from_matrix(pose.rotation)
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_camlight(self._model, data)
        return self._camera.snapshot(data)


def track_along(path: Path, times_s: Array, path_start_s: float, yaw: float) -> BodyTrack:
    """The body's poses at (M,) ``times_s`` on a path that begins at ``path_start_s``: heading
    ``yaw`` (rad), thrust along the path's acceleration."""
    sampled = [path.sample(float(t)) for t in times_s - path_start_s]
    return BodyTrack(
        times_s=times_s,
        positions=np.array([position for position, _, _ in sampled]),
        quats_wxyz=np.array([_attitude(acceleration, yaw) for _, _, acceleration in sampled]),
    )


def _attitude(acceleration: Array, yaw: float) -> Array:
    """Quaternion wxyz of the attitude that gives ``acceleration`` (3,) by thrust along body z."""
    up = acceleration + np.array([0.0, 0.0, GRAVITY_MPS2])
    up /= np.linalg.norm(up)
    ahead = rotation_from_yaw(yaw)[:, 0]
    left = np.cross(up, ahead)
    left /= np.linalg.norm(left)
    return quat_wxyz_from_matrix(np.column_stack([np.cross(left, up), left, up]))
