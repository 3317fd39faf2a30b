"""The picture of a flight's semantic map: the map in the colours of its classes."""

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.patches import Patch
from numpy.typing import NDArray

from touchdown.experiments.drawing.costmap_image import extent_of, photo_of, seen_box
from touchdown.experiments.drawing.map_images import Marks
from touchdown.experiments.drawing.style import STYLE, draw_marks, new_figure, write_figure
from touchdown.landing.api import CostmapView
from touchdown.scenes.api import LAND_CLASSES
from touchdown.sim.frames import Pose

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
_OPACITY = 0.5
"""of the class colours"""
_MIN_PROBABILITY = 0.5
"""probability below which a class is unsure"""
_UNSURE, _UNSEEN = len(LAND_CLASSES), len(LAND_CLASSES) + 1
_CAPTION = "x east, y north (m, world); class of the ground by all views of the flight"


def write_classes(path: Path, costmap: CostmapView, world_from_odom: Pose, marks: Marks) -> None:
    """Writes the map of ``costmap`` in the colours of its semantic map, with ticks in metres of the
    world frame, take-off, the survey's rectangle and the fraction of each class. Raises ValueError
    without a semantic map."""
    numbers, (extent, _) = class_numbers(costmap), extent_of(costmap, world_from_odom)
    palette = np.array([*(CLASS_RGB[name] for name in LAND_CLASSES), UNSURE_RGB, (0, 0, 0)]) / 255.0
    alpha = np.where(numbers == _UNSEEN, 0.0, _OPACITY)
    counts = np.bincount(numbers.ravel(), minlength=_UNSEEN + 1)[:_UNSEEN]
    fractions = zip((*LAND_CLASSES, "unsure"), counts / max(1, counts.sum()), palette, strict=False)
    key = [Patch(facecolor=rgb, edgecolor="black", label=f"{name} {fraction:.0%}")
           for name, fraction, rgb in fractions if fraction >= 0.002]  # fmt: skip
    with matplotlib.rc_context(STYLE):
        figure = new_figure(8.0, 8.0 * (extent[3] - extent[2]) / (extent[1] - extent[0]) + 0.8)
        axes = figure.add_subplot(xlabel=_CAPTION)
        for layer in (photo_of(costmap), np.dstack([palette[numbers], alpha])):
            axes.imshow(layer, origin="lower", extent=extent, interpolation="nearest")
        draw_marks(axes, marks)
        figure.legend(handles=key, loc="outside upper center", ncols=max(1, len(key)))
    write_figure(path, figure)


def class_numbers(costmap: CostmapView) -> Numbers:
    """Returns the most probable class (H, W) of the seen part of the map, south first, in the order
    of `LAND_CLASSES`; one more where none is as probable as one half, two more where the ground is
    in no view. Raises ValueError without a semantic map."""
    if costmap.semantics is None:
        raise ValueError("nothing was classified: there is no semantic map to draw")
    seen, (rows, cols) = costmap.semantics, seen_box(costmap)
    best = np.where(
        seen.probabilities.max(axis=2) < _MIN_PROBABILITY,
        _UNSURE,
        seen.probabilities.argmax(axis=2),
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
