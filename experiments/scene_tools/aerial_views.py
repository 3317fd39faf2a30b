"""Camera poses anywhere over a scene, and what the camera sees there."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.config.schema import Config
from touchdown.scenes.api import Scene
from touchdown.sim.frames import Pose, rotation_from_yaw, so3_exp

if TYPE_CHECKING:
    from touchdown.sim.aerial import AerialCamera, AerialView


def aerial_camera(config: Config, scene: Scene) -> AerialCamera:
    """The configured camera, to be carried anywhere over a scene."""
    from touchdown.sim.aerial import AerialCamera

    return AerialCamera(scene, config.camera, config.seed)


Array = NDArray[np.float64]
Int32 = NDArray[np.int32]
LOW_M, HIGH_M = 8.0, 40.0
_MARGIN_M = 14.0
"""of the place's rim that no picture is taken over"""
_TILT_SIGMA = np.deg2rad(4.0)
_NEAREST_M = 3.0
"""views with something nearer than this are not taken: the camera might be inside it"""
_MOST_TRIES = 40
_LONGEST_TIME_S = 60.0
_STEP_M = 0.4
"""a jump of depth between neighbouring pixels that parts two things of one kind"""
_STEEPEST = 8.0
"""depth per pixel's width that a surface seen obliquely may change by, walls included"""


def look_anywhere(
    camera: AerialCamera,
    scene: Scene,
    rng: np.random.Generator,
    number: int,
    heights_m: tuple[float, float] = (LOW_M, HIGH_M),
) -> tuple[AerialView, Pose, float]:
    """A view from a random pose of the body, clear of everything, and when it was taken. Heights
    are over the take-off spot; ``number`` numbers the noise."""
    low, high = scene.bounds_xy_m[0] + _MARGIN_M, scene.bounds_xy_m[1] - _MARGIN_M
    for _ in range(_MOST_TRIES):
        height = float(np.exp(rng.uniform(*np.log(heights_m))))
        where = np.array([*rng.uniform(low, high), float(scene.model.qpos0[2]) + height])
        tilt = so3_exp(np.array([*rng.normal(0.0, _TILT_SIGMA, 2), 0.0]))
        pose = Pose(rotation_from_yaw(rng.uniform(-np.pi, np.pi)) @ tilt, where)
        time_s = rng.uniform(0.0, _LONGEST_TIME_S)
        view = camera.look(pose, time_s, number)
        if float(view.depth_m.min()) > _NEAREST_M:
            break
    return view, pose, time_s


def paint_ground(kind: Int32, view: AerialView, scene: Scene, matrix: Array) -> None:
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
