"""Drawing of the touchdown bench: probabilities by size, and maps of size and condition."""

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes

from touchdown.experiments.drawing.style import (
    FAINT,
    GRID,
    INK,
    PAPER,
    STYLE,
    new_figure,
    write_figure,
)

_DIALS = {
    "friction": "friction of the feet",
    "speed_mps": "speed over ground (m/s)",
    "wind_kmh": "wind (km/h)",
}
_COLOURS = {"tips": "tab:red", "strikes": "tab:orange", "slides": "tab:blue"}


def draw(figures: dict[str, Any], file: Path) -> None:
    """Writes the figure in the format of the file's ending. A row for each ground: the probability
    to fail by size, and by size and each condition."""
    grounds = list(dict.fromkeys(row["ground"] for row in figures["levels"]))
    with matplotlib.rc_context(STYLE):
        figure = new_figure(11.0, 2.6 * len(grounds) + 0.5)
        panels = figure.subplots(len(grounds), 1 + len(_DIALS), squeeze=False)
        for line, ground in zip(panels, grounds, strict=True):
            _draw_levels(line[0], figures, ground)
            maps = [one for one in figures["maps"] if one["ground"] == ground]
            for axes, one in zip(line[1:], maps, strict=True):
                _draw_map(axes, one, _unit(ground))
        handles, labels = panels[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), fontsize=8)
        write_figure(file, figure)


def _unit(ground: str) -> str:
    return "slope (°)" if ground == "slope" else "height (m)"


def _draw_levels(axes: Axes, figures: dict[str, Any], ground: str) -> None:
    rows = [row for row in figures["levels"] if row["ground"] == ground]
    sizes = [row["size"] for row in rows]
    parts = np.array([[row[name] / row["contacts"] for name in _COLOURS] for row in rows])
    axes.stackplot(sizes, parts.T, labels=list(_COLOURS), colors=list(_COLOURS.values()), alpha=0.4)
    low, value, high = (np.array([row[k] for row in rows]) for k in ("low", "probability", "high"))
    whiskers = np.maximum([value - low, high - value], 0.0)
    axes.errorbar(sizes, value, whiskers, color=INK, capsize=2.0, linewidth=1.0, marker="o",
                  markersize=3, label="fails, 95 % interval")  # fmt: skip
    axes.axhline(figures["bound"], color=FAINT, linewidth=0.8, linestyle=(0, (4, 3)), label="bound")
    key = "max_slope_deg" if ground == "slope" else "max_step_m"
    axes.axvline(
        figures["present"][key], color="tab:green", linewidth=1.2, label="the rule's limit"
    )
    axes.set(title=ground, xlabel=_unit(ground), ylabel="probability", ylim=(0.0, 1.0))
    axes.set_xlim(0.0, max(sizes))
    axes.grid(color=GRID, linewidth=0.6)


def _draw_map(axes: Axes, one: dict[str, Any], unit: str) -> None:
    cells = one["cells"]
    values = np.array([[np.nan if c is None else c["probability"] for c in row] for row in cells])
    axes.imshow(values, origin="lower", aspect="auto", vmin=0.0, vmax=1.0, cmap="RdYlGn_r")
    for y, row in enumerate(cells):
        for x, cell in enumerate(row):
            if cell is not None:
                words = f"{100 * cell['low']:.0f} – {100 * cell['high']:.0f} %"
                colour = PAPER if abs(cell["probability"] - 0.5) > 0.35 else INK
                axes.text(x, y, words, ha="center", va="center", fontsize=6, color=colour)
    edges = one["edges"]
    axes.set_xticks(np.arange(len(edges)) - 0.5, [f"{edge:.2g}" for edge in edges])
    axes.set_yticks(range(len(one["sizes"])), [f"{size:g}" for size in one["sizes"]])
    axes.set(xlabel=_DIALS[one["dial"]], ylabel=unit)
    axes.set_title("fails, 95 % interval", fontsize=8, color=FAINT)
