"""Figures of a report as SVG: trajectories, errors by axis, touchdowns."""

import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.text import Text

from touchdown.experiments.drawing.style import FAINT, GRID, INK, STYLE, new_figure
from touchdown.experiments.errors import visible
from touchdown.experiments.reporting.flights import ORDER, ordered, values, values_and_units
from touchdown.experiments.reporting.measures import AXES, SET_MARK, is_marked, setting_notes
from touchdown.experiments.reporting.published import ANALYSED_SCENE
from touchdown.experiments.reporting.statistics import Estimate, mean_interval
from touchdown.experiments.reporting.trajectories import Trajectory, read_trajectory
from touchdown.sim.typing import Array

_STYLE: Any = {
    **STYLE,
    "svg.fonttype": "none",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
}


@dataclass(slots=True)
class Picture:
    """``name`` is its file name without the ending."""

    name: str
    title: str
    caption: str
    svg: str = ""

    @property
    def on_page(self) -> str:
        """The SVG element alone."""
        return self.svg[self.svg.index("<svg") :]


def colour_of(method: str, methods: Sequence[str]) -> str:
    """The colour of a method among ``methods``; the project's own have always the same."""
    known = list(dict.fromkeys([*ORDER["estimator"], *methods]))
    return f"C{known.index(method) % 10}"


@contextmanager
def drawn(picture: Picture, width: float, height: float) -> Iterator[Figure]:
    """Gives a figure, in inches, to be filled, which becomes the SVG of ``picture``. The same data
    give the same text."""
    style: Any = {**_STYLE, "svg.hashsalt": picture.name}
    with matplotlib.rc_context(style):
        figure = new_figure(width, height)
        yield figure
        for words in figure.findobj(Text):
            words.set_text(visible(words.get_text(), keep="\n"))
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    picture.svg = text.getvalue()


_PATH_POINTS = 300
_COLUMNS = 4
"""of small drawings beside one another"""


def pictures_of(frame: pd.DataFrame) -> list[Picture]:
    """Returns the figures for which the flights have data."""
    by_mode = {mode: frame[frame["mode"] == mode] for mode in ("fly", "land")}
    surveys = by_mode["fly"] if len(by_mode["fly"]) else frame
    deviation = Picture(
        "fig10b",
        "Fig. 10 b–e: deviation of the flown path from the reference",
        "Mean absolute deviation between lift-off and the end of the survey",
    )
    error = Picture(
        "fig10_estimate",
        "The same for the estimate: its error against the truth",
        "Mean absolute error of the estimate between lift-off and the end of the survey",
    )
    found = [
        _paths_by_scene(by_mode["fly"], "fig9a", "Fig. 9 a: survey trajectories"),
        _paths_by_scene(by_mode["land"], "fig9b", "Fig. 9 b: landing trajectories"),
        _paths_by_method(surveys),
        _error_bars(frame, "path_deviation", deviation),
        _error_bars(frame, "position_error_m", error),
        _touchdowns(by_mode["land"]),
    ]
    return [picture for picture in found if picture is not None]


_Paths = tuple[Trajectory, Trajectory | None, Trajectory | None]
"""trajectories of a flight: truth, estimate, reference"""


def _first_flights(flights: pd.DataFrame, by: str) -> list[tuple[str, _Paths]]:
    """Of each scene or method the flight with the lowest seed that has trajectories and left the
    ground."""
    found: dict[str, _Paths] = {}
    for name in ordered(flights, by):
        own = flights[flights[by] == name].sort_values("seed", kind="stable")
        for folder in map(Path, own["run_dir"]):
            truth, estimate, reference = (
                read_trajectory(folder / f"{kind}.tum")
                for kind in ("truth", "estimate", "reference")
            )
            if truth is not None and truth.lift_off < len(truth.time_s):
                found[name] = truth, estimate, reference
                break
    return list(found.items())


def _points(path: Trajectory, start: int = 0) -> Array:
    """(<= _PATH_POINTS, 3) positions from a sample on, thinned."""
    position = path.position[start:]
    return position[:: max(1, len(position) // _PATH_POINTS)]


def _paths_by_scene(frame: pd.DataFrame, name: str, title: str) -> Picture | None:
    """Fig. 9: a flight of each scene with the paper's method, otherwise with the first one."""
    methods = ordered(frame, "estimator")
    method = "zou2024" if "zou2024" in methods else (methods or [""])[0]
    found = _first_flights(frame[frame["estimator"] == method], "scene")
    if not found:
        return None
    picture = Picture(
        name,
        title,
        f"Flown path (blue, from green to red) and reference (dashed) with `{method}`, lowest seed "
        "of each scene; the shadow is the plan view. World frame, metres.",
    )
    columns, lines = min(len(found), _COLUMNS), -(-len(found) // _COLUMNS)
    with drawn(picture, max(3.3 * columns, 4.2), 3.5 * lines) as figure:
        for index, (scene, paths) in enumerate(found, start=1):
            axes = figure.add_subplot(lines, columns, index, projection="3d", title=scene)
            _paint_path(axes, paths)
    return picture


def _paint_path(axes: Any, paths: _Paths) -> None:
    truth, _, reference = paths
    points = _points(truth)
    axes.plot(*points[:, :2].T, float(points[:, 2].min()), color=GRID, linewidth=1.6)
    if reference is not None:
        planned = _points(reference, truth.lift_off)
        axes.plot(*planned.T, color=FAINT, linewidth=0.9, linestyle=(0, (4, 3)))
    axes.plot(*points.T, color="tab:blue", linewidth=1.6)
    axes.scatter(*points[0], color="tab:green", s=16)
    axes.scatter(*points[-1], color="tab:red", s=16)
    axes.set_aspect("equal", adjustable="box")
    axes.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)")
    axes.tick_params(labelsize=7)


def _paths_by_method(frame: pd.DataFrame) -> Picture | None:
    """Fig. 10 a: the flown path and the reference, one panel per method."""
    scenes = ordered(frame, "scene")
    scene = ANALYSED_SCENE if ANALYSED_SCENE in scenes else scenes[0]
    found = _first_flights(frame[frame["scene"] == scene], "estimator")
    if not found:
        return None
    columns, lines = min(3, len(found)), -(-len(found) // 3)
    picture = Picture(
        "fig10a",
        f"Fig. 10 a: paths per method, {scene}",
        f"Plan view over {scene}, lowest seed of each method. The vehicle flies what it believes: "
        "where the estimate is off, the flown path leaves the reference. World frame, metres.",
    )
    methods = ordered(frame, "estimator")
    with drawn(picture, max(4.2, 3.6 * columns), 2.3 * lines + 0.6) as figure:
        panels = figure.subplots(lines, columns, squeeze=False, sharex=True, sharey=True).ravel()
        for axes in panels[len(found) :]:
            axes.set_visible(False)
        for axes, (method, paths) in zip(panels, found, strict=False):
            _paint_plan(axes, paths, colour_of(method, methods))
            axes.set_title(method)
        add_legend(figure, panels[0], 3)
        figure.supxlabel("x (m)", fontsize=9)
        figure.supylabel("y (m)", fontsize=9)
    return picture


def _paint_plan(axes: Axes, paths: _Paths, colour: str) -> None:
    truth, estimate, reference = paths
    for path, label, style in (
        (reference, "reference", {"color": FAINT, "linewidth": 2.4, "alpha": 0.45}),
        (truth, "flown", {"color": colour, "linewidth": 1.4}),
        (estimate, "estimated", {"color": INK, "linewidth": 0.8, "linestyle": ":"}),
    ):
        if path is not None:
            shown: Any = style
            axes.plot(*_points(path, truth.lift_off)[:, :2].T, label=label, **shown)
    axes.set_aspect("equal", adjustable="box")


def add_legend(figure: Figure, axes: Axes, columns: int) -> None:
    """A legend over all panels of what one of them shows."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=columns, fontsize=8)


def _error_bars(frame: pd.DataFrame, key: str, picture: Picture) -> Picture | None:
    """Fig. 10 b-e: x, y, z and yaw per method and scene, with intervals."""
    if not values(frame, f"{key}.x").size:
        return None
    scenes, methods = ordered(frame, "scene"), ordered(frame, "estimator")
    picture.caption += (
        ", mean over flights with 95 % bootstrap interval. Axes are logarithmic where the methods "
        "lie more than a factor of 20 apart; there lengths of bars are no ratios."
    )
    picture.caption = " ".join([picture.caption, *setting_notes([f"{key}.x"], methods)])
    with drawn(picture, 10.4, 6.0) as figure:
        panels = figure.subplots(2, 2).ravel()
        for axes, (axis, name, unit) in zip(panels, AXES, strict=True):
            _paint_bars(axes, frame, f"{key}.{axis}", scenes, methods)
            axes.set_ylabel(f"{name} ({unit})")
        add_legend(figure, panels[0], len(methods))
    return picture


def _paint_bars(
    axes: Axes, frame: pd.DataFrame, column: str, scenes: Sequence[str], methods: Sequence[str]
) -> None:
    width = 0.84 / len(methods)
    heights: list[float] = []
    for index, method in enumerate(methods):
        offset = (index - 0.5 * (len(methods) - 1)) * width
        own = frame[frame["estimator"] == method]
        found = {
            at + offset: figure
            for at, scene in enumerate(scenes)
            if (figure := mean_interval(*values_and_units(own[own["scene"] == scene], column)))
        }
        label = f"{method} {SET_MARK}" if is_marked(column, [method]) else method
        bars = [figure.value for figure in found.values()]
        axes.bar(list(found), bars, 0.9 * width, color=colour_of(method, methods), label=label,
                 yerr=whiskers(found.values()), ecolor=INK, capsize=2.0)  # fmt: skip
        heights += [height for height in bars if height > 0.0]
    if heights and max(heights) > 20.0 * min(heights):
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
        axes.set_ylim(bottom=0.5 * min(heights))
    axes.set_xticks(range(len(scenes)), [visible(scene) for scene in scenes])
    axes.grid(axis="x", visible=False)


def whiskers(found: Iterable[Estimate]) -> Array:
    """(2, N) lengths of the intervals below and above their figures; 0 without one."""
    ends = [
        (0.0, 0.0) if f.low is None or f.high is None else (f.value - f.low, f.high - f.value)
        for f in found
    ]
    return np.maximum(np.reshape(ends, (-1, 2)).T, 0.0)


_RINGS_M = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
_MARKERS = ("o", "s", "^", "D", "v", "P", "X")
_ZOOM_FROM = 4.0
"""a second panel shows the nearest method, if possible the nearest two, where the farthest is this
many times as far"""


def offsets_xy(frame: pd.DataFrame) -> Array:
    """(N, 2) east and north of the first contacts from the commanded spots, or from the committed
    sites where none was commanded, metres; flights without a position are left out."""
    commanded, site, contact = (
        frame.get(f"landing.{name}_xy_m", pd.Series(index=frame.index, dtype=object))
        for name in ("commanded", "site", "touchdown")
    )
    both = pd.concat([commanded.combine_first(site), contact], axis=1).dropna()
    found = [np.subtract(at, spot) for spot, at in both.itertuples(index=False)]
    return np.array(found, dtype=np.float64).reshape(-1, 2)


def _touchdowns(landings: pd.DataFrame) -> Picture | None:
    """Fig. 12: touchdowns of each method around the spot."""
    landed = landings[landings["outcome"] == "LANDED"]
    found = {
        method: offsets_xy(landed[landed["estimator"] == method])
        for method in ordered(landed, "estimator")
    }
    offsets = {method: points for method, points in found.items() if len(points)}
    if not offsets:
        return None
    commanded = (
        "landing.commanded_xy_m" in landed and landed["landing.commanded_xy_m"].notna().all()
    )
    spot = "the commanded spot" if commanded else "the site that was committed at 4 m"
    counts = ", ".join(f"{len(points)} with `{method}`" for method, points in offsets.items())
    picture = Picture(
        "fig12",
        f"Fig. 12: touchdowns around {spot}",
        f"First contact with the ground relative to {spot} (cross), metres east and north: "
        f"{counts}. Large open marks are the means of the methods.",
    )
    reaches = sorted(max(float(np.hypot(*p.T).max()), 0.01) for p in offsets.values())
    near = [reach for reach in reaches[:2] if reaches[-1] > _ZOOM_FROM * reach]
    spans = [1.15 * reach for reach in (reaches[-1], *near[-1:])]
    with drawn(picture, 5.0 * len(spans), 5.2) as figure:
        panels = figure.subplots(1, len(spans), squeeze=False)[0]
        for axes, span, title in zip(panels, spans, ("all", "the nearest, enlarged"), strict=False):
            _paint_touchdowns(axes, offsets, span)
            axes.set_title(title)
        add_legend(figure, panels[0], min(6, len(offsets)))
    return picture


def _paint_touchdowns(axes: Axes, offsets: Mapping[str, Array], span_m: float) -> None:
    methods = list(offsets)
    for radius in (radius for radius in _RINGS_M if 0.15 * span_m < radius < span_m):
        axes.add_patch(Circle((0.0, 0.0), radius, fill=False, edgecolor=FAINT, linestyle="--"))
        axes.annotate(
            f"{radius:g} m", (0.0, -radius), xytext=(0, 2), textcoords="offset points",
            ha="center", va="bottom", fontsize=7, color=FAINT,
        )  # fmt: skip
    for index, (method, points) in enumerate(offsets.items()):
        colour, marker = colour_of(method, methods), _MARKERS[index % len(_MARKERS)]
        east, north = points.T
        axes.scatter(
            east, north, s=24, alpha=0.8, linewidths=0, color=colour, marker=marker, label=method,
            zorder=3,
        )  # fmt: skip
        if len(points) > 1:
            axes.scatter(
                east.mean(), north.mean(), s=130, facecolors="none", edgecolors=colour,
                linewidths=1.8, marker=marker, zorder=4,
            )  # fmt: skip
    axes.plot(0.0, 0.0, marker="+", markersize=16, markeredgewidth=1.4, color=INK, zorder=2)
    axes.set(xlim=(-span_m, span_m), ylim=(-span_m, span_m), aspect="equal")
    axes.locator_params(nbins=6)
    axes.set(xlabel="x, east (m)", ylabel="y, north (m)")
