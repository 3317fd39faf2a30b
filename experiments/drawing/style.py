"""The style of all drawings, and maps with ticks in metres, north up, with take-off point, heading
and survey area."""

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from touchdown.experiments.drawing.map_images import Marks

Image = NDArray[np.uint8]
"""(H, W, 3) RGB"""
_DPI = 110.0
INK, FAINT, GRID, PAPER = "#1b1f27", "#6a7280", "#d9dde3", "#fefefe"
STYLE: Any = {
    "text.parse_math": False,  # a name may hold dollar signs
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.titlesize": 10,
    "text.color": INK,
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "figure.facecolor": PAPER,
    "axes.facecolor": PAPER,
    "legend.frameon": False,
}


def new_figure(width: float, height: float) -> Figure:
    """A figure, in inches, to be filled within ``matplotlib.rc_context(STYLE)``."""
    return Figure(figsize=(width, height), dpi=_DPI, layout="constrained")


def pixels_of(figure: Figure) -> Image:
    canvas = FigureCanvasAgg(figure)
    with matplotlib.rc_context(STYLE):
        canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def write_figure(path: Path, figure: Figure) -> None:
    """Writes a figure in the format of the file's ending."""
    with matplotlib.rc_context(STYLE):
        figure.savefig(path)


Extent = tuple[float, float, float, float]
"""west, east, south and north edge of a map, m"""

RIM = [withStroke(linewidth=3.5, foreground="#101218")]
"""A dark rim, so that marks are seen on any ground."""


def draw_marks(axes: Axes, marks: Marks) -> None:
    """Draws the survey dashed, and take-off point and heading as a circle with a hand;
    the limits of the axes stay."""
    axes.autoscale(False)
    axes.plot(
        *marks.path_xy_m.T, color="white", linewidth=1.2, linestyle=(0, (6, 4)), path_effects=RIM
    )
    axes.plot(*marks.takeoff_xy_m, marker="o", markersize=9, markerfacecolor="none",
              markeredgecolor="white", markeredgewidth=1.4, path_effects=RIM)  # fmt: skip
    hand = {"arrowstyle": "-", "color": "white", "path_effects": RIM}
    end = 14.0 * np.array([np.cos(marks.yaw), np.sin(marks.yaw)])
    axes.annotate("", tuple(marks.takeoff_xy_m), tuple(end), "data", "offset points", hand)


def framed_map(image: Image, extent: Extent, marks: Marks, words: str) -> Image:
    """Returns a map (H, W, 3), north up, about pixel by pixel, with ticks in metres, ``marks`` and
    ``words`` below."""
    height, width = image.shape[:2]
    with matplotlib.rc_context(STYLE):
        figure = new_figure(width / _DPI + 0.7, height / _DPI + 0.7)
        axes = figure.add_subplot(xlabel=words)
        axes.imshow(image, extent=extent, interpolation="nearest")
        draw_marks(axes, marks)
        return pixels_of(figure)
