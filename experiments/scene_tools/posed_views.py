"""The configured sensors at given poses over a scene: random views, and a view from a hover."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.config.schema import Config
from touchdown.experiments.flight.wiring import world_params
from touchdown.scenes.api import Array, Scene
from touchdown.sim.frames import Pose, rotation_from_yaw, so3_exp
from touchdown.sim.posed_sensors import PosedSensors, PosedView
from touchdown.sim.typing import Int32

LOW_M, HIGH_M = 8.0, 40.0
"""Default range of heights of random views over the take-off spot"""
_MARGIN_M = 14.0
"""Width of the scene's rim over which no view is taken"""
_TILT_SIGMA = np.deg2rad(4.0)
_NEAREST_M = 3.0
"""Views with a surface nearer than this are drawn again: the camera might be inside an object"""
_MAX_TRIES = 40
_LONGEST_TIME_S = 60.0


def posed_sensors(config: Config, scene: Scene) -> PosedSensors:
    """The configured camera and LIDAR, at any pose over a scene."""
    return PosedSensors(scene, world_params(config), config.world_seed)


def random_view(
    sensors: PosedSensors,
    scene: Scene,
    rng: np.random.Generator,
    number: int,
    heights_m: tuple[float, float] = (LOW_M, HIGH_M),
) -> PosedView:
    """A view from a random pose of the body, clear of everything, at a random time.

    Heights are over the take-off spot, uniform in their logarithm. ``number`` selects the image
    noise.
    """
    low, high = scene.bounds_xy_m[0] + _MARGIN_M, scene.bounds_xy_m[1] - _MARGIN_M
    for _ in range(_MAX_TRIES):
        height = float(np.exp(rng.uniform(*np.log(heights_m))))
        position = np.array([*rng.uniform(low, high), float(scene.model.qpos0[2]) + height])
        tilt = so3_exp(np.array([*rng.normal(0.0, _TILT_SIGMA, 2), 0.0]))
        pose = Pose(rotation_from_yaw(rng.uniform(-np.pi, np.pi)) @ tilt, position)
        view = sensors.view(pose, rng.uniform(0.0, _LONGEST_TIME_S), number)
        if float(view.depth_m.min()) > _NEAREST_M:
            break
    return view


def write_ground_classes(kind: Int32, view: PosedView, scene: Scene, matrix: Array) -> None:
    """Writes the class of the ground's raster into the pixels of ``kind`` (H/2, W/2) that show the
    terrain, in place. The scene has a raster."""
    ground = scene.ground
    assert ground is not None
    shown = view.geom_id[::2, ::2] == scene.model.geom(ground.geom_name).id
    rows, cols = np.nonzero(shown)
    depth = view.depth_m[::2, ::2][rows, cols].astype(np.float64)
    rays = np.column_stack([2 * cols, 2 * rows, np.ones(len(rows))]) @ np.linalg.inv(matrix).T
    points = np.asarray(rays * depth[:, None], np.float64)
    world = view.world_from_camera.apply(points)
    cell = np.floor((world[:, :2] - ground.origin_xy_m) / ground.cell_m).astype(int)
    limits = np.array(ground.class_id.shape)[::-1] - 1
    cell = np.clip(cell, 0, limits)
    kind[rows, cols] = ground.class_id[cell[:, 1], cell[:, 0]]


@dataclass(frozen=True, kw_only=True, slots=True)
class HoverView:
    """An image with its depth, and LIDAR returns, of a vehicle that hovers."""

    rgb: NDArray[np.uint8]
    """(H, W, 3), image up = the vehicle's heading"""
    depth_m: NDArray[np.float32]
    """(H, W) along the optical axis, inf where there is nothing"""
    points_world: Array
    """(N, 3) m"""
    intensity: NDArray[np.uint8]
    """(N,)"""


def hover_view(config: Config, scene: Scene, height_m: float, seconds: float) -> HoverView:
    """The view ``height_m`` above the take-off pose, heading as at take-off, and the LIDAR returns
    of ``seconds`` from time 0 on."""
    from touchdown.sim.moving import BodyTrack

    height = float(scene.model.qpos0[2]) + height_m
    pose = Pose(rotation_from_yaw(scene.takeoff_yaw), np.array([*scene.takeoff_xy_m, height]))
    sensors = posed_sensors(config, scene)
    try:
        view = sensors.view(pose, 0.0, 0)
    finally:
        sensors.close()
    points, intensity = [], []
    for start in range(0, round(seconds * config.sim.tick_hz), config.sim.lidar_scan_ticks):
        scan = sensors.scan(BodyTrack.at_rest(pose, sensors.scan_times(start)), start)
        returned = scan.ranges > 0.0
        in_body = sensors.mounts.lidar.apply(scan.points[returned].astype(np.float64))
        points.append(pose.apply(in_body))
        intensity.append(scan.intensity[returned])
    return HoverView(
        rgb=view.rgb,
        depth_m=view.depth_m,
        points_world=np.concatenate(points),
        intensity=np.concatenate(intensity),
    )
