"""The picture of a flight's semantic map: the map in the colours of its classes."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.drawing.costmap_image import enlarged, frame_of, photo_of, seen_box
from touchdown.experiments.drawing.map_axes import PAPER, MapFrame, Marks
from touchdown.landing.api import CostmapView
from touchdown.scenes.api import LAND_CLASSES
from touchdown.sim.frames import Pose

Colours = NDArray[np.uint8]
Numbers = NDArray[np.int64]

CLASS_RGB = {
    "lawn": (120, 200, 80),
    "field": (230, 200, 90),
    "path": (235, 160, 200),
    "road": (110, 110, 125),
    "building": (205, 80, 60),
    "water": (50, 110, 225),
    "trees": (20, 100, 50),
}
UNSURE_RGB = (255, 255, 255)
_COVER = 0.5
"""opacity of the class colours"""
_LEAST = 0.5
"""probability below which a class is unsure"""
_UNSURE, _UNSEEN = len(LAND_CLASSES), len(LAND_CLASSES) + 1
_CAPTION = "x east, y north (m, world); class of the ground by all views of the flight"


def write_classes(path: Path, costmap: CostmapView, world_from_odom: Pose, marks: Marks) -> None:
    """Writes the map of ``costmap`` in the colours of its semantic map, with ticks in metres of the
    world frame, take-off, the survey's rectangle and the share of each class. Raises ValueError
    without a semantic map."""
    numbers = class_numbers(costmap)
    frame = frame_of(costmap, world_from_odom)
    panel = enlarged(_covered(photo_of(costmap), numbers), costmap)
    frame.draw_marks(panel, marks)
    image = frame.around((panel,), _CAPTION)
    image = frame.below(image, _key(frame, numbers, panel.shape[1]))
    if not cv2.imwrite(str(path), cv2.cvtColor(image, cv2.COLOR_RGB2BGR)):
        raise OSError(f"{path} cannot be written")


def class_numbers(costmap: CostmapView) -> Numbers:
    """Returns the most probable class (H, W) of the seen part of the map, south first, in the order
    of `LAND_CLASSES`; one more where none is as probable as one half, two more where the ground is
    in no view. Raises ValueError without a semantic map."""
    if costmap.semantics is None:
        raise ValueError("nothing was classified: there is no semantic map to draw")
    seen, (rows, cols) = costmap.semantics, seen_box(costmap)
    best = np.where(
        seen.probabilities.max(axis=2) < _LEAST, _UNSURE, seen.probabilities.argmax(axis=2)
    )
    best = np.where(seen.weight > 0.0, best, _UNSEEN)
    at = []
    for axis, span in ((1, rows), (0, cols)):
        middle = costmap.origin_xy_m[axis] + costmap.cell_m * (
            np.arange(span.start, span.stop) + 0.5
        )
        node = np.rint((middle - seen.origin_xy_m[axis]) / seen.spacing_m).astype(int)
        at.append(node)
    row, col = np.meshgrid(*at, indexing="ij")
    inside = (row >= 0) & (row < best.shape[0]) & (col >= 0) & (col < best.shape[1])
    numbers = np.full(row.shape, _UNSEEN)
    numbers[inside] = best[row[inside], col[inside]]
    numbers[~np.isfinite(costmap.total[rows, cols])] = _UNSEEN
    return numbers


def _covered(photo: Colours, numbers: Numbers) -> Colours:
    palette = np.array([*(CLASS_RGB[name] for name in LAND_CLASSES), UNSURE_RGB], np.float32)
    shown = numbers != _UNSEEN
    mixed = photo.copy()
    mixed[shown] = np.round((1.0 - _COVER) * photo[shown] + _COVER * palette[numbers[shown]])
    return mixed


def _key(frame: MapFrame, numbers: Numbers, width: int) -> Colours:
    """The colours of the classes, and the share of the classified ground of each."""
    scale = frame.scale
    top, bottom, base = round(6 * scale), round(24 * scale), round(20 * scale)
    strip = np.full((round(34 * scale), width, 3), PAPER, np.uint8)
    counts = np.bincount(numbers.ravel(), minlength=_UNSEEN + 1)[:_UNSEEN]
    at = 0
    for name, count in zip((*LAND_CLASSES, "unsure"), counts / max(1, counts.sum()), strict=True):
        if count < 0.002:
            continue
        strip[top:bottom, at : at + bottom - top] = CLASS_RGB.get(name, UNSURE_RGB)
        at = frame.write(strip, f"{name} {count:.0%}", at + bottom - top + round(6 * scale), base)
        at += round(16 * scale)
    return strip
