"""Detail texture of the ground near the camera: photographs multiplied into the drawn raster.

A scene's ground has one texture with a texel of 2.5 cm, ten pixels of a camera 1.5 m up. Where the
camera is nearer to the ground than `FAR_M`, each pixel's place follows from its depth and the
camera's pose; the photograph of that place's material, divided by its own local mean, multiplies
the pixel. The colour, its patterns and its light stay the scene's own.

Photographs lie periodically on the world's x and y, in two layers turned against each other that
give way to one another in patches of a metre, so that no tile is seen. Each pixel takes the texel
as large as itself (a mip level), blended between neighbours where the texel is larger.
"""

import functools
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple
from zlib import crc32

import cv2
import mujoco
import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.ndimage import fourier_gaussian

from touchdown.scenes.api import DETAILS, LAND_CLASSES, NO_DETAIL_ID, OTHER_CLASS_ID, Scene
from touchdown.sim.api import CameraIntrinsics
from touchdown.sim.camera.detail_kernels import (
    FAR_M,
    LEVELS,
    SIDE_PX,
    TOLERANCE_M,
    TURN,
    multiply_texture,
)
from touchdown.sim.camera.gl import InverseDepth, Snapshot
from touchdown.sim.camera.vegetation import Vegetation
from touchdown.sim.geometry.tessellation import FIRST_HIDDEN_GROUP, geom_mesh, may_move
from touchdown.sim.typing import Array, Bytes, Float32

PHOTOGRAPHS = Path(__file__).parent / "photographs"
_HEIGHT_CELL_M = 0.25
_KIND_CELL_M = 0.1
_MAX_CELLS = 2048
_MARGIN_M = 8.0
_HIGH_M = 1e3
_NOISE_PX = 256
_OF_CLASS = {"lawn": "grass", "field": "soil", "path": "concrete", "road": "asphalt"}
"""Photographs of geoms of a class."""
_GROUND_TYPES = (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD))


class _Look(NamedTuple):
    """Use of a photograph."""

    side_m: float
    """of the ground that it shows"""
    gain: float
    """of its contrast"""
    colour: float
    """fraction of its colour's own contrast: the scene's ground has its own colour"""
    smooth_px: float
    """structures wider than this are the scene's own texture's"""


LOOKS: dict[str, _Look] = {
    "grass": _Look(1.5, 1.0, 0.6, 50.0),
    "meadow": _Look(1.2, 1.0, 0.35, 60.0),
    "soil": _Look(1.5, 1.6, 0.5, 50.0),
    "litter": _Look(1.5, 0.7, 0.5, 40.0),
    "asphalt": _Look(1.2, 1.0, 0.6, 50.0),
    "gravel": _Look(1.0, 0.6, 0.6, 60.0),
    "concrete": _Look(2.0, 0.6, 0.5, 40.0),
    "sand": _Look(1.2, 1.0, 0.4, 40.0),
    "dune": _Look(1.0, 2.2, 0.1, 40.0),
    "snow": _Look(2.0, 1.3, 0.3, 25.0),
    "rock": _Look(2.0, 1.4, 0.5, 50.0),
}


@dataclass(frozen=True, slots=True)
class GroundLookup:
    """Height and photograph of the ground by place, world frame, rows along y. Cell (0, 0) of both
    begins at ``origin_xy_m``; ``kind`` counts the photographs in ``names``, 255 for none."""

    origin_xy_m: Array
    height_cell_m: float
    height_m: Float32
    kind_cell_m: float
    kind: Bytes
    names: tuple[str, ...]


class Pyramid(NamedTuple):
    """Textures at several sizes, each half as wide as the one before."""

    texels: NDArray[np.uint32]
    """red | green << 8 | blue << 16; photograph by photograph, level by level, row by row"""
    starts: NDArray[np.int64]
    """(photographs, LEVELS)"""


class DetailTexture:
    """Adds the detail texture of a scene's ground and the ``vegetation`` on it to rasters of
    ``pinhole``."""

    def __init__(
        self, scene: Scene, pinhole: CameraIntrinsics, vegetation: Vegetation | None = None
    ) -> None:
        self._ground = ground_lookup(scene)
        self._vegetation = vegetation
        self._planted_m = self._ground.height_m
        if vegetation is not None:
            self._planted_m = _heights_with_plants(self._ground, vegetation)
        self._pinhole = pinhole
        self._pyramid = pyramid(self._ground.names)
        looks = [LOOKS[name] for name in self._ground.names]
        self._texels_per_m = np.array([SIDE_PX / look.side_m for look in looks], np.float32)
        self._noise = blend_noise()

    def needed(self, snapshot: Snapshot, camera_id: int) -> bool:
        """True where ground may be near enough: most images of a flight need none, nor their
        depth."""
        ground = self._ground
        eye = snapshot.cam_xpos[camera_id]
        cell = np.floor((eye[:2] - ground.origin_xy_m) / ground.height_cell_m).astype(int)
        reach = int(np.ceil(FAR_M / ground.height_cell_m))
        low = np.clip(cell - reach, 0, np.array(ground.height_m.shape)[::-1])
        high = np.clip(cell + reach + 1, 0, np.array(ground.height_m.shape)[::-1])
        near = ground.height_m[low[1] : high[1] : 4, low[0] : high[0] : 4]
        return bool(ground.names) and bool((near > eye[2] - FAR_M).any())

    def add(
        self, drawn: Bytes, depth: InverseDepth, snapshot: Snapshot, camera_id: int, last_row: int
    ) -> None:
        """Multiplies the texture into ``drawn`` (rows, W, 3), in place. It and ``depth`` come
        bottom row first, as `Stage` draws them; that is row ``last_row`` - 1 of the raster."""
        axes = snapshot.cam_xmat[camera_id].reshape(3, 3)
        k, ground = self._pinhole, self._ground
        bare = self._vegetation is not None and self._vegetation.hides(snapshot.cam_xpos[camera_id])
        heights = ground.height_m if bare else self._planted_m
        # MuJoCo's cameras look along -z, with x to the right and y up.
        right, down, ahead = axes[:, 0] / k.fx, -axes[:, 1] / k.fy, -axes[:, 2]
        corner = ahead - k.cx * right + (last_row - 1 - k.cy) * down
        rays = np.stack([corner, right, -down]).astype(np.float32)
        # Texel numbers stay positive, so that cutting off decimals rounds down.
        beyond = TURN[1] * heights.shape[1] * ground.height_cell_m + 1.0
        cells_per_m = 1.0 / ground.height_cell_m, 1.0 / ground.kind_cell_m
        frame = np.array([*ground.origin_xy_m, *cells_per_m, beyond])
        multiply_texture(
            drawn, depth.levels, np.float32(depth.far), np.float32(depth.per_level),
            snapshot.cam_xpos[camera_id], rays, frame, heights, ground.kind,
            self._pyramid.texels, self._pyramid.starts, self._texels_per_m, self._noise,
            np.float32(1.0 / k.fx),
        )  # fmt: skip


def ground_lookup(scene: Scene) -> GroundLookup:
    """Casts rays down on what is ground or water: planes, height fields, and geoms of the classes
    lawn, field, path, road and water that do not move."""
    model = scene.model
    low, high = scene.bounds_xy_m[0] - _MARGIN_M, scene.bounds_xy_m[1] + _MARGIN_M
    cell = max(_HEIGHT_CELL_M, float((high - low).max()) / _MAX_CELLS)
    cols, rows = np.ceil((high - low) / cell).astype(int)
    geoms = _ground_geoms(scene)
    heights = np.full((rows, cols), -np.inf, np.float32)
    owner = np.full((rows, cols), -1, np.int32)
    if geoms:
        x = low[0] + (np.arange(cols) + 0.5) * cell
        y = low[1] + (np.arange(rows) + 0.5) * cell
        xy = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        rays = np.zeros((len(xy), 6), np.float32)
        rays[:, :2], rays[:, 2], rays[:, 5] = xy, _HIGH_M, -1.0
        hits = _target(model, geoms).cast(rays)
        met = hits.geom >= 0
        heights.ravel()[met] = _HIGH_M - hits.distance[met]
        owner.ravel()[:] = hits.geom
    kind_cell = max(_KIND_CELL_M, float((high - low).max()) / _MAX_CELLS)
    kinds = _kinds(scene, owner, low, cell, kind_cell)
    used = np.unique(kinds)
    used = used[used != NO_DETAIL_ID]
    number = np.full(256, NO_DETAIL_ID, np.uint8)
    number[used] = np.arange(len(used))
    names = tuple(DETAILS[kind] for kind in used)
    return GroundLookup(low, cell, heights, kind_cell, number[kinds], names)


def _heights_with_plants(ground: GroundLookup, vegetation: Vegetation) -> Float32:
    """Heights of ``ground`` with the plants of ``vegetation``."""
    rows, cols = ground.height_m.shape
    x, y = (low + (np.arange(count) + 0.5) * ground.height_cell_m for low, count in
            zip(ground.origin_xy_m, (cols, rows), strict=True))  # fmt: skip
    places = [axis.ravel() for axis in np.meshgrid(x, y)]
    raised = vegetation.raised_at(*places).reshape(rows, cols)
    bare = vegetation.ground_at(*places).reshape(rows, cols)
    open_ground = np.abs(ground.height_m - bare) < TOLERANCE_M
    return np.where(open_ground, ground.height_m + raised, ground.height_m).astype(np.float32)


def _ground_geoms(scene: Scene) -> list[int]:
    model = scene.model
    found = []
    for geom in range(model.ngeom):
        surface = scene.surfaces.get(model.geom(geom).name)
        ground = int(model.geom_type[geom]) in _GROUND_TYPES
        ground = ground or (surface is not None and surface.land_class in (*_OF_CLASS, "water"))
        seen = model.geom_group[geom] < FIRST_HIDDEN_GROUP
        if ground and seen and not may_move(model, geom):
            found.append(geom)
    return found


def _target(model: Any, geoms: list[int]) -> Any:
    """A `RayTarget` of static geoms."""
    # Open3D loads slowly, and nobody else in this folder needs it.
    from touchdown.sim.geometry.ray_target import RayTarget, TargetParts, geom_pose

    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    parts = TargetParts.none(model)
    for geom in geoms:
        parts.add(model, geom, geom_pose(data, geom), geom_mesh(model, geom, 2.0 * _HIGH_M))
    return RayTarget(parts)


def _kinds(
    scene: Scene, owner: NDArray[np.int32], low: Array, cell_m: float, kind_cell_m: float
) -> Bytes:
    """Indices into DETAILS on cells of ``kind_cell_m``."""
    of_geom = np.full(scene.model.ngeom + 1, NO_DETAIL_ID, np.uint8)
    for geom in np.unique(owner[owner >= 0]):
        surface = scene.surfaces.get(scene.model.geom(int(geom)).name)
        land_class = surface.land_class if surface is not None else "other"
        if land_class not in ("water", "building", "trees"):
            of_geom[geom] = DETAILS.index(_OF_CLASS.get(land_class, "soil"))
    size = np.floor(np.array(owner.shape) * cell_m / kind_cell_m).astype(int)
    y, x = (low[axis] + (np.arange(count) + 0.5) * kind_cell_m for axis, count in
            ((1, size[0]), (0, size[1])))  # fmt: skip
    rows = ((y - low[1]) / cell_m).astype(int)
    cols = ((x - low[0]) / cell_m).astype(int)
    below = owner[np.ix_(rows, cols)]
    kinds = of_geom[below]
    ground = scene.ground
    if ground is None:
        return kinds
    detail = ground.detail_id
    if detail is None:
        table = np.full(256, NO_DETAIL_ID, np.uint8)
        for name, photograph in _OF_CLASS.items():
            table[LAND_CLASSES.index(name)] = DETAILS.index(photograph)
        table[OTHER_CLASS_ID] = DETAILS.index("soil")
        detail = table[ground.class_id]
    row = ((y - ground.origin_xy_m[1]) / ground.cell_m).astype(int)
    col = ((x - ground.origin_xy_m[0]) / ground.cell_m).astype(int)
    raster = detail[np.ix_(np.clip(row, 0, len(detail) - 1), np.clip(col, 0, detail.shape[1] - 1))]
    return np.where(below == scene.model.geom(ground.geom_name).id, raster, kinds)


def texture(name: str) -> Bytes:
    """The photograph ``name`` over its local mean, (1024, 1024, 3) RGB: 128 where it is 1."""
    look = LOOKS[name]
    image = cv2.imread(str(PHOTOGRAPHS / f"{name}.jpg"), cv2.IMREAD_COLOR)
    if image is None:
        raise RuntimeError(f"the photograph {name}.jpg is missing from the installed package")
    image = cv2.resize(image, (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_AREA)
    picture = image[..., ::-1].astype(np.float32)
    spectrum = scipy.fft.rfft2(picture.transpose(2, 0, 1))
    blurred = fourier_gaussian(spectrum, (0.0, look.smooth_px, look.smooth_px), SIDE_PX)
    mean = scipy.fft.irfft2(blurred).transpose(1, 2, 0)
    ratio = picture / np.maximum(mean, 1.0)
    tone = ratio.mean(axis=2, keepdims=True)
    ratio = tone + look.colour * (ratio - tone)
    ratio = 1.0 + look.gain * (ratio - ratio.mean(axis=(0, 1)))
    return np.clip(np.rint(128.0 * ratio), 0, 255).astype(np.uint8)


def pyramid(names: tuple[str, ...]) -> Pyramid:
    """Mip levels of the textures of ``names``."""
    held = _held()
    if new := [name for name in names if name not in held.names]:
        levels = (level for name in new for level in _levels(texture(name)))
        held.texels = _filed([held.texels, *levels])
        held.names += new
    sizes = [(SIDE_PX >> step) ** 2 for step in range(LEVELS)]
    first = np.array([held.names.index(name) for name in names], np.int64) * sum(sizes)
    return Pyramid(held.texels, first[:, None] + np.cumsum([0, *sizes[:-1]]))


@dataclass
class _Held:
    names: list[str]
    texels: NDArray[np.uint32]


@functools.cache  # the same for every world
def _held() -> _Held:
    return _Held([], np.zeros(0, np.uint32))


def _filed(parts: list[NDArray[np.uint32]]) -> NDArray[np.uint32]:
    """``parts`` one after the other, in a file without a name where there is room for it."""
    try:
        with tempfile.TemporaryFile() as file:
            for part in parts:
                part.tofile(file)
            file.flush()
            return np.asarray(np.memmap(file, np.uint32, "c"))
    except OSError:
        return np.concatenate(parts)


def _levels(image: Bytes) -> Iterator[NDArray[np.uint32]]:
    """Packed texels of ``image`` and of its smaller levels."""
    for step in range(LEVELS):
        wide = image.astype(np.uint32)
        yield (wide[..., 0] | wide[..., 1] << 8 | wide[..., 2] << 16).ravel().astype(np.uint32)
        half = (SIDE_PX >> step + 1,) * 2
        image = np.asarray(cv2.resize(image, half, interpolation=cv2.INTER_AREA), np.uint8)


def blend_noise() -> Float32:
    """(256, 256) periodic, about 0.5: the fraction of the first layer, mostly 0 or 1, in patches of
    about a metre."""
    rng = np.random.default_rng(crc32(b"sim.camera.detail"))
    rows = np.fft.fftfreq(_NOISE_PX, 1.0 / _NOISE_PX)[:, None]
    cols = np.fft.rfftfreq(_NOISE_PX, 1.0 / _NOISE_PX)[None, :]
    band = np.exp(-(((np.hypot(rows, cols) - 12.0) / 5.0) ** 2))
    field = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((_NOISE_PX,) * 2)) * band)
    return np.clip(0.5 + 1.2 * field / field.std(), 0.0, 1.0).astype(np.float32)
