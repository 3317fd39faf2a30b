"""The picture of a choice: the map and what ranks its sites, the candidates, and their terms."""

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from touchdown.experiments.drawing.map_images import Marks
from touchdown.experiments.drawing.style import (
    FAINT,
    INK,
    RIM,
    STYLE,
    Extent,
    draw_marks,
    new_figure,
    pixels_of,
    write_figure,
)
from touchdown.landing.api import Candidate, CostmapView, Decision, LanderView
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array

Colours = NDArray[np.uint8]

UNKNOWN_RGB = (30, 32, 38)
CHOSEN, ACCEPTED, REFUSED = "#1f9d3a", "#1f8fd6", "#e03131"
_MARGIN_CELLS = 8
_PANEL_IN, _ROW_IN = 6.5, 0.19
_LINE_LETTERS = 150
_CAPTION = "x east, y north (m, world); white circle: take-off; dashed: the survey's legs"


def costmap_image(view: LanderView, site_odom: Array | None) -> Colours:
    """Returns the coloured map beside the map of the score that ranks the sites, north up in the
    odom frame, with the candidates of the last decision: (H, W, 3) RGB. Raises ValueError as
    `costmap_of`."""
    return pixels_of(_figure(view, site_odom, Pose.identity(), None))


def write_costmap(
    path: Path, view: LanderView, site_odom: Array | None, world_from_odom: Pose, marks: Marks
) -> None:
    """Writes the image of `costmap_image` with ticks in metres of the world frame, take-off
    point, the survey's rectangle and a table of the candidates' terms."""
    write_figure(path, _figure(view, site_odom, world_from_odom, marks))


def fitted(image: Colours, shape: tuple[int, int]) -> Colours:
    """Returns ``image`` (H, W, 3) as large as it fits into the middle of ``shape`` (rows, cols): a
    viewer takes the images of a path for a video, whose size must not change."""
    (rows, cols), (height, width) = shape, image.shape[:2]
    scale = min(rows / height, cols / width)
    size = round(width * scale), round(height * scale)
    page = np.empty((rows, cols, 3), np.uint8)
    page[:] = image[0, 0]
    left, top = (cols - size[0]) // 2, (rows - size[1]) // 2
    page[top : top + size[1], left : left + size[0]] = cv2.resize(
        image, size, interpolation=cv2.INTER_AREA
    )
    return page


def costmap_of(view: LanderView) -> CostmapView:
    """Returns the costmap. Raises ValueError for a view without one."""
    if view.costmap is None:
        raise ValueError("nothing is mapped: there is no costmap to draw")
    return view.costmap


def seen_box(view: CostmapView) -> tuple[slice, slice]:
    """The part of the grid that holds known cells, with a small margin."""
    known = np.isfinite(view.total)
    if not known.any():
        return slice(0, known.shape[0]), slice(0, known.shape[1])
    spans = []
    for axis in (1, 0):
        hits = np.flatnonzero(known.any(axis=axis))
        last = known.shape[1 - axis]
        spans.append(
            slice(max(hits[0] - _MARGIN_CELLS, 0), min(hits[-1] + 1 + _MARGIN_CELLS, last))
        )
    return spans[0], spans[1]


def photo_of(costmap: CostmapView) -> Colours:
    """Returns the colours (H, W, 3) of the seen part of the map, south first."""
    rows, cols = seen_box(costmap)
    photo = costmap.rgb[rows, cols].copy()
    photo[~np.isfinite(costmap.total[rows, cols]) & ~photo.any(axis=2)] = UNKNOWN_RGB
    return photo


def extent_of(costmap: CostmapView, world_from_odom: Pose) -> tuple[Extent, Array]:
    """The edges of the seen part of ``costmap`` in the world, and what is added to x and y (2,) of
    the odom frame. The frames differ by a rotation of a fraction of a degree: exact in the middle
    of the map, approximate elsewhere."""
    rows, cols = seen_box(costmap)
    low = costmap.origin_xy_m + costmap.cell_m * np.array([cols.start, rows.start])
    high = costmap.origin_xy_m + costmap.cell_m * np.array([cols.stop, rows.stop])
    middle = np.array([*(0.5 * (low + high)), 0.0])
    offset = (world_from_odom.apply(middle) - middle)[:2]
    (west, south), (east, north) = (low + offset).tolist(), (high + offset).tolist()
    return (west, east, south, north), offset


def _figure(
    view: LanderView, site_odom: Array | None, world_from_odom: Pose, marks: Marks | None
) -> Figure:
    """Two maps; with ``marks`` they and the terms of the last decision, too."""
    costmap, is_chosen = costmap_of(view), site_odom is not None
    extent, offset = extent_of(costmap, world_from_odom)
    decision = view.decisions[-1] if marks is not None and view.decisions else None
    words = [] if decision is None else _table(decision)
    height = _PANEL_IN * (extent[3] - extent[2]) / (extent[1] - extent[0]) + 1.0
    with matplotlib.rc_context(STYLE):
        figure = new_figure(2.0 * _PANEL_IN + 1.5, height + _ROW_IN * len(words))
        panels = figure.subplots(1, 2, sharex=True, sharey=True)
        panels[0].imshow(photo_of(costmap), origin="lower", extent=extent, interpolation="nearest")
        shown = _draw_score(panels[1], costmap, extent)
        figure.colorbar(shown, ax=panels, shrink=0.7, pad=0.01, label="score of accepted ground;\n"
                        "refused ground is grey, brighter for more")  # fmt: skip
        for axes in panels:
            if marks is not None:
                draw_marks(axes, marks)
                axes.set_xlabel(_CAPTION)
            _draw_candidates(axes, view.candidates, offset, chosen=is_chosen)
        if words:
            _write_table(figure, words, _sign_colours(view.candidates, is_chosen))
    return figure


def _draw_score(axes: Axes, costmap: CostmapView, extent: Extent) -> Any:
    """Viridis where a site is accepted, but for the lowest fiftieth; grey where none is; dark where
    the score is unknown. Returns the image of accepted ground."""
    rows, cols = seen_box(costmap)
    value, allowed = costmap.value[rows, cols], costmap.allowed[rows, cols]
    axes.set_facecolor(tuple(np.array(UNKNOWN_RGB) / 255.0))
    where: Any = {"origin": "lower", "extent": extent, "interpolation": "nearest"}
    for mask, colours, ends in (
        (~allowed, "gray", (1.0, 99.0)),
        (allowed, "viridis", (2.0, 100.0)),
    ):
        layer = np.where(mask, value, np.nan)
        known = layer[np.isfinite(layer)]
        low, high = np.percentile(known, ends) if known.size else (0.0, 1.0)
        shown = axes.imshow(layer, cmap=colours, vmin=low, vmax=max(high, low + 1e-6), **where)
    return shown


def _sign_colours(candidates: Sequence[Candidate], chosen: bool) -> list[str]:
    """The colour of each candidate's sign; ``chosen``: the first is the chosen site."""
    found = [ACCEPTED if candidate.accepted else REFUSED for candidate in candidates]
    return [CHOSEN, *found[1:]] if chosen and found else found


def _draw_candidates(
    axes: Axes, candidates: Sequence[Candidate], offset: Array, *, chosen: bool
) -> None:
    """Draws a ring at an accepted site, a cross at a refused one and a cross hair at the chosen
    site, each with its rank."""
    axes.autoscale(False)
    colours = _sign_colours(candidates, chosen)
    for number, (site, colour) in enumerate(zip(candidates, colours, strict=True), start=1):
        at = site.position_odom[:2] + offset
        marks = [("o", 9.0), ("+", 26.0)] if colour == CHOSEN else [("ox"[not site.accepted], 8.0)]
        for marker, size in marks:
            axes.plot(*at, marker=marker, markersize=size, markerfacecolor="none",
                      markeredgecolor=colour, markeredgewidth=2.0, path_effects=RIM)  # fmt: skip
        axes.annotate(str(number), tuple(at), xytext=(6, 6), textcoords="offset points",
                      color="white", fontsize=10, path_effects=RIM)  # fmt: skip


def _table(decision: Decision) -> list[str]:
    """The reason of a choice, the titles of its columns, and a line for each candidate with the
    terms that add up to its score."""
    sites = decision.candidates
    terms = next((site.terms for site in sites if site.terms), ())
    names = [("= " if not k else "+ ") + t.name.replace("_", " ") for k, t in enumerate(terms)]
    titles = ["", "score", *names, "ground", "slope, step, clearance", "rule"]
    rows = [titles, *(_row(n, site, len(terms)) for n, site in enumerate(sites, start=1))]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)) for row in rows]
    return [*textwrap.wrap(decision.why, _LINE_LETTERS), *lines]


def _row(number: int, site: Candidate, terms: int) -> list[str]:
    is_known = bool(np.isfinite(site.value))
    shown = []
    for term in site.terms if is_known else ():
        told = term.unit and np.isfinite(term.quantity)
        shown.append(f"{term.value:.3f}" + (f" ({term.quantity:.1f} {term.unit})" if told else ""))
    ground = "-"
    if site.class_predicted is not None:
        ground = f"{site.class_predicted} {site.class_probability:.2f}"
    shape = ((site.slope_deg, 1, "deg"), (site.step_m, 2, "m"), (site.clearance_m, 1, "m"))
    return [
        str(number),
        f"{site.value:.3f}" if is_known else "-",
        *(shown or ["-"] * terms),
        ground,
        ", ".join(f"{v:.{digits}f} {unit}" if np.isfinite(v) else "-" for v, digits, unit in shape),
        site.rule.replace("_", " "),
    ]


def _write_table(figure: Figure, words: Sequence[str], signs: Sequence[str]) -> None:
    """Writes lines below the maps, those of the candidates in the colours of their signs."""
    height = float(figure.get_figheight())
    engine: Any = figure.get_layout_engine()
    below = _ROW_IN * len(words) / height
    engine.set(rect=(0.0, below, 1.0, 1.0 - below))
    colours = [INK] * (len(words) - len(signs) - 1) + [FAINT, *signs]
    for line, (text, colour) in enumerate(zip(words, colours, strict=True), start=1):
        figure.text(0.03, _ROW_IN * (len(words) - line + 0.4) / height, text, family="monospace",
                    fontsize=8, color=colour)  # fmt: skip
