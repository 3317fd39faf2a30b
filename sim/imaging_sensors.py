"""Camera and LIDAR of a flying vehicle: exposures, scans, worker threads and delayed delivery.

The physics thread records poses and snapshots at their ticks; images are rendered in one worker
thread and scans cast in another, and both arrive after a latency of their own (`Latency`).
"""

from collections import deque

import mujoco
import numpy as np

from touchdown.scenes.api import Scene
from touchdown.sim.airframe.deviations import give_back_textures
from touchdown.sim.airframe.vehicle import sensor_mounts
from touchdown.sim.api import CameraImage, LidarScan, SensorNeeds, WorldParams
from touchdown.sim.camera.gl import Snapshot
from touchdown.sim.camera.sensor import CAMERA_NAME, CameraSensor, GroundEffects
from touchdown.sim.camera.vegetation import Vegetation
from touchdown.sim.delivery import (
    Computer,
    DeliveryQueue,
    Latency,
    ShutterClock,
    Stamp,
    make_executor,
)
from touchdown.sim.dust import DustCloud
from touchdown.sim.effects import Effects
from touchdown.sim.faults.disturbances import Disturbances, Weather
from touchdown.sim.frames import so3_log
from touchdown.sim.lidar.pair import known_pair, merged
from touchdown.sim.lidar.sensor import LidarSensor
from touchdown.sim.lidar.surface_detail import SurfaceDetail
from touchdown.sim.moving import BodyTrack, MovingBodies
from touchdown.sim.typing import Array, Bytes
from touchdown.sim.wind import Wind

RIGHT_CAMERA = "vehicle/camera_right"


class ImagingSensors:
    """Cameras and LIDAR, built when they are needed. Call ``start`` before the first tick.

    Raises ValueError for impossible parameters, those of a LIDAR that nothing needs included.
    """

    def __init__(self, scene: Scene, params: WorldParams, seed: int, moving: MovingBodies) -> None:
        self._scene, self._params, self._seed = scene, params, seed
        self.moving = moving
        """the moving bodies of the flight"""
        self._sim, self._model = params.sim, scene.model
        self._renderer = make_executor(self._sim.threads)
        self._caster = make_executor(self._sim.threads)
        self.mounts = sensor_mounts(self._model)
        """True extrinsics of all sensors"""
        ticks = self._sim.lidar_scan_ticks
        self._positions, self._quats = np.empty((ticks + 1, 3)), np.empty((ticks + 1, 4))
        dusty = params.dust.density > 0.0
        self._dust = DustCloud(scene, params.dust) if dusty else None
        self.plants = SurfaceDetail.plants_of(params.lidar, scene)
        """Grass and crops that every sensor sees above the ground; None: there are none"""
        self._vegetation = Vegetation.of(scene, self.plants)
        self.camera = self._make_camera(CAMERA_NAME)
        self._right: CameraSensor | None = None
        self._lidar: LidarSensor | None = None
        self._second: LidarSensor | None = None
        self._image_period = 0
        self._shutter = ShutterClock(params.camera, self._sim, seed, self.camera.takes_time)
        self._drawn: tuple[int, Snapshot] | None = None
        self._takes_textures = False
        self._poses: deque[tuple[int, Array, Array]] = deque(maxlen=self._shutter.span_ticks + 1)
        self.scans: DeliveryQueue[LidarScan] = DeliveryQueue(self._caster)
        self.images: DeliveryQueue[CameraImage] = DeliveryQueue(self._renderer)
        self._computer = Computer() if self._sim.latency_by_load else None
        self._scan_latency = Latency(self._sim, seed, b"scans", self._computer)
        self._image_latency = Latency(self._sim, seed, b"images", self._computer)

    def _make_camera(self, name: str) -> CameraSensor:
        params = self._params
        return CameraSensor(
            self._scene,
            params.camera,
            self._seed,
            name,
            params.faults,
            self._sim.tick_hz,
            params.lamp,
            GroundEffects(self._dust, self._vegetation),
        )

    def add(self, needs: SensorNeeds) -> None:
        """Builds the sensors that ``needs`` names and that are not there yet."""
        self._image_period = self._sim.tick_hz // needs.camera_hz if needs.camera_hz else 0
        if needs.lidar and self._lidar is None:
            air = Weather(self._params.faults, self._sim.tick_hz)
            wind = self._params.wind
            speed = wind.mean_kmh / 3.6 * Wind(wind, self._seed).mean_direction[:2]
            optics = None if self.plants is None else self.plants.optics
            about = (self._scene, self._params.lidar, self._seed, air, speed, self._dust, optics)
            self._lidar = LidarSensor(*about)
            if self.mounts.second_lidar is not None:
                self._second = LidarSensor(*about, number=1)
                pair = self.mounts.lidar.inverse() @ self.mounts.second_lidar
                self._known_pair = known_pair(pair, self._params.lidar, self._seed)
        if needs.stereo and self._right is None:
            self._right = self._make_camera(RIGHT_CAMERA)

    def start(self, position: Array, quat_wxyz: Array, disturbances: Disturbances) -> None:
        """Starts the body's track at a pose: (3,) m and (4,) world_from_body."""
        self._disturbances = disturbances
        for effects in self.effects().values():
            effects.clear()
        self._positions[0], self._quats[0] = position, quat_wxyz

    def clear(self) -> None:
        """Drops everything in transit."""
        self.scans.clear()
        self.images.clear()
        if self._dust is not None:
            self._dust.clear()
        self._scan_latency.restart()
        self._image_latency.restart()
        if self._computer is not None:
            self._computer.free = 0.0
        self._drawn = None
        self._poses.clear()

    def effects(self) -> dict[str, Effects]:
        """Effects on delivered scans, and on images of the left camera."""
        found = {"images": self.camera.effects}
        return found if self._lidar is None else {"scans": self._lidar.effects, **found}

    def collect_scans(self, tick: int) -> tuple[LidarScan, ...]:
        """Scans that arrive up to ``tick``."""
        scans = self.scans.collect(tick)
        if self._lidar is not None:
            self._lidar.effects.deliver(len(scans))
        return scans

    def collect_images(self, tick: int) -> tuple[CameraImage, ...]:
        """Images that arrive up to ``tick``."""
        images = self.images.collect(tick)
        self.camera.effects.deliver(len(images))
        return images

    def take_textures(self) -> None:
        """Returns the memory of the textures of the scene's model to the system after the first
        image, when they are with the renderer."""
        self._takes_textures = True

    def close(self) -> None:
        """Ends the worker threads and frees the cameras."""
        self.clear()
        for camera in (self.camera, self._right):
            if camera is not None:
                self._renderer.submit(camera.close).result()
        self._renderer.shutdown(wait=True)
        self._caster.shutdown(wait=True)

    def sense(self, tick: int, data: mujoco.MjData, position: Array, quat_wxyz: Array) -> None:
        """Records the pose of ``tick`` for the scan, and the instant of an exposure that it is part
        of; submits what is complete."""
        if self._dust is not None:
            self._dust.observe(tick, data, position)
        if self._lidar is not None:
            self._record_pose(tick, position, quat_wxyz)
        if self._image_period:
            if self.camera.exposes_rows:
                self._poses.append((tick, position.copy(), quat_wxyz.copy()))
            self._expose(tick, data)

    def _record_pose(self, tick: int, position: Array, quat_wxyz: Array) -> None:
        ticks = self._sim.lidar_scan_ticks
        row = (tick - 1) % ticks + 1
        self._positions[row], self._quats[row] = position, quat_wxyz
        if row == ticks:
            track = BodyTrack(
                times_s=np.arange(tick - ticks, tick + 1) / self._sim.tick_hz,
                positions=self._positions.copy(),
                quats_wxyz=self._quats.copy(),
            )
            due = self._scan_latency.due(tick)
            if due is not None:
                self.scans.submit(due, self._scan, tick, track)
            self._positions[0], self._quats[0] = position, quat_wxyz

    def _expose(self, tick: int, data: mujoco.MjData) -> None:
        """Takes the snapshot that an image is drawn from, and submits the image once the poses of
        all its rows are known."""
        shutter, period = self._shutter, self._image_period
        since_pulse = (tick - shutter.phase_ticks) % period
        if (since_pulse + shutter.before_ticks) % period == 0:
            self.moving.write(data, tick / self._sim.tick_hz)
            # mj_step leaves positions of the tick's beginning behind.
            mujoco.mj_kinematics(self._model, data)
            mujoco.mj_camlight(self._model, data)
            self._drawn = tick, self.camera.snapshot(data)
        pulse = tick - shutter.after_ticks
        since_start = pulse - shutter.phase_ticks
        if since_start < period or since_start % period or self._drawn is None:
            return
        drawn_tick, snapshot = self._drawn
        track = self._body_track() if self.camera.exposes_rows else None
        stamp = shutter.stamp(pulse)
        due = self._image_latency.due(pulse)
        if due is not None:
            due = max(due, stamp.tick, tick)
            self.images.submit(due, self._render, snapshot, drawn_tick, track, pulse, stamp)

    def _body_track(self) -> BodyTrack:
        ticks, positions, quats = zip(*self._poses, strict=True)
        return BodyTrack(
            times_s=np.array(ticks) / self._sim.tick_hz,
            positions=np.array(positions),
            quats_wxyz=np.array(quats),
        )

    # ------------------------------------------------------------------------ worker threads

    def _scan(self, end_tick: int, track: BodyTrack) -> LidarScan:
        assert self._lidar is not None
        nominal = self.mounts.lidar
        mount = self._disturbances.lidar_mount(end_tick, nominal)
        if mount is not nominal:
            rotation_deg = np.degrees(np.linalg.norm(so3_log(nominal.rotation.T @ mount.rotation)))
            self._lidar.effects.note(("miscalibration",), 1.0, float(rotation_deg))
        scan = self._lidar.scan(
            end_tick - self._sim.lidar_scan_ticks,
            end_tick,
            self._sim.tick_hz,
            track,
            mount,
            self.moving.tracks(track.times_s),
        )
        self._lidar.effects.end_message()
        if self._second is None or self.mounts.second_lidar is None:
            return scan
        ticks = scan.start_tick, scan.end_tick, self._sim.tick_hz
        moving = self.moving.tracks(track.times_s)
        second = self._second.scan(*ticks, track, self.mounts.second_lidar, moving)
        return merged(scan, second, self._known_pair)

    def _render(
        self, snapshot: Snapshot, drawn_tick: int, track: BodyTrack | None, tick: int, stamp: Stamp
    ) -> CameraImage:
        hz = self._sim.tick_hz

        def taken(camera: CameraSensor) -> Bytes:
            if track is None:
                return camera.render(snapshot, tick)
            return camera.render_rows(snapshot, drawn_tick / hz, track, tick / hz, tick)

        image = CameraImage(
            tick=stamp.tick,
            time_s=stamp.time_s,
            rgb=taken(self.camera),
            right_rgb=taken(self._right) if self._right else None,
        )
        if self._takes_textures:
            give_back_textures(self._model)
            self._takes_textures = False
        self.camera.effects.note(("stamp_error_ms",), 1.0, 1e3 * abs(stamp.time_s - tick / hz))
        self.camera.effects.end_message()
        return image
