"""Pictures of scenes, and scenes as MJCF for other programs."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from experiments.build import build_scene, scene_spec
from experiments.config import UsageError, load_config
from scenes.api import Scene

_PICTURE_PIXELS = {"above": (1080, 1080), "oblique": (1600, 900), "camera": (848, 480)}
_CAMERA_HEIGHT_M = 30.0


def render_scene(name: str, seed: int, view: str, out: Path) -> None:
    """Writes a picture of a scene. ``view``: ``above`` (the whole of it, north up), ``oblique``
    (from the south-west), ``camera`` (through the vehicle's camera 30 m above the middle).
    Raises ValueError, FileNotFoundError or UsageError before anything is written."""
    if out.suffix.lower() not in (".png", ".jpg"):
        raise UsageError(f"--out {out} must end in .png or .jpg")
    scene = build_scene(load_config(scene=name, seed=seed))
    picture = scene_picture(scene, view)
    out.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(out), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)):
        raise UsageError(f"--out {out} cannot be written")


def scene_picture(scene: Scene, view: str) -> NDArray[np.uint8]:
    """(H, W, 3) RGB of a scene as at time 0."""
    model = scene.model
    data = mujoco.MjData(model)
    if view == "camera":
        middle = scene.bounds_xy_m.mean(axis=0)
        data.qpos[:3] = [*middle, data.qpos[2] + _CAMERA_HEIGHT_M]
    mujoco.mj_forward(model, data)
    width, height = _PICTURE_PIXELS[view]
    with mujoco.Renderer(model, height, width) as renderer:
        renderer.update_scene(data, camera=_eye(scene, view))
        picture: NDArray[np.uint8] = renderer.render()
    return picture


def export_scene(name: str, seed: int, out: Path) -> Path:
    """Writes ``scene.xml`` and its textures and meshes into a new or empty directory and returns
    the file. Raises ValueError, FileNotFoundError or UsageError before anything is written."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UsageError(f"--out {out} exists; name a new directory")
    spec = scene_spec(name, seed)
    out.mkdir(parents=True, exist_ok=True)
    for texture in spec.textures:
        if texture.file:
            _copy_file(texture, spec.texturedir, spec, out)
        elif len(texture.data) > 0:
            _write_picture(texture, out)
    for asset in (*spec.meshes, *spec.hfields):
        if asset.file:
            _copy_file(asset, spec.meshdir, spec, out)
    spec.meshdir = spec.texturedir = ""
    spec.modelfiledir = str(out.resolve())  # where compiling looks for the files just written
    spec.compile()
    model_file = out / "scene.xml"
    model_file.write_text(spec.to_xml(), encoding="utf-8")
    return model_file


def _write_picture(texture: Any, out: Path) -> None:
    """A texture made in memory becomes a PNG file; MJCF has no other place for it."""
    pixels = np.frombuffer(bytes(texture.data), dtype=np.uint8)
    picture = pixels.reshape(texture.height, texture.width, texture.nchannel)
    if texture.nchannel >= 3:
        picture = picture[:, :, 2::-1]
    texture.file = f"{texture.name.replace('/', '_')}.png"
    cv2.imwrite(str(out / texture.file), np.ascontiguousarray(picture))
    texture.data = b""


def _copy_file(asset: Any, folder: str, spec: Any, out: Path) -> None:
    source = Path(spec.modelfiledir or ".") / folder / asset.file
    shutil.copyfile(source, out / source.name)
    asset.file = source.name


def _eye(scene: Scene, view: str) -> Any:
    if view == "camera":
        return "vehicle/camera"
    low, high = scene.bounds_xy_m
    size = float((high - low).max())
    eye = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(scene.model, eye)
    eye.lookat[:] = [*(0.5 * (low + high)), 0.0]
    half_angle = np.radians(0.5 * scene.model.vis.global_.fovy)
    if view == "above":
        eye.azimuth, eye.elevation = 90.0, -90.0
        eye.distance = 0.5 * size / np.tan(half_angle)
    else:
        eye.azimuth, eye.elevation = 50.0, -38.0
        eye.distance = 0.36 * size / np.tan(half_angle)
    return eye
