"""Square aerial patches of rendered scenes with the class of their ground.

A patch is cut out of an image of the vehicle's camera; its class is that of most of its pixels by
the ground-truth segmentation. Light, blur and noise are random for each patch, and in a part of the
images the colours of materials, such as red asphalt, pale paving, dark roofs: a network that is
trained on few scenes relies on their palette, and learns texture and shape instead (domain
randomisation: Tobin et al., IROS 2017)."""

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple
from zlib import crc32

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.config.loading import load_config
from touchdown.experiments.flight.wiring import build_scene
from touchdown.experiments.scene_tools.posed_views import (
    posed_sensors,
    random_view,
    write_ground_classes,
)
from touchdown.scenes.api import LAND_CLASSES, OTHER_CLASS_ID, Scene
from touchdown.scenes.authoring.ground import varied_materials
from touchdown.scenes.truth.static_surface import geom_classes
from touchdown.sim.posed_sensors import PosedView
from touchdown.sim.typing import Array, Image, Int32

Counts = NDArray[np.int64]

HEIGHTS_M = (5.0, 60.0)
SIDES_M = (3.2, 25.6)
"""side of the square of ground, uniform in its logarithm; flights classify 6.4 m"""
MIN_FRACTION, MIN_MIDDLE_FRACTION = 0.6, 0.95
"""smallest fraction of the class in a patch, and in its middle, where a vehicle would stand: below
it the label is ambiguous"""
_MIDDLE = 0.4
"""width of the middle relative to the patch"""
_MIN_PX = 48
_DRAWN = 192
"""number of squares that are tried in one image"""
_PER_VIEW, _PER_CLASS = 4, 2
"""largest number of patches of one image, and of one class among them"""
_MAX_VIEWS = 2
"""largest number of images for each wanted patch"""
_MADE, _GROWN, _WATER = (0.35, 0.28, 0.07), (0.15, 0.08, 0.03), (0.2, 0.1, 0.05)
"""standard deviations of the logarithms of brightness, red over blue, and green: of built or bare
ground, of vegetation, of water"""
_SPREAD = dict.fromkeys(LAND_CLASSES, _MADE) | dict.fromkeys(("lawn", "trees"), _GROWN)
_SPREAD |= {"water": _WATER}
_NOTHING = -1
_FULL = -1
"""marks a class of which no more patches are wanted, in place of their number"""


@dataclass(frozen=True, slots=True)
class Patch:
    """A labelled patch."""

    rgb: Image
    """(S, S, 3)"""
    land_class: str
    fraction: float
    """fraction of its pixels of ``land_class``"""
    height_m: float
    """height of the camera above the ground in the middle, along the optical axis"""
    side_m: float


@dataclass(frozen=True, slots=True)
class _Square:
    """A square of the class image of half resolution: first row and column, side, and class."""

    row: int
    col: int
    side: int
    land_class: int
    fraction: float
    depth_m: float


class NewLooks(NamedTuple):
    """Fractions of what looks other than in its scene."""

    colours: float = 0.0
    """of the views, in which each material has a random colour"""
    materials: float = 0.0
    """of the seeds, on which each material of the ground is a random one of its class"""


AS_BUILT = NewLooks()


def scene_patches(
    name: str, seed: int, count: int, pixels: int, variation: int, looks: NewLooks = AS_BUILT,
    settings: Sequence[str] = (),
) -> list[Patch]:  # fmt: skip
    """Returns up to ``count`` patches of ``pixels`` across of one seed of a scene; rare classes
    first.

    A pure function of its arguments; ``variation`` changes poses, squares and light, ``settings``
    (``KEY=VALUE``) the configuration. There are fewer patches where the scene does not show enough
    unambiguous ground. Raises UsageError for an unknown scene.
    """
    config = load_config(
        None, ("camera.noise_sigma=0", "camera.samples=4", *settings), profile_default="ideal",
        scene=name, seed=seed,
    )  # fmt: skip
    draws = np.random.default_rng([seed, variation, crc32(b"materials"), crc32(name.encode())])
    with varied_materials(draws) if draws.uniform() < looks.materials else contextlib.nullcontext():
        scene = build_scene(config)
    rng = np.random.default_rng([seed, variation, crc32(b"patches"), crc32(name.encode())])
    colours = np.random.default_rng([seed, variation, crc32(b"colours"), crc32(name.encode())])
    classes = geom_classes(scene)
    kinds = _kinds(scene, classes)
    camera = posed_sensors(config, scene)
    matrix = camera.intrinsics.matrix()
    found: list[Patch] = []
    taken = np.zeros(len(LAND_CLASSES), np.int64)
    try:
        for number in range(_MAX_VIEWS * count):
            view = random_view(camera, scene, rng, number, HEIGHTS_M)
            shown = class_image(view, scene, classes, matrix)
            if looks.colours > 0.0 and colours.uniform() < looks.colours:
                materials = material_image(scene, view.geom_id[::2, ::2], shown)
                view = replace(view, rgb=recoloured(view.rgb, materials, colours))
            # at first, a class that has its quota is not taken any more
            open_to = np.where(taken < _quota(count, number, kinds), taken, _FULL)
            squares = list(_squares(view, shown, matrix, open_to, rng))
            for square in _rarest(squares, open_to, min(_PER_VIEW, count - len(found))):
                taken[square.land_class] += 1
                found.append(_cut(view, square, matrix, pixels, rng))
            if len(found) == count:
                break
    finally:
        camera.close()
    return found


def _kinds(scene: Scene, classes: Int32) -> int:
    """Returns the number of land classes of a scene."""
    ground = classes if scene.ground is None else np.append(classes, scene.ground.class_id)
    return len(np.intersect1d(ground, np.arange(len(LAND_CLASSES))))


def _quota(count: int, view: int, kinds: int) -> int:
    """Returns the number of patches of one of ``kinds`` classes up to this image: a fifth, or the
    same of each where there are fewer; later any number."""
    return max(1, count // min(5, kinds)) if view < count else count


def class_image(view: PosedView, scene: Scene, classes: Int32, matrix: Array) -> Int32:
    """Returns the land class ids (H/2, W/2) of a view, `OTHER_CLASS_ID` for other objects, -1 for
    the background."""
    geom_id = view.geom_id[::2, ::2]
    image = np.where(geom_id >= 0, classes[geom_id], _NOTHING).astype(np.int32)
    if scene.ground is not None:
        write_ground_classes(image, view, scene, matrix)
    return image


def _squares(
    view: PosedView, image: Int32, matrix: Array, taken: Counts, rng: np.random.Generator
) -> Iterator[_Square]:
    """Yields those of random squares that show one class of ground."""
    rows, cols = image.shape
    sums = _integral(image)
    half_focal = 0.5 * float(matrix[0, 0])
    for row, col in _middles(image, taken, rng):
        side_m = float(np.exp(rng.uniform(*np.log(SIDES_M))))
        depth = float(view.depth_m[2 * row, 2 * col])
        if not np.isfinite(depth):
            continue
        side = round(side_m * half_focal / depth)
        top, left = row - side // 2, col - side // 2
        inside = top >= 0 and left >= 0 and top + side <= rows and left + side <= cols
        if not inside or side < _MIN_PX // 2 or _counts(sums, top, left, side)[_NOTHING] > 0:
            continue
        land_class, fraction = _majority(sums, top, left, side)
        middle = max(1, round(_MIDDLE * side))
        offset = (side - middle) // 2
        same, middle_fraction = _majority(sums, top + offset, left + offset, middle)
        clear = fraction >= MIN_FRACTION and middle_fraction >= MIN_MIDDLE_FRACTION
        if same == land_class and clear:
            yield _Square(top, left, side, land_class, fraction, depth)


def _middles(image: Int32, taken: Counts, rng: np.random.Generator) -> Iterator[tuple[int, int]]:
    """Yields random pixels, equally many of each class in the image that is still wanted."""
    flat = image.ravel()
    order = np.argsort(flat, kind="stable")
    starts = np.searchsorted(flat[order], np.arange(len(LAND_CLASSES) + 1))
    shown = [c for c in np.flatnonzero(np.diff(starts)) if taken[c] >= 0]
    for number in range(_DRAWN if shown else 0):
        first, beyond = starts[shown[number % len(shown)]], starts[shown[number % len(shown)] + 1]
        row, col = divmod(int(order[rng.integers(first, beyond)]), image.shape[1])
        yield row, col


def _integral(image: Int32) -> NDArray[np.int32]:
    """Returns integral images (classes + 1, H + 1, W + 1) of each class; the last counts background
    pixels, beyond the border of the scene."""
    rows, cols = image.shape
    sums = np.zeros((len(LAND_CLASSES) + 1, rows + 1, cols + 1), np.int32)
    for number in (*range(len(LAND_CLASSES)), _NOTHING):
        sums[number] = cv2.integral((image == number).astype(np.uint8))
    return sums


def _counts(sums: NDArray[np.int32], top: int, left: int, side: int) -> NDArray[np.int32]:
    """Returns the number of pixels (classes + 1,) of each class in a square."""
    below, right = top + side, left + side
    return sums[:, below, right] - sums[:, top, right] - sums[:, below, left] + sums[:, top, left]


def _majority(sums: NDArray[np.int32], top: int, left: int, side: int) -> tuple[int, float]:
    """Returns the most frequent land class of a square and its fraction of the pixels."""
    counts = _counts(sums, top, left, side)[:_NOTHING]
    best = int(counts.argmax())
    return best, float(counts[best]) / side**2


def _rarest(squares: list[_Square], taken: Counts, maximum: int) -> list[_Square]:
    """Returns up to ``maximum`` squares that overlap little, of the rarest classes so far."""
    counts = taken.copy()
    of_view = np.zeros_like(counts)
    chosen: list[_Square] = []
    while len(chosen) < maximum:
        left = [
            s for s in squares
            if taken[s.land_class] >= 0
            and of_view[s.land_class] < _PER_CLASS
            and all(_separate(s, c) for c in chosen)
        ]  # fmt: skip
        if not left:
            break
        best = min(left, key=lambda s: int(counts[s.land_class]))
        counts[best.land_class] += 1
        of_view[best.land_class] += 1
        chosen.append(best)
    return chosen


def _separate(a: _Square, b: _Square) -> bool:
    down = a.row + a.side / 2 - b.row - b.side / 2
    across = a.col + a.side / 2 - b.col - b.side / 2
    return max(abs(down), abs(across)) >= max(a.side, b.side) / 2


def _cut(
    view: PosedView, square: _Square, matrix: Array, pixels: int, rng: np.random.Generator
) -> Patch:
    top, left, side = 2 * square.row, 2 * square.col, 2 * square.side
    crop = varied(view.rgb[top : top + side, left : left + side], rng)
    way = cv2.INTER_AREA if side >= pixels else cv2.INTER_LINEAR
    return Patch(
        rgb=np.asarray(cv2.resize(crop, (pixels, pixels), interpolation=way), np.uint8),
        land_class=LAND_CLASSES[square.land_class],
        fraction=square.fraction,
        height_m=square.depth_m,
        side_m=side * square.depth_m / float(matrix[0, 0]),
    )


def varied(rgb: Image, rng: np.random.Generator) -> Image:
    """Returns an image (H, W, 3) with random exposure, white balance, haze, motion blur, focus blur
    and noise. Apart from the noise, the number of draws is the same for every image."""
    exposure, warmth = 2.0 ** rng.uniform(-0.9, 0.6), rng.normal(0.0, 0.06)
    tint, haze = rng.normal(0.0, 0.03), max(0.0, rng.uniform(-0.3, 0.15))
    motion_px, direction = max(0.0, rng.uniform(-6.0, 5.0)), rng.uniform(0.0, np.pi)
    focus_px, noise = rng.uniform(0.0, 1.1), float(np.exp(rng.uniform(np.log(0.5), np.log(6.0))))
    gains = exposure * np.array([1.0 + warmth, 1.0 + tint, 1.0 - warmth])
    linear = (rgb.astype(np.float32) / 255.0) ** 2.2 * gains.astype(np.float32)
    light = 255.0 * np.minimum(linear, 1.0) ** (1.0 / 2.2)
    light = (1.0 - haze) * light + haze * 200.0
    if motion_px > 1.0:
        light = cv2.filter2D(light, -1, _streak(motion_px, direction))
    if focus_px > 0.3:
        light = cv2.GaussianBlur(light, (0, 0), focus_px)
    grain = rng.normal(0.0, noise, light.shape)
    return np.asarray(np.clip(np.round(light + grain), 0.0, 255.0), np.uint8)


def _streak(length_px: float, direction: float) -> NDArray[np.float32]:
    """Returns a kernel of motion blur that sums to 1: a line of ``length_px`` through its
    middle."""
    reach = int(np.ceil(length_px / 2))
    down, across = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    along = across * np.cos(direction) + down * np.sin(direction)
    beside = -across * np.sin(direction) + down * np.cos(direction)
    kernel = np.clip(1.0 - np.abs(beside), 0.0, 1.0) * (np.abs(along) <= length_px / 2)
    return np.asarray(kernel / kernel.sum(), np.float32)


def material_image(scene: Scene, geom_id: Int32, classes: Int32) -> Int32:
    """Returns (H, W) numbers of material and class of each pixel: the material times the number of
    classes plus the class. The class separates the kinds of ground of a single ground geom.

    ``geom_id`` (H, W), -1 for the background; ``classes`` (H, W) land class ids.
    """
    material = np.append(scene.model.geom_matid, -1)[geom_id] + 1
    known = np.clip(classes, -1, OTHER_CLASS_ID) + 1
    return np.asarray(material * (OTHER_CLASS_ID + 2) + known, np.int32)


def recoloured(rgb: Image, materials: Int32, rng: np.random.Generator) -> Image:
    """Returns an image (H, W, 3) with another colour for each of the ``materials`` (H/2, W/2),
    changed in linear light."""
    kinds, where = np.unique(materials, return_inverse=True)
    gains = np.stack([_gain(int(kind) % (OTHER_CLASS_ID + 2) - 1, rng) for kind in kinds])
    by_pixel = gains[where.reshape(materials.shape)]
    full = by_pixel.repeat(2, axis=0).repeat(2, axis=1)[: rgb.shape[0], : rgb.shape[1]]
    linear = (rgb.astype(np.float32) / 255.0) ** 2.2 * full
    return np.asarray(np.round(255.0 * np.minimum(linear, 1.0) ** (1.0 / 2.2)), np.uint8)


def _gain(land_class: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Returns the gains (3,) of linear red, green and blue."""
    name = LAND_CLASSES[land_class] if 0 <= land_class < len(LAND_CLASSES) else "building"
    light, warm, green = rng.normal(0.0, _SPREAD[name])
    if _SPREAD[name] == _MADE:
        warm = abs(warm)  # blue ground is rare, and blue water common
    return np.exp(np.array([light + warm, light + green, light - warm])).astype(np.float32)
