"""The style of all drawings: colours and matplotlib's settings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

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


def new_figure(width: float, height: float, dpi: float = 110.0) -> Figure:
    """A figure, in inches, to be filled within ``matplotlib.rc_context(STYLE)``."""
    return Figure(figsize=(width, height), dpi=dpi, layout="constrained")


def pixels_of(figure: Figure) -> NDArray[np.uint8]:
    """(H, W, 3) RGB."""
    canvas = FigureCanvasAgg(figure)
    with matplotlib.rc_context(STYLE):
        canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def write_figure(path: Path, figure: Figure) -> None:
    """Writes a figure in the format of the file's ending."""
    with matplotlib.rc_context(STYLE):
        figure.savefig(path)
