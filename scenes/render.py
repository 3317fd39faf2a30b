"""Pictures of a scene for people."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from scenes.api import Scene
from scenes.compose import VEHICLE_GROUP

Picture = NDArray[np.uint8]

SURVEY_HEIGHT_M = 30.0


def render_views(scene: Scene, out_dir: Path) -> list[Path]:
    """Writes ``above.png`` (map-like, north up), ``oblique.png`` and ``camera.png`` (848x480, the
    vehicle's camera 30 m above the take-off spot). Returns the paths in this order."""
    model = scene.model
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    middle = scene.bounds_xy_m.mean(axis=0)
    span = float(np.ptp(scene.bounds_xy_m, axis=0).max())
    # A narrow lens far away shows roofs, not walls.
    above = _camera(middle, 4.0 * span, -89.99, 90.0)
    oblique = _camera(middle, 0.72 * span, -33.0, 58.0)
    out = Path(out_dir)
    out.mkdir(parents=True, exist_ok=True)
    narrow = float(np.rad2deg(2.0 * np.arctan(0.51 / 4.0)))
    with _lens(model, narrow, 1.0 * span, 6.0 * span):
        pictures = [_render(model, data, above, (1080, 1080), 2, vehicle=True)]
    with _lens(model, 42.0, 0.005 * span, 6.0 * span):
        pictures.append(_render(model, data, oblique, (1600, 900), 2, vehicle=True))
    data.qpos[2] += SURVEY_HEIGHT_M
    mujoco.mj_forward(model, data)
    pictures.append(_render(model, data, "vehicle/camera", (848, 480), 1, vehicle=False))
    paths = [out / f"{name}.png" for name in ("above", "oblique", "camera")]
    for path, picture in zip(paths, pictures, strict=True):
        if not cv2.imwrite(str(path), picture[..., ::-1]):
            raise ValueError(f"cannot write {path}: is the folder writable?")
    return paths


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
    model: Any, data: Any, camera: Any, size: tuple[int, int], oversample: int, vehicle: bool
) -> Picture:
    """(H, W, 3) uint8. Rendered larger by ``oversample`` and scaled down, against jagged edges."""
    width, height = size[0] * oversample, size[1] * oversample
    kept = int(model.vis.global_.offwidth), int(model.vis.global_.offheight)
    model.vis.global_.offwidth = max(kept[0], width)
    model.vis.global_.offheight = max(kept[1], height)
    option = mujoco.MjvOption()
    option.geomgroup[VEHICLE_GROUP] = int(vehicle)
    try:
        with mujoco.Renderer(model, height, width, max_geom=model.ngeom + 200) as renderer:
            renderer.update_scene(data, camera, option)
            picture: Picture = renderer.render().copy()
    finally:
        model.vis.global_.offwidth, model.vis.global_.offheight = kept
    if oversample > 1:
        return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
    return picture
