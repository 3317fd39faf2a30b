"""Images of people, dogs and cyclists from the vehicle's camera, with the boxes that they fill."""

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
from touchdown.experiments.flight.wiring import build_scene
from touchdown.landing.watch.people import LEAST_WIDTH
from touchdown.scenes.api import VEHICLE_BODY, VEHICLE_GROUP, MovingBody, Scene
from touchdown.scenes.traffic.walkers import CLOTHES, SKINS
from touchdown.scenes.truth.static_surface import cast_points
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.camera.sensor import (
    CAMERA_NAME,
    CameraSensor,
    GroundEffects,
    Snapshot,
)
from touchdown.sim.camera.vegetation import Vegetation
from touchdown.sim.frames import quat_wxyz_from_matrix, so3_exp
from touchdown.sim.lidar.surface_detail import SurfaceDetail
from touchdown.sim.moving import MovingBodies
from touchdown.sim.typing import Array, Bytes, Float32

HEIGHTS_M = (1.5, 15.0)
_ASIDE = 0.8
"""greatest distance of a person from the middle of an image, over half of its width"""
_TILT_DEG = 12.0
_EMPTY = 0.25
"""fraction of images that look at a random place"""
_KEPT_M = 0.025
"""metres on the ground of a pixel that is kept; for the nearest images the least width decides"""
SHOWN = 0.35
"""fraction of a body from which on somebody is to be found; of less, nothing is asked"""
_ABOVE_GROUND_M = 1.0
_RUNS_M = 2.0
"""stride from which on one runs"""
_LAMP_M = 20.0
"""height below which a lamp shines by night: above all of the heights"""
_CROWD = ("traffic.people=24", "traffic.dogs=8", "traffic.bicycles=6", "traffic.radius_m=25")


@dataclass(frozen=True, slots=True)
class Labelled:
    """An image, (H, W, 3) uint8 RGB, and the boxes of who is in it."""

    image: Bytes
    metres_per_pixel: float
    """on the ground below"""
    boxes: Float32
    """(N, 4) least x, y and greatest x, y in pixels of the image"""
    kinds: tuple[str, ...]
    """``dog``, ``bicycle``, or ``person`` and what he does: walks, runs, stands, sits"""
    metres: Float32
    """(N,) from the camera"""
    shown: Float32
    """(N,) fraction of the body that the image shows, 0 to 1; the rest is hidden or outside"""
    light: str = "day"


def rendered(
    scene: str, seed: int, light: str, count: int, settings: tuple[str, ...] = (), *,
    other_clothes: bool = False,
) -> Iterator[Labelled]:  # fmt: skip
    """Images of the place ``scene`` and its crowd in profile `field`, from 1.5 m to 15 m up, in
    colours near those that are worn in the scenes; ``other_clothes``: in colours far from them."""
    lamp = [f"lamp.below_m={_LAMP_M}"] if light == "night" else []
    config = load_config(None, [*_CROWD, *lamp, *settings], scene=scene, seed=seed, light=light)
    place = build_scene(config)
    vegetation = Vegetation.of(place, SurfaceDetail.plants_of(config.lidar, place))
    effects = GroundEffects(vegetation=vegetation)
    camera = CameraSensor(place, config.camera, config.seed, lamp=config.lamp, ground=effects)
    rng = np.random.default_rng([seed, 0x50454F50])
    crowd = _Crowd(place, rng, other_clothes)
    try:
        for index in range(count):
            yield _one(crowd, camera, rng, index)
    finally:
        camera.close()


class _Crowd:
    """The walkers of a scene: their geoms, kinds and colours."""

    def __init__(self, scene: Scene, rng: np.random.Generator, other_clothes: bool) -> None:
        self.scene, self._rng, self._other = scene, rng, other_clothes
        self.moving, self.data = MovingBodies(scene), mujoco.MjData(scene.model)
        model = scene.model
        kept = {tuple(np.array(skin, np.float32).tolist()) for skin in SKINS}
        roots = [one for one in scene.moving if one.alive and one.walker == one.body_name]
        self.names = [one.walker for one in roots]
        self.kinds = [_kind(one, scene.moving) for one in roots]
        self.who = np.full(model.ngeom + 1, -1)
        """of each geom, and of none at last"""
        self._worn: dict[tuple[Any, ...], list[int]] = {}
        for body in (one for one in scene.moving if one.alive):
            first = int(model.body(body.body_name).geomadr[0])
            for geom in range(first, first + int(model.body(body.body_name).geomnum[0])):
                self.who[geom] = self.names.index(body.walker)
                colour = tuple(model.geom_rgba[geom, :3].tolist())
                if colour not in kept:
                    self._worn.setdefault((body.walker, *colour), []).append(geom)

    def dress(self) -> None:
        """Gives every walker other colours of cloth, fur and paint."""
        for geoms in self._worn.values():
            colour = _other_colour(self._rng) if self._other else _near_colour(self._rng)
            self.scene.model.geom_rgba[geoms, :3] = colour


def _kind(root: MovingBody, moving: tuple[MovingBody, ...]) -> str:
    kind = root.walker.split("/")[1].split("_")[0]
    if kind != "person":
        return kind
    limbs = [one.limb for one in moving if one.walker == root.walker and one.limb is not None]
    if all(limb.swing_deg == 0.0 for limb in limbs):
        return "person sits"
    if len(root.path_world) == 1:
        return "person stands"
    return "person runs" if limbs[0].stride_m > _RUNS_M else "person walks"


def _near_colour(rng: np.random.Generator) -> Array:
    """A colour nearer than a quarter to one that is worn in the scenes."""
    worn = np.array(CLOTHES)[int(rng.integers(len(CLOTHES)))]
    way = rng.normal(size=3)
    way *= 0.25 * float(rng.uniform()) / np.linalg.norm(way)
    return np.asarray(np.clip(worn + way, 0.03, 0.97))


def _other_colour(rng: np.random.Generator) -> Array:
    while True:
        colour = rng.uniform(0.03, 0.97, 3)
        if np.linalg.norm(np.array(CLOTHES) - colour, axis=1).min() > 0.25:
            return np.asarray(colour)


_PARTS = ("pixels", "shapes", "scales", "rows", "boxes", "kinds", "metres", "shown")


def write_images(out: Path, images: Iterable[Labelled]) -> int:
    """Writes images and boxes into one file *.npz; returns how many."""
    found = list(images)
    counts = [len(one.boxes) for one in found]
    out.parent.mkdir(parents=True, exist_ok=True)
    np.savez(
        out,
        pixels=np.concatenate([one.image.ravel() for one in found]),
        shapes=np.array([one.image.shape for one in found]),
        scales=np.array([one.metres_per_pixel for one in found]),
        rows=np.repeat(np.arange(len(found)), counts),
        boxes=np.concatenate([one.boxes for one in found]),
        kinds=np.array([kind for one in found for kind in one.kinds], dtype="U16"),
        metres=np.concatenate([one.metres for one in found]),
        shown=np.concatenate([one.shown for one in found]),
    )
    return len(found)


def read_images(folder: Path) -> Iterator[Labelled]:
    """The images of all files of a folder, in the order of their names, which end with the light.
    Raises ValueError where there are none or one cannot be read."""
    files = sorted(folder.glob("*.npz"))
    if not files:
        raise ValueError(
            f"'{folder}' has no images of people; `touchdown people render` makes some"
        )
    for file in files:
        try:
            with np.load(file, allow_pickle=False) as kept:
                parts = {name: kept[name] for name in _PARTS}
        except (OSError, ValueError, KeyError) as error:
            raise ValueError(f"'{file}' holds no images of people: {error}") from error
        ends = np.cumsum(parts["shapes"].prod(axis=1))[:-1]
        for index, flat in enumerate(np.split(parts["pixels"], ends)):
            own = parts["rows"] == index
            yield Labelled(
                flat.reshape(parts["shapes"][index]), float(parts["scales"][index]),
                parts["boxes"][own], tuple(parts["kinds"][own].tolist()), parts["metres"][own],
                parts["shown"][own], file.stem.rpartition("-")[2],
            )  # fmt: skip


def _one(
    crowd: _Crowd, camera: CameraSensor, rng: np.random.Generator, index: int
) -> Labelled:  # fmt: skip
    crowd.dress()
    scene, model, data = crowd.scene, crowd.scene.model, crowd.data
    crowd.moving.write(data, float(rng.uniform(0.0, 600.0)))
    mujoco.mj_kinematics(model, data)
    while True:
        eye = _eye(crowd.moving.living(data), rng)
        above = _above_ground(scene, data, eye)
        if above > _ABOVE_GROUND_M:
            break
    _place(model, data, eye, rng)
    snapshot, k = camera.snapshot(data), camera.intrinsics()
    image = camera.render(snapshot, index + 1)
    shown = crowd.who[camera.render_segmentation(snapshot)]
    full = crowd.who[_undisturbed(camera, snapshot, crowd)] if (shown >= 0).any() else shown
    boxes, kinds, metres, parts = [], [], [], []
    position = data.cam_xpos[model.camera(CAMERA_NAME).id]
    inside = _inside(crowd, data, k)
    for who in np.unique(shown[shown >= 0]):
        rows, cols = np.nonzero(shown == who)
        boxes.append([cols.min(), rows.min(), cols.max() + 1, rows.max() + 1])
        kinds.append(crowd.kinds[who])
        place = data.mocap_pos[model.body(crowd.names[who]).mocapid[0]]
        metres.append(np.linalg.norm(position - place))
        parts.append(min(len(rows) / max((full == who).sum(), 1), 1.0) * inside[who])
    per_pixel = above / k.fx
    scale = min(max(per_pixel / _KEPT_M, 2.0 * LEAST_WIDTH / k.width), 1.0)
    size = round(scale * k.width), round(scale * k.height)
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    ratio = np.tile([size[0] / k.width, size[1] / k.height], 2)
    return Labelled(
        np.asarray(small, np.uint8), per_pixel * k.width / size[0],
        (np.array(boxes).reshape(-1, 4) * ratio).astype(np.float32),
        tuple(kinds), np.array(metres, np.float32), np.array(parts, np.float32),
    )  # fmt: skip


def _eye(living: Array, rng: np.random.Generator) -> Array:
    """(3,) a place over somebody of (N, 3), or aside."""
    height = float(rng.uniform(*HEIGHTS_M))
    target = living[int(rng.integers(len(living)))]
    away = _ASIDE * height * math.tan(math.radians(34.5)) * float(rng.uniform(0.0, 1.0))
    if rng.random() < _EMPTY:
        away += float(rng.uniform(5.0, 15.0))
    turn = float(rng.uniform(0.0, 2.0 * np.pi))
    return target + [away * math.cos(turn), away * math.sin(turn), height]


def _above_ground(scene: Scene, data: Any, eye: Array) -> float:
    """Height above what lies below, at most `HEIGHTS_M`; crowns and the like are passed through
    as the LIDAR's last echoes do."""
    model, geom = scene.model, np.zeros(1, np.int32)
    tops = cast_points(scene, eye[None, :2])[0]
    if eye[2] < tops[0] + _ABOVE_GROUND_M:
        return 0.0
    point, down = eye.copy(), np.array([0.0, 0.0, -1.0])
    while True:
        away = mujoco.mj_ray(model, data, point, down, None, True, -1, geom)
        if away < 0.0:
            return 0.0
        point[2] -= away
        name = model.geom(int(geom[0])).name
        root = int(model.body_rootid[model.geom_bodyid[geom[0]]])
        passed = name in scene.surfaces and scene.surfaces[name].porosity > 0.0
        if not passed and model.body_mocapid[root] < 0 and model.body_jntnum[root] == 0:
            return float(min(eye[2] - point[2], HEIGHTS_M[1] + 2.0))
        point[2] -= 1e-3


def _undisturbed(camera: CameraSensor, snapshot: Snapshot, crowd: _Crowd) -> NDArray[np.int32]:
    """Geoms that pixels would show were there nobody and nothing but the crowd."""
    model = crowd.scene.model
    kept = model.geom_group.copy()
    model.geom_group[crowd.who[:-1] < 0] = VEHICLE_GROUP
    try:
        return camera.render_segmentation(snapshot)
    finally:
        model.geom_group[:] = kept


def _inside(crowd: _Crowd, data: Any, k: CameraIntrinsics) -> Array:
    """(N,) fraction of each walker's geoms, by their area, whose middles lie in the picture."""
    model = crowd.scene.model
    camera = model.camera(CAMERA_NAME).id
    axes = data.cam_xmat[camera].reshape(3, 3) * [1.0, -1.0, -1.0]
    points = (data.geom_xpos - data.cam_xpos[camera]) @ axes
    depth = np.maximum(points[:, 2], 1e-6)
    x, y = k.fx * points[:, 0] / depth + k.cx, k.fy * points[:, 1] / depth + k.cy
    seen = (points[:, 2] > 0.0) & (x >= 0) & (x < k.width) & (y >= 0) & (y < k.height)
    area = model.geom_rbound**2 / depth**2
    who = crowd.who[:-1]
    mine, count = who >= 0, len(crowd.names)
    total = np.bincount(who[mine], area[mine], count)
    return np.bincount(who[mine], (area * seen)[mine], count) / np.maximum(total, 1e-12)


def _place(model: Any, data: Any, eye: Array, rng: np.random.Generator) -> None:
    """Puts the vehicle's camera at ``eye`` (3,), tilted like a vehicle in wind."""
    body = model.body(VEHICLE_BODY)
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
