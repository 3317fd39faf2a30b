"""Figures of a report as SVG text whose colours follow the page, light or dark."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import LogLocator, NullLocator
from numpy.typing import NDArray

from touchdown.experiments.errors import visible
from touchdown.experiments.reporting.flights import (
    Row,
    Trajectory,
    airborne,
    cell,
    methods_of,
    read_trajectory,
    scenes_of,
    values,
)
from touchdown.experiments.reporting.measures import (
    SET_MARK,
    estimates,
    is_marked,
    mean_of,
    setting_notes,
)
from touchdown.experiments.reporting.published import ANALYSED_SCENE
from touchdown.experiments.reporting.queries import CellKey
from touchdown.experiments.reporting.statistics import Estimate
from touchdown.experiments.reporting.tables import AXES

INK, FAINT, GRID, PAPER = "#1b1f27", "#6a7280", "#d9dde3", "#fefefe"
"""Colours of the drawings; `Picture.on_page` replaces them by those of the page."""
PAGE_COLOURS = {INK: "var(--ink)", FAINT: "var(--faint)", GRID: "var(--line)", PAPER: "none"}
METHOD_COLOURS = {
    "livo": "#2f7fd6",
    "zou2024": "#e0752d",
    "stereo": "#b8912a",
    "hybrid_flow": "#2b9c74",
    "gps": "#8b6fd6",
    "optical_flow": "#d64f68",
    "oracle": "#7d8794",
}
SPARE_COLOURS = ("#159bb3", "#a3576b", "#6f9a2d", "#b05fc0")
PATH_POINTS = 300
_STYLE: Any = {
    "svg.fonttype": "none",
    "text.parse_math": False,  # a name may hold dollar signs
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "text.color": INK,
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "figure.facecolor": PAPER,
    "axes.facecolor": PAPER,
    "legend.frameon": False,
}


@dataclass(frozen=True, slots=True)
class Picture:
    """``svg`` in the fixed colours; ``name`` is its file name without the ending."""

    name: str
    title: str
    caption: str
    svg: str

    @property
    def on_page(self) -> str:
        """The SVG element alone, in the colours of the page around it."""
        text = self.svg[self.svg.index("<svg") :]
        for fixed, variable in PAGE_COLOURS.items():
            text = text.replace(fixed, variable)
        text = re.sub(
            r"font: ([^;\"]*?)'DejaVu Sans', sans-serif", r"font: \1system-ui, sans-serif", text
        )
        head, rest = text.split(">", 1)
        width = re.search(r'width="([\d.]+)pt"', head)
        head = re.sub(r' (width|height)="[^"]*"', "", head)
        # Small figures keep their size, wide ones shrink to the page.
        widest = f"{4.0 / 3.0 * float(width[1]):.0f}px" if width else "100%"
        return f'{head} style="max-width: {widest}">{rest}'


def colour_of(method: str, methods: Sequence[str]) -> str:
    if method in METHOD_COLOURS:
        return METHOD_COLOURS[method]
    others = [name for name in methods if name not in METHOD_COLOURS]
    return SPARE_COLOURS[others.index(method) % len(SPARE_COLOURS)]


def draw(
    name: str, title: str, caption: str, size: tuple[float, float], paint: Callable[[Figure], None]
) -> Picture:
    """``paint`` fills a figure of ``size`` inches. The same data give the same text."""
    style: Any = {**_STYLE, "svg.hashsalt": name}
    with matplotlib.rc_context(style):
        figure = Figure(figsize=size, layout="constrained")
        paint(figure)
        for words in figure.findobj(Text):
            words.set_text(visible(words.get_text(), keep="\n"))
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    return Picture(name, title, caption, text.getvalue())


# ------------------------------------------------------------------------------------------- paths


@dataclass(frozen=True, slots=True)
class _Paths:
    truth: Trajectory
    estimate: Trajectory | None
    reference: Trajectory | None


def _paths(row: Row) -> _Paths | None:
    run_dir = Path(row["run_dir"])
    truth = read_trajectory(run_dir / "truth.tum")
    if truth is None or airborne(truth) == len(truth.time_s):
        return None
    others = (read_trajectory(run_dir / f"{name}.tum") for name in ("estimate", "reference"))
    return _Paths(truth, *others)


def _shown(path: Trajectory, start: int = 0) -> NDArray[np.float64]:
    """(<= PATH_POINTS, 3) positions from a sample on, thinned."""
    position = path.position[start:]
    return position[:: max(1, len(position) // PATH_POINTS)]


def first_flight(rows: Sequence[Row], scene: str, method: str, mode: str) -> _Paths | None:
    """The flight with the lowest seed that has trajectories and left the ground."""
    own = [row for row in cell(rows, scene, method) if row["mode"] == mode]
    for row in sorted(own, key=lambda row: row["seed"]):
        if (paths := _paths(row)) is not None:
            return paths
    return None


def survey_and_landing(rows: Sequence[Row]) -> list[Picture]:
    """Fig. 9: trajectories of surveys and of landings."""
    pictures = []
    for mode, name, title in (
        ("fly", "fig9a", "Fig. 9 a: survey trajectories"),
        ("land", "fig9b", "Fig. 9 b: landing trajectories"),
    ):
        own = [row for row in rows if row["mode"] == mode]
        method = _shown_method(own)
        flown = [(s, p) for s in scenes_of(own) if (p := first_flight(own, s, method, mode))]
        if not flown:
            continue
        caption = (
            f"Flown path (blue, from green to red) and reference (dashed) with `{method}`, lowest "
            "seed of each scene; the shadow is the plan view. World frame, metres."
        )
        width = 3.3 * min(len(flown), 4)
        rows_needed = -(-len(flown) // 4)

        def paint(figure: Figure, flown: list[tuple[str, _Paths]] = flown) -> None:
            for index, (scene, paths) in enumerate(flown, start=1):
                axes = figure.add_subplot(
                    -(-len(flown) // 4), min(len(flown), 4), index, projection="3d"
                )
                _paint_path(axes, paths)
                axes.set_title(scene)

        pictures.append(draw(name, title, caption, (max(width, 4.2), 3.5 * rows_needed), paint))
    return pictures


def _shown_method(rows: Sequence[Row]) -> str:
    """The paper's method, which its Fig. 9 shows, otherwise the first one."""
    methods = methods_of(rows)
    return "zou2024" if "zou2024" in methods else (methods or [""])[0]


def _paint_path(axes: Any, paths: _Paths) -> None:
    points = _shown(paths.truth)
    floor = float(points[:, 2].min())
    axes.plot(points[:, 0], points[:, 1], floor, color=GRID, linewidth=1.6)
    if paths.reference is not None:
        planned = _shown(paths.reference, airborne(paths.truth))
        axes.plot(*planned.T, color=FAINT, linewidth=0.9, linestyle=(0, (4, 3)))
    axes.plot(*points.T, color=METHOD_COLOURS["livo"], linewidth=1.6)
    axes.scatter(*points[0], color=METHOD_COLOURS["hybrid_flow"], s=16)
    axes.scatter(*points[-1], color=METHOD_COLOURS["optical_flow"], s=16)
    axes.set_box_aspect((1.0, 1.0, 0.6))
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    axes.set_zlabel("z (m)")
    axes.tick_params(labelsize=7)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.pane.fill = False
        axis.pane.set_edgecolor(GRID)


def paths_per_method(rows: Sequence[Row]) -> Picture | None:
    """Fig. 10 a: the flown path and the reference, one panel per method."""
    scenes = scenes_of(rows)
    scene = ANALYSED_SCENE if ANALYSED_SCENE in scenes else scenes[0]
    methods = methods_of(rows)
    found = [(m, p) for m in methods if (p := first_flight(rows, scene, m, "fly"))]
    found = found or [(m, p) for m in methods if (p := first_flight(rows, scene, m, "land"))]
    if not found:
        return None
    columns = min(3, len(found))
    lines = -(-len(found) // columns)

    def paint(figure: Figure) -> None:
        grid = figure.subplots(lines, columns, squeeze=False, sharex=True, sharey=True).ravel()
        for axes in grid[len(found) :]:
            axes.set_visible(False)
        for axes, (method, paths) in zip(grid, found, strict=False):
            _paint_plan(axes, paths, colour_of(method, methods))
            axes.set_title(method)
        handles, labels = grid[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=3, fontsize=8)
        figure.supxlabel("x (m)", fontsize=9)
        figure.supylabel("y (m)", fontsize=9)

    caption = (
        f"Plan view over {scene}, lowest seed of each method. The vehicle flies what it believes: "
        "where the estimate is off, the flown path leaves the reference. World frame, metres."
    )
    size = (max(4.2, 3.6 * columns), 2.3 * lines + 0.6)
    return draw("fig10a", f"Fig. 10 a: paths per method, {scene}", caption, size, paint)


def _paint_plan(axes: Axes, paths: _Paths, colour: str) -> None:
    start = airborne(paths.truth)
    if paths.reference is not None:
        planned = _shown(paths.reference, start)
        axes.plot(*planned[:, :2].T, color=FAINT, linewidth=2.4, alpha=0.45, label="reference")
    flown = _shown(paths.truth, start)
    axes.plot(*flown[:, :2].T, color=colour, linewidth=1.4, label="flown")
    if paths.estimate is not None:
        estimated = _shown(paths.estimate, start)
        axes.plot(
            *estimated[:, :2].T,
            color=INK,
            linewidth=0.8,
            linestyle=(0, (1, 1.6)),
            label="estimated",
        )
    axes.set_aspect("equal", adjustable="box")


# -------------------------------------------------------------------------------------------- bars


def error_bars(rows: Sequence[Row], key: str, name: str, title: str, what: str) -> Picture | None:
    """Fig. 10 b-e: x, y, z and yaw per method and scene, with intervals."""
    if not values(rows, f"{key}.x"):
        return None
    scenes, methods = scenes_of(rows), methods_of(rows)

    def paint(figure: Figure) -> None:
        grid = figure.subplots(2, 2)
        for axes, (axis, label) in zip(grid.ravel(), AXES, strict=True):
            _paint_bars(axes, rows, f"{key}.{axis}", scenes, methods)
            axes.set_ylabel(label)
        handles, labels = grid[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=len(methods), fontsize=8)

    caption = (
        f"{what}, mean over flights with 95 % bootstrap interval. Axes are logarithmic where the "
        "methods lie more than a factor of 20 apart; there lengths of bars are no ratios."
    )
    caption = " ".join([caption, *setting_notes([f"{key}.x"], methods)])
    return draw(name, title, caption, (10.4, 6.0), paint)


def _paint_bars(
    axes: Axes, rows: Sequence[Row], key: str, scenes: Sequence[str], methods: Sequence[str]
) -> None:
    width = 0.84 / len(methods)
    heights: list[float] = []
    by_cell = estimates(rows, mean_of(key))
    for index, method in enumerate(methods):
        found = [by_cell.get(CellKey(method, scene)) for scene in scenes]
        places = [i for i, estimate in enumerate(found) if estimate is not None]
        shown = [estimate for estimate in found if estimate is not None]
        at = np.array(places) + (index - 0.5 * (len(methods) - 1)) * width
        colour = colour_of(method, methods)
        heights += [estimate.value for estimate in shown]
        label = f"{method} {SET_MARK}" if is_marked(key, method) else method
        axes.bar(at, [e.value for e in shown], 0.9 * width, color=colour, label=label)
        axes.errorbar(
            at,
            [e.value for e in shown],
            yerr=np.array([_whiskers(e) for e in shown]).reshape(-1, 2).T,
            fmt="none",
            ecolor=INK,
            elinewidth=0.9,
            capsize=2.0,
        )
    positive = [height for height in heights if height > 0.0]
    if positive and max(positive) > 20.0 * min(positive):
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_locator(NullLocator())
        axes.set_ylim(bottom=0.5 * min(positive))
    axes.set_xticks(range(len(scenes)), [visible(scene) for scene in scenes])
    axes.grid(axis="x", visible=False)


def _whiskers(estimate: Estimate) -> tuple[float, float]:
    if estimate.low is None or estimate.high is None:
        return 0.0, 0.0
    return max(0.0, estimate.value - estimate.low), max(0.0, estimate.high - estimate.value)


def all_pictures(rows: Sequence[Row]) -> list[Picture]:
    """Returns the figures for which the flights have data."""
    deviation = error_bars(
        rows,
        "path_deviation",
        "fig10b",
        "Fig. 10 b–e: deviation of the flown path from the reference",
        "Mean absolute deviation between lift-off and the end of the survey",
    )
    error = error_bars(
        rows,
        "position_error_m",
        "fig10_estimate",
        "The same for the estimate: its error against the truth",
        "Mean absolute error of the estimate between lift-off and the end of the survey",
    )
    found = [paths_per_method(rows), deviation, error]
    return survey_and_landing(rows) + [picture for picture in found if picture is not None]
