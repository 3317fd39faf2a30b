"""Images of scenes from survey heights with their true boundaries.

A boundary separates different things in a person's eyes: the classes painted into the ground,
objects by their geom, crowns and bushes as one kind, and jumps of depth.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any
from zlib import crc32

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from touchdown.experiments.config.loading import load_config
from touchdown.experiments.config.schema import Config
from touchdown.experiments.flight.wiring import build_scene
from touchdown.experiments.scene_tools.posed_views import (
    posed_sensors,
    random_view,
    write_ground_classes,
)
from touchdown.scenes.api import LAND_CLASSES, Scene
from touchdown.sim.frames import Pose
from touchdown.sim.posed_sensors import PosedView
from touchdown.sim.typing import Array, Int32, Mask

Notes = Callable[[str], None]

_STEP_M = 0.4
"""Jump of depth between neighbouring pixels that separates two things of one kind"""
_CROWN_STEP_M = 2.0
"""Jump of depth that separates two things within vegetation"""
_STEEPEST = 8.0
"""Change of depth, in pixel widths, that is still one surface seen obliquely, walls included"""
_SMALLEST_PX = 12
"""Segments of fewer half-size pixels are merged into their surroundings"""


@dataclass(frozen=True, slots=True)
class EdgeView:
    """One image at half size, which is the size at which the estimator looks for edges."""

    rgb: NDArray[np.uint8]
    """(H, W, 3)"""
    boundaries: Mask
    """(H, W) pixels whose right or lower neighbour belongs to another segment"""
    world_from_body: Pose
    time_s: float


def edge_views(
    scenes: Sequence[str], seeds: Sequence[int], views: int, notes: Notes
) -> Iterator[EdgeView]:
    """``views`` images of every scene and seed, with all noise; a pure function of the arguments.

    Camera poses: anywhere over the scene, 8 to 40 m above the take-off spot (uniform in the
    logarithm), any heading, tilted as by wind. Raises UsageError for bad names.
    """
    for name in scenes:
        for seed in seeds:
            config = load_config(scene=name, seed=seed, profile_default="ideal")
            notes(f"{name}, seed {seed}")
            yield from _scene_views(config, build_scene(config), views)


def _scene_views(config: Config, scene: Scene, views: int) -> Iterator[EdgeView]:
    rng = np.random.default_rng([config.seed, crc32(b"edge views"), crc32(scene.name.encode())])
    sensors = posed_sensors(config, scene)
    kinds = _surface_kinds(scene)
    try:
        for number in range(views):
            view = random_view(sensors, scene, rng, number)
            half = cv2.resize(view.rgb, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
            segments = _segments_of(view, scene, kinds, sensors.intrinsics.matrix())
            yield EdgeView(
                np.asarray(half, np.uint8), boundaries(segments), view.world_from_body, view.time_s
            )  # fmt: skip
    finally:
        sensors.close()


def _surface_kinds(scene: Scene) -> Int32:
    """(G,) a number for every geom: vegetation is one kind, every other geom one of its own."""
    model = scene.model
    kinds = np.arange(model.ngeom, dtype=np.int32) + len(LAND_CLASSES)
    for geom in range(model.ngeom):
        surface = scene.surfaces.get(model.geom(geom).name)
        if surface is not None and surface.land_class == "trees":
            kinds[geom] = LAND_CLASSES.index("trees")
    return kinds


def _segments_of(view: PosedView, scene: Scene, kinds: Int32, matrix: Array) -> Int32:
    """(H/2, W/2) int32 segments of a view: connected pixels, every other one in both directions, of
    one kind without a jump of depth."""
    geom_id, depth = view.geom_id[::2, ::2], view.depth_m[::2, ::2]
    kind = np.where(geom_id >= 0, kinds[geom_id], -1).astype(np.int32)
    if scene.ground is not None:
        write_ground_classes(kind, view, scene, matrix)
    finite = np.minimum(depth, np.float32(1e4))
    step = np.maximum(_STEP_M, _STEEPEST * finite / (0.5 * float(matrix[0, 0])))
    crown = kind == LAND_CLASSES.index("trees")
    minimum = np.where(crown, np.maximum(step, _CROWN_STEP_M), step)
    jumps = _jumps_right(finite, minimum), _jumps_right(finite.T, minimum.T).T
    return without_specks(connected(kind, *jumps), _SMALLEST_PX)


def _jumps_right(depth: NDArray[Any], minimum: NDArray[Any]) -> Mask:
    """True where depth jumps to the right neighbour (H, W - 1)."""
    return np.abs(np.diff(depth, axis=1)) > np.minimum(minimum[:, 1:], minimum[:, :-1])


def connected(kind: Int32, jump_right: Mask, jump_down: Mask) -> Int32:
    """(H, W) numbers, from 0, of the sets of 4-connected pixels of one kind between which there is
    no jump to the right (H, W - 1) or down (H - 1, W)."""
    height, width = kind.shape
    # a grid twice as fine, in which the link between two pixels is a pixel that may be missing
    fine = np.zeros((2 * height - 1, 2 * width - 1), np.uint8)
    fine[::2, ::2] = 1
    fine[::2, 1::2] = (kind[:, 1:] == kind[:, :-1]) & ~jump_right
    fine[1::2, ::2] = (kind[1:] == kind[:-1]) & ~jump_down
    labels = cv2.connectedComponents(fine, connectivity=4, ltype=cv2.CV_32S)[1]
    return np.ascontiguousarray(labels[::2, ::2] - 1, dtype=np.int32)


def without_specks(segments: Int32, smallest: int) -> Int32:
    """Pixels of segments smaller than ``smallest`` pixels take the nearest larger segment."""
    large = np.bincount(segments.ravel()) >= smallest
    if not large.any():
        return segments
    nearest = ndimage.distance_transform_edt(
        ~large[segments], return_distances=False, return_indices=True
    )
    return np.ascontiguousarray(segments[nearest[0], nearest[1]], dtype=np.int32)


def boundaries(segments: Int32) -> Mask:
    """(H, W) pixels of segments (H, W) whose right or lower neighbour belongs to another one."""
    edge = np.zeros(segments.shape, bool)
    edge[:, :-1] |= segments[:, :-1] != segments[:, 1:]
    edge[:-1] |= segments[:-1] != segments[1:]
    return edge
