"""Images of people, dogs and cyclists from the vehicle's camera, with the boxes that they fill."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.config.loading import load_config
from touchdown.experiments.config.schema import Config
from touchdown.experiments.flight.wiring import build_scene
from touchdown.landing.watch.people import SIZE
from touchdown.scenes.api import Scene
from touchdown.scenes.traffic.walkers import CLOTHES, SKINS
from touchdown.sim.camera.sensor import CAMERA_NAME, CameraSensor
from touchdown.sim.frames import quat_wxyz_from_matrix, so3_exp
from touchdown.sim.moving import MovingBodies
from touchdown.sim.typing import Array, Bytes, Float32

HEIGHTS_M = (1.5, 15.0)
_ASIDE = 0.8
"""greatest distance of a person from the middle of an image, over half of its width"""
_TILT_DEG = 12.0
_EMPTY = 0.25
"""fraction of images that look at a random place"""
_LEAST_PX = 20
"""pixels of a body in the whole image below which it is not to be found"""
_CROWD = ("traffic.people=24", "traffic.dogs=8", "traffic.bicycles=6", "traffic.radius_m=25")


@dataclass(frozen=True, slots=True)
class Labelled:
    """An image, (240, 424, 3) uint8, and the boxes of who is in it."""

    image: Bytes
    boxes: Float32
    """(N, 4) least x, y and greatest x, y in pixels of the image"""
    kinds: tuple[str, ...]
    """``person``, ``dog`` or ``bicycle``"""
    metres: Float32
    """(N,) from the camera"""


def rendered(
    scene: str, seed: int, light: str, count: int, settings: tuple[str, ...] = (), *,
    other_clothes: bool = False,
) -> Iterator[Labelled]:  # fmt: skip
    """Images of the place ``scene`` and its crowd in profile `field`, from 1.5 m to 15 m up;
    ``other_clothes``: of colours that nobody wears in the scenes."""
    lamp = [f"lamp.below_m={HEIGHTS_M[1]}"] if light == "night" else []
    config = load_config(None, [*_CROWD, *lamp, *settings], scene=scene, seed=seed, light=light)
    place = build_scene(config)
    if other_clothes:
        _dress_anew(place, np.random.default_rng([seed, 0x434C4F]))
    camera = _camera(config, place)
    rng = np.random.default_rng([seed, 0x50454F50])
    try:
        for index in range(count):
            yield _one(place, camera, rng, index)
    finally:
        camera.close()


def _dress_anew(scene: Scene, rng: np.random.Generator) -> None:
    """Gives every walker other colours of cloth, fur and paint: none near those of
    `scenes.traffic.walkers.CLOTHES`."""
    model, kept = scene.model, {tuple(np.array(skin, np.float32).tolist()) for skin in SKINS}
    for root in {body.walker for body in scene.moving if body.alive}:
        worn: dict[tuple[float, ...], Array] = {}
        for body in scene.moving:
            if body.walker != root:
                continue
            first = int(model.body(body.body_name).geomadr[0])
            for geom in range(first, first + int(model.body(body.body_name).geomnum[0])):
                colour = tuple(model.geom_rgba[geom, :3].tolist())
                if colour not in kept:
                    model.geom_rgba[geom, :3] = worn.setdefault(colour, _other_colour(rng))


def _other_colour(rng: np.random.Generator) -> Array:
    while True:
        colour = rng.uniform(0.03, 0.97, 3)
        if np.linalg.norm(np.array(CLOTHES) - colour, axis=1).min() > 0.25:
            return np.asarray(colour)


def write_images(out: Path, images: Iterable[Labelled]) -> int:
    """Writes images and boxes into one file *.npz; returns how many."""
    found = list(images)
    counts = [len(one.boxes) for one in found]
    out.parent.mkdir(parents=True, exist_ok=True)
    np.savez(
        out,
        images=np.stack([one.image for one in found]),
        rows=np.repeat(np.arange(len(found)), counts),
        boxes=np.concatenate([one.boxes for one in found]),
        kinds=np.array([kind for one in found for kind in one.kinds], dtype="U8"),
        metres=np.concatenate([one.metres for one in found]),
    )
    return len(found)


def read_images(folder: Path) -> Iterator[Labelled]:
    """The images of all files of a folder, in the order of their names. Raises ValueError where
    there are none or one cannot be read."""
    files = sorted(folder.glob("*.npz"))
    if not files:
        raise ValueError(
            f"'{folder}' has no images of people; `touchdown people render` makes some"
        )
    for file in files:
        try:
            with np.load(file, allow_pickle=False) as kept:
                parts = {
                    name: kept[name] for name in ("images", "rows", "boxes", "kinds", "metres")
                }
        except (OSError, ValueError, KeyError) as error:
            raise ValueError(f"'{file}' holds no images of people: {error}") from error
        for index, image in enumerate(parts["images"]):
            own = parts["rows"] == index
            yield Labelled(
                image, parts["boxes"][own], tuple(parts["kinds"][own].tolist()),
                parts["metres"][own],
            )  # fmt: skip


def _camera(config: Config, scene: Scene) -> CameraSensor:
    return CameraSensor(scene, config.camera, config.seed, lamp=config.lamp)


def _one(scene: Scene, camera: CameraSensor, rng: np.random.Generator, index: int) -> Labelled:
    model, data = scene.model, mujoco.MjData(scene.model)
    moving = MovingBodies(scene)
    moving.write(data, float(rng.uniform(0.0, 600.0)))
    living = moving.living(data)
    height = math.exp(float(rng.uniform(*np.log(HEIGHTS_M))))
    target = living[int(rng.integers(len(living)))].copy()
    away = _ASIDE * height * math.tan(math.radians(34.5)) * float(rng.uniform(0.0, 1.0))
    if rng.random() < _EMPTY:
        away += float(rng.uniform(5.0, 15.0))
    turn = float(rng.uniform(0.0, 2.0 * np.pi))
    eye = target + [away * math.cos(turn), away * math.sin(turn), height]
    _place(model, data, eye, rng)
    snapshot = camera.snapshot(data)
    image = camera.render(snapshot, index + 1)
    geoms = camera.render_segmentation(snapshot)
    return _labelled(image, geoms, scene, data, camera.intrinsics().width)


def _place(model: Any, data: Any, eye: Array, rng: np.random.Generator) -> None:
    """Puts the vehicle's camera at ``eye`` (3,), tilted like a vehicle in wind."""
    body = model.body("vehicle/quadrotor")
    start = int(model.jnt_qposadr[body.jntadr[0]])
    axis = rng.normal(size=2)
    tilt = math.radians(_TILT_DEG) * float(rng.uniform(0.0, 1.0)) / np.linalg.norm(axis)
    yaw = so3_exp(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
    rotation = yaw @ so3_exp(np.array([*(tilt * axis), 0.0]))
    data.qpos[start : start + 3] = eye
    data.qpos[start + 3 : start + 7] = quat_wxyz_from_matrix(rotation)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    offset = data.cam_xpos[model.camera(CAMERA_NAME).id] - eye
    data.qpos[start : start + 3] = eye - offset
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)


def _labelled(
    image: Bytes, geoms: NDArray[np.int32], scene: Scene, data: Any, width: int
) -> Labelled:
    model, scale = scene.model, SIZE[0] / width
    who = np.full(model.ngeom + 1, -1)
    names, places = [], []
    for body in scene.moving:
        if not body.alive:
            continue
        if body.walker == body.body_name:
            names.append(body.walker)
            places.append(data.mocap_pos[model.body(body.body_name).mocapid[0]])
        first, count = model.body(body.body_name).geomadr[0], model.body(body.body_name).geomnum[0]
        who[first : first + count] = names.index(body.walker)
    shown = who[geoms]
    eye = data.cam_xpos[model.camera(CAMERA_NAME).id]
    boxes, kinds, metres = [], [], []
    for index in np.unique(shown[shown >= 0]):
        rows, cols = np.nonzero(shown == index)
        if len(rows) < _LEAST_PX:
            continue
        boxes.append([cols.min(), rows.min(), cols.max() + 1, rows.max() + 1])
        kinds.append(names[index].split("/")[1].split("_")[0])
        metres.append(np.linalg.norm(eye - places[index]))
    small = cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA)
    return Labelled(
        np.asarray(small, np.uint8), np.array(boxes, np.float32).reshape(-1, 4) * scale,
        tuple(kinds), np.array(metres, np.float32),
    )  # fmt: skip
