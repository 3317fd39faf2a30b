"""Images of a scene for people."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.api import VEHICLE_BODY, VEHICLE_GROUP, Image, Scene

VIEWS = ("above", "oblique")


def render_scene(scene: Scene, view: str, pixels: int | None = None) -> Image:
    """A image of a scene as at time 0. The model is left as it was.

    ``above``: map-like, north up, square, ``pixels`` (1080) wide. ``oblique``: 16:9 from the
    south-west, ``pixels`` (1600) wide. Raises ValueError for another view.
    """
    if view not in VIEWS:
        raise ValueError(f"unknown view '{view}': give one of {', '.join(VIEWS)}")
    model = scene.model
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    middle = scene.bounds_xy_m.mean(axis=0)
    span = float(np.ptp(scene.bounds_xy_m, axis=0).max())
    if view == "above":
        # A narrow lens far away shows roofs, not walls.
        eye = _camera(middle, 4.0 * span, -89.99, 90.0)
        size = (pixels or 1080, pixels or 1080)
        narrow = float(np.rad2deg(2.0 * np.arctan(0.51 / 4.0)))
        with _lens(model, narrow, 1.0 * span, 6.0 * span):
            return _dimmed(_render(model, data, eye, size), scene.light)
    eye = _camera(middle, 0.72 * span, -33.0, 58.0)
    size = (pixels or 1600, (pixels or 1600) * 9 // 16)
    with _lens(model, 42.0, 0.005 * span, 6.0 * span):
        return _dimmed(_render(model, data, eye, size), scene.light)


def render_vehicle(scene: Scene, pixels: int = 1200) -> Image:
    """The vehicle where it takes off, 16:9, ``pixels`` wide, from ahead and aside; sensors never
    draw it, so that no other image shows it. The model is left as it was."""
    model = scene.model
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    body = data.body(VEHICLE_BODY)
    reach = np.linalg.norm(model.geom_pos[model.geom_bodyid == body.id][:, :2], axis=1).max()
    eye = _camera(
        body.xpos[:2], 0.35 + 3.4 * float(reach), -16.0, np.rad2deg(scene.takeoff_yaw) + 215.0
    )
    eye.lookat[2] = body.xpos[2]
    options = mujoco.MjvOption()
    options.geomgroup[VEHICLE_GROUP] = 1
    with _lens(model, 42.0, 0.02, 300.0):
        return _render(model, data, eye, (pixels, pixels * 9 // 16), options)


_BRIGHTNESS = {
    "day": (1.0, 1.0, 1.0),
    "overcast": (0.92, 0.93, 0.95),
    "dusk": (0.62, 0.56, 0.54),
    "night": (0.16, 0.19, 0.26),
}
"""of pictures for people, whose eyes adapt: far less different than the lights"""


def _dimmed(image: Image, light: str) -> Image:
    """The picture as bright as its light seems to an eye; by day as drawn."""
    if light == "day":
        return image
    return np.rint(image * np.array(_BRIGHTNESS[light])).astype(np.uint8)


@contextmanager
def _lens(model: Any, fovy_deg: float, near_m: float, far_m: float) -> Iterator[None]:
    """The free camera's field of view and clip planes, put back afterwards."""
    visual, extent = model.vis, float(model.stat.extent)
    kept = float(visual.global_.fovy), float(visual.map.znear), float(visual.map.zfar)
    visual.global_.fovy = fovy_deg
    visual.map.znear, visual.map.zfar = near_m / extent, far_m / extent
    try:
        yield
    finally:
        visual.global_.fovy, visual.map.znear, visual.map.zfar = kept


def _camera(xy_m: NDArray[np.float64], distance: float, elevation: float, azimuth: float) -> Any:
    camera = mujoco.MjvCamera()
    camera.lookat[:] = [*xy_m, 0.0]
    camera.distance, camera.elevation, camera.azimuth = distance, elevation, azimuth
    return camera


def _render(
    model: Any, data: Any, camera: Any, size: tuple[int, int], options: Any = None
) -> Image:
    """(H, W, 3) uint8. Rendered twice as large and scaled down, against jagged edges."""
    width, height = 2 * size[0], 2 * size[1]
    kept = int(model.vis.global_.offwidth), int(model.vis.global_.offheight)
    model.vis.global_.offwidth = max(kept[0], width)
    model.vis.global_.offheight = max(kept[1], height)
    try:
        with mujoco.Renderer(model, height, width, max_geom=model.ngeom + 200) as renderer:
            renderer.update_scene(data, camera, options)
            image = renderer.render()
    finally:
        model.vis.global_.offwidth, model.vis.global_.offheight = kept
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
