"""Fig. 12: touchdowns of each method around the designated spot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from numpy.typing import NDArray

from touchdown.experiments.reporting.figures import FAINT, GRID, INK, Picture, colour_of, draw
from touchdown.experiments.reporting.flights import Row, cell, methods_of
from touchdown.experiments.reporting.landings import landed_of, landings_of, offset_xy

Array = NDArray[np.float64]

_RINGS_M = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
_MARKERS = ("o", "s", "^", "D", "v", "P", "X")
_ZOOM_FROM = 4.0
"""a second panel shows the nearest method, if possible the nearest two, where the farthest is this
many times as far"""


def landing_pictures(rows: Sequence[Row]) -> list[Picture]:
    """Returns Fig. 12; nothing without a landing."""
    landings = landings_of(rows)
    offsets: dict[str, Array] = {}
    for method in methods_of(landings):
        found = [offset_xy(row) for row in landed_of(cell(landings, None, method))]
        if known := [xy for xy in found if xy is not None]:
            offsets[method] = np.array(known)
    if not offsets:
        return []
    commanded = all(row.get("landing.commanded_xy_m") for row in landed_of(landings))
    spot = "the commanded spot" if commanded else "the site that was committed at 4 m"
    reaches = sorted(_reach(points) for points in offsets.values())
    wide = reaches[-1]
    small = [reach for reach in reaches[:2] if wide > _ZOOM_FROM * reach]
    spans = [1.15 * wide, *(1.15 * reach for reach in small[-1:])]

    def paint(figure: Figure) -> None:
        if isinstance(engine := figure.get_layout_engine(), ConstrainedLayoutEngine):
            engine.set(h_pad=0.08, w_pad=0.08)
        panels = figure.subplots(1, len(spans), squeeze=False)[0]
        for axes, span in zip(panels, spans, strict=True):
            _paint_panel(axes, offsets, span)
        panels[-1].set_title("all" if len(spans) == 1 else "the nearest, enlarged")
        panels[0].set_title("all")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(
            handles, labels, loc="outside upper center", ncols=min(6, len(labels)), fontsize=8
        )

    counts = ", ".join(f"{len(points)} with `{method}`" for method, points in offsets.items())
    caption = (
        f"First contact with the ground relative to {spot} (cross), metres east and north: "
        f"{counts}. Large open marks are the means of the methods."
    )
    title = "Fig. 12: touchdowns around " + spot
    return [draw("fig12", title, caption, (5.0 * len(spans), 5.2), paint)]


def _reach(points: Array) -> float:
    """Distance of the farthest point, at least a centimetre."""
    return max(float(np.hypot(*points.T).max()), 0.01)


def _paint_panel(axes: Axes, offsets: Mapping[str, Array], span_m: float) -> None:
    methods = list(offsets)
    for radius in _RINGS_M:
        if 0.15 * span_m < radius < span_m:
            turn = np.linspace(0.0, 2.0 * np.pi, 181)
            axes.plot(
                radius * np.cos(turn), radius * np.sin(turn), color=FAINT, linewidth=0.7,
                linestyle=(0, (4, 3)), zorder=1,
            )  # fmt: skip
            axes.annotate(
                f"{radius:g} m", (0.0, -radius), xytext=(0, 2), textcoords="offset points",
                ha="center", va="bottom", fontsize=7, color=FAINT,
            )  # fmt: skip
    for index, (method, points) in enumerate(offsets.items()):
        colour, marker = colour_of(method, methods), _MARKERS[index % len(_MARKERS)]
        x, y = points.T
        axes.scatter(
            x, y, s=24, alpha=0.8, linewidths=0, color=colour, marker=marker, label=method, zorder=3
        )
        if len(points) > 1:
            axes.scatter(
                x.mean(), y.mean(), s=130, facecolors="none", edgecolors=colour, linewidths=1.8,
                marker=marker, zorder=4,
            )  # fmt: skip
    axes.plot(0.0, 0.0, marker="+", markersize=16, markeredgewidth=1.4, color=INK, zorder=2)
    axes.set_xlim(-span_m, span_m)
    axes.set_ylim(-span_m, span_m)
    axes.set_aspect("equal")
    axes.locator_params(nbins=6)
    axes.grid(color=GRID)
    axes.set_xlabel("x, east (m)")
    axes.set_ylabel("y, north (m)")
