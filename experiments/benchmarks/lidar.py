"""Benchmark of the LIDAR sensor against bare ray casters, on the same rays in one process.

All cast from one hovering pose in one scene, because MuJoCo's caster and the packages that build on
it support only rays from a common origin.
"""

import time
from collections.abc import Callable, Mapping
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.config.loading import load_config
from touchdown.experiments.flight.wiring import build_scene
from touchdown.scenes.api import Scene
from touchdown.sim.airframe.vehicle import sensor_mounts
from touchdown.sim.api import LidarParams
from touchdown.sim.frames import Pose, quat_wxyz_from_matrix, rotation_from_yaw
from touchdown.sim.geometry.tessellation import FIRST_HIDDEN_GROUP
from touchdown.sim.lidar.patterns import PATTERNS
from touchdown.sim.lidar.sensor import LidarSensor
from touchdown.sim.moving import BodyTrack, MovingBodies
from touchdown.sim.typing import Array

HOVERS = 6
"""Number of positions over the scene's middle from which scans are taken."""
_HEIGHT_M = 30.0
_RING_M = 15.0
_TICK_HZ = 600
_SCAN_TICKS = 60
_LIDAR_SITE = "vehicle/lidar"


def bench_lidar(
    *, scene: str = "crossroad", seed: int = 0, preset: str = "horizon", rounds: int = 7
) -> dict[str, Any]:
    """Returns the rays per second of the whole sensor (poses, noise, returns; the extra rays of
    split beams are not counted), of Embree alone, of ``mujoco.mj_multiRay`` and of the package
    ``mujoco-lidar`` on the CPU, one thread each: ``{"scene", "rays_per_s": {...}, "ms_per_scan":
    {...}, "ratio": {"embree", "mj_multiRay", "mujoco_lidar"}}``. A ratio is the sensor's rate over
    that of a reference implementation.

    All casters take turns on every scan, after a round of warm-up, so that other load of the
    machine affects all of them; a figure is the median over ``rounds`` through the scans. A package
    that is not installed is left out. Raises UsageError and ValueError as `load_config` and
    `build_scene`.
    """
    config = load_config(
        None, [f"lidar.preset={preset}"], profile_default="ideal",
        scene=scene, estimator="oracle", seed=seed, record=False,
    )  # fmt: skip
    built = build_scene(config)
    references = ReferenceCasters(built, config.lidar, config.world_seed)
    middle = np.append(built.takeoff_xy_m, _HEIGHT_M)
    seconds: dict[str, list[float]] = {}
    rays = 0
    for round_number in range(rounds + 1):
        spent: dict[str, float] = {}
        rays = 0
        for hover in range(HOVERS):
            angle = 2.0 * np.pi * hover / HOVERS
            position = middle + _RING_M * np.array([np.cos(angle), np.sin(angle), 0.0])
            for name, cast in references.casters(position, 7 * hover).items():
                started = time.perf_counter()
                distances = cast()
                spent[name] = spent.get(name, 0.0) + time.perf_counter() - started
            rays += len(distances)
        if round_number > 0:  # the first one warms up
            for name, wall in spent.items():
                seconds.setdefault(name, []).append(wall)
    wall_s = {name: float(np.median(walls)) for name, walls in seconds.items()}
    return {
        "scene": scene,
        "preset": preset,
        "rays_per_scan": rays // HOVERS,
        "threads": 1,
        "rays_per_s": {name: rays / wall for name, wall in wall_s.items()},
        "ms_per_scan": {name: 1e3 * wall / HOVERS for name, wall in wall_s.items()},
        "ratio": {
            name: wall / wall_s["sensor"] for name, wall in wall_s.items() if name != "sensor"
        },
    }


class ReferenceCasters:
    """Ray casters for the rays of one scan of the LIDAR of ``params``, one thread each."""

    def __init__(self, scene: Scene, params: LidarParams, seed: int) -> None:
        self._model, self._params = scene.model, params
        self._data = mujoco.MjData(scene.model)
        self._sensor = LidarSensor(scene, params, seed)
        self._moving = MovingBodies(scene)
        self._yaw = scene.takeoff_yaw
        self._mount = sensor_mounts(scene.model).lidar
        self._groups = (np.arange(mujoco.mjNGROUP) < FIRST_HIDDEN_GROUP).astype(np.uint8)

    def casters(self, position: Array, scan_number: int) -> Mapping[str, Callable[[], Array]]:
        """Functions by name that return distances (N,) of the rays of a scan from a level body at
        ``position`` (3,): ``sensor`` (the whole LIDAR; ranges), ``embree`` (the bare cast of given
        rays, one acceleration structure), ``mj_multiRay``, and ``mujoco_lidar``, the CPU backend of
        the package of that name, where it is installed. Valid until the next call."""
        rotation = rotation_from_yaw(self._yaw)
        world_from_lidar = Pose(rotation, position) @ self._mount
        scan_pattern = PATTERNS[self._params.preset]
        ticks = (scan_number * _SCAN_TICKS, (scan_number + 1) * _SCAN_TICKS)
        first = ticks[0] * scan_pattern.point_rate_hz // _TICK_HZ + 1
        count = ticks[1] * scan_pattern.point_rate_hz // _TICK_HZ + 1 - first
        nominal = scan_pattern.directions(first, count)
        beams = nominal.astype(np.float64) @ world_from_lidar.rotation.T
        self._place(position, rotation, ticks[0] / _TICK_HZ)
        casters = {
            "sensor": self._whole_sensor(position, rotation, ticks),
            "embree": self._embree(world_from_lidar.translation, beams),
            "mj_multiRay": self._multi_ray(world_from_lidar.translation, beams),
        }
        package = self._package(nominal)
        return casters | ({} if package is None else {"mujoco_lidar": package})

    def _place(self, position: Array, rotation: Array, time_s: float) -> None:
        """Sets vehicle and moving bodies for the MuJoCo casters."""
        self._data.qpos[:3], self._data.qpos[3:7] = position, quat_wxyz_from_matrix(rotation)
        self._moving.write(self._data, time_s)
        mujoco.mj_kinematics(self._model, self._data)

    def _whole_sensor(
        self, position: Array, rotation: Array, ticks: tuple[int, int]
    ) -> Callable[[], Array]:
        times = np.arange(ticks[0], ticks[1] + 1) / _TICK_HZ
        track = BodyTrack.at_rest(Pose(rotation, position), times)

        def cast() -> Array:
            moving = self._moving.tracks(times)
            scan = self._sensor.scan(*ticks, _TICK_HZ, track, self._mount, moving)
            return scan.ranges  # type: ignore[return-value]

        return cast

    def _embree(self, origin: Array, beams: Array) -> Callable[[], Array]:
        static = self._sensor.scene.static
        if static is None:
            raise ValueError("the scene has no static geometry: choose another scene")
        rays = np.column_stack([np.tile(origin, (len(beams), 1)), beams]).astype(np.float32)
        return lambda: static.embree(rays)["t_hit"].numpy()  # type: ignore[no-any-return]

    def _multi_ray(self, origin: Array, beams: Array) -> Callable[[], Array]:
        vectors, count = np.ascontiguousarray(beams).ravel(), len(beams)
        distances, geoms = np.empty(count), np.empty(count, dtype=np.int32)

        def cast() -> Array:
            mujoco.mj_multiRay(
                self._model, self._data, origin, vectors, self._groups, 1, -1, geoms, distances,
                None, count, self._params.max_range_m,
            )  # fmt: skip
            return distances

        return cast

    def _package(self, nominal: NDArray[np.float32]) -> Callable[[], Array] | None:
        try:
            from mujoco_lidar import MjLidarWrapper
        except ImportError:
            return None
        lidar = MjLidarWrapper(
            self._model,
            site_name=_LIDAR_SITE,
            backend="cpu",
            cutoff_dist=self._params.max_range_m,
            args={"geomgroup": self._groups},
        )
        x, y, z = nominal.astype(np.float64).T
        theta, phi = np.arctan2(y, x), np.arcsin(np.clip(z, -1.0, 1.0))
        return lambda: lidar.trace_rays(self._data, theta, phi)  # type: ignore[no-any-return]
