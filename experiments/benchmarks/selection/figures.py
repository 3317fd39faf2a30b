"""Figures of the steps of one selection, from the map to the site (the paper's Fig. 11)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import NDArray

from touchdown.experiments.drawing.costmap_image import photo_of, seen_box
from touchdown.landing.api import Candidate, CostmapView, Selection

Layer = NDArray[Any]

_DPI, _JPEG_QUALITY = 110, 80
_PANEL_IN = 3.0
"""height of a panel"""
_SHAPES = 0.75, 1.6
"""limits of a panel's width over its height"""
_INK, _FAINT, _UNKNOWN = "#1b1f27", "#6a7280", "#23272e"
_BLUE, _RED = "#2f8dff", "#ff2d2d"
_CLEAR_RADIUS_M = 1.5
_STYLE: Any = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 8,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.edgecolor": _FAINT,
    "xtick.color": _FAINT,
    "ytick.color": _FAINT,
    "axes.linewidth": 0.6,
}


def steps_figure(selection: Selection, title: str) -> Figure:
    """Returns a figure of two rows of panels, north up, metres of the odom frame.

    Panels: the coloured map, every term of the selector and the score over the range in its title,
    what passes the gates, clusters, and the candidates (blue, open where refused) with the site
    (red) and the radius of 1.5 m that must be clear. Raises ValueError where nothing was mapped."""
    view = selection.costmap
    if view is None:
        raise ValueError("nothing was mapped: there are no steps to draw")
    rows, cols = seen_box(view)
    width = _PANEL_IN * float(
        np.clip((cols.stop - cols.start) / (rows.stop - rows.start), *_SHAPES)
    )
    layers = _layers(selection, view)
    count = (len(layers) + 1) // 2
    figure = Figure(
        figsize=(count * (width + 0.15) + 1.3, 2.0 * (_PANEL_IN + 0.3) + 0.8),
        dpi=_DPI,
        layout="constrained",
        facecolor="white",
    )
    panels = figure.subplots(2, count, sharex=True, sharey=True)
    for axes in panels.ravel()[len(layers) :]:
        axes.set_visible(False)
    shown: Any = None
    for number, (axes, (name, layer)) in enumerate(zip(panels.ravel(), layers, strict=False)):
        image = _show(axes, view, layer)
        shown = image if layer.ndim == 2 else shown
        axes.set_title(f"({chr(ord('a') + number)}) {name}", color=_INK)
        axes.tick_params(labelsize=7, length=2)
    bar = figure.colorbar(shown, ax=panels, shrink=0.55, aspect=32, pad=0.008)
    bar.set_label("higher is better", fontsize=8, color=_INK)
    bar.ax.tick_params(labelsize=7)
    bar.outline.set_visible(False)
    _paint_candidates(panels.ravel()[len(layers) - 1], selection.candidates)
    figure.supxlabel("east (m)", fontsize=8, color=_FAINT)
    figure.supylabel("north (m)", fontsize=8, color=_FAINT)
    figure.suptitle(title, x=0.012, ha="left", fontsize=10, color=_INK)
    return figure


def write_steps(path: Path, place: str, selection: Selection) -> None:
    """Writes `steps_figure` of a selection over ``place`` as JPEG.

    Raises ValueError as `steps_figure`, and OSError where the file cannot be written."""
    site = chosen(selection.candidates)
    verdict = "no site"
    if site is not None:
        east, north = site.position_odom[:2]
        verdict = f"site at ({east:.1f}, {north:.1f}) m, {site.reason}"
    with matplotlib.rc_context(_STYLE):
        figure = steps_figure(selection, f"{place}\n{verdict}")
        figure.savefig(path, format="jpg", pil_kwargs={"quality": _JPEG_QUALITY})


def chosen(candidates: Sequence[Candidate]) -> Candidate | None:
    """Returns the site: the first candidate that was accepted."""
    return next((site for site in candidates if site.accepted), None)


def _layers(selection: Selection, view: CostmapView) -> list[tuple[str, Layer]]:
    """Title and raster of each panel: (rows, cols) in [0, 1] or (rows, cols, 3) RGB, of the seen
    part of the map."""
    seen = seen_box(view)
    known = np.isfinite(view.flatness)
    if not known.any():  # the terms of Eqs. 14 to 18 are those of the shipped selectors
        known = view.rgb.any(axis=2) | np.isfinite(view.value)
    terms = [(term.name, np.where(known, term.value, np.nan)[seen]) for term in view.terms]
    passed = np.where(known, selection.allowed.astype(np.float32), np.float32(np.nan))
    layers: list[tuple[str, Layer]] = [
        ("map, from above", photo_of(view)),
        *(_over_its_range(*term) for term in [*terms, ("score", view.value[seen])]),
        ("gates", passed[seen]),
    ]
    if len(selection.modes):
        label = np.where(known, selection.cluster, -1)[seen]
        colours = matplotlib.colormaps["tab20"](label % 20, bytes=True)[..., :3]
        dark = matplotlib.colors.to_rgba_array(_UNKNOWN)[0, :3] * 255
        clusters = np.where(label[..., None] >= 0, colours, dark).astype(np.uint8)
        layers.append((f"{len(selection.modes)} clusters, Quick Shift (Eq. 19)", clusters))
    return [*layers, ("candidates (blue), site (red)", photo_of(view))]


def _over_its_range(name: str, layer: Layer) -> tuple[str, Layer]:
    """Returns a panel of ``layer`` from its least to its highest value, which its title names."""
    seen = layer[np.isfinite(layer)]
    low, high = (float(seen.min()) + 0.0, float(seen.max()) + 0.0) if seen.size else (0.0, 0.0)
    return f"{name}, {low:.2f} to {high:.2f}", (layer - low) / max(high - low, 1e-6)


def _show(axes: Axes, view: CostmapView, layer: Layer) -> Any:
    """Draws a raster of the seen part at its position."""
    rows, cols = seen_box(view)
    (x, y), cell = view.origin_xy_m.tolist(), view.cell_m
    low = x + cell * cols.start, y + cell * rows.start
    high = x + cell * cols.stop, y + cell * rows.stop
    axes.set_facecolor(_UNKNOWN)
    return axes.imshow(
        layer,
        origin="lower",
        extent=(low[0], high[0], low[1], high[1]),
        cmap="viridis",
        vmin=0.0,
        vmax=1.0,
        interpolation="nearest" if layer.ndim == 3 else "auto",
    )


def _paint_candidates(axes: Axes, candidates: Sequence[Candidate]) -> None:
    """Draws the candidates and, around the site, the radius that must be clear."""
    known = [site for site in candidates if np.isfinite(site.position_odom[:2]).all()]
    for site in known:
        (x, y), face = site.position_odom[:2].tolist(), _BLUE if site.accepted else "none"
        edge = "white" if site.accepted else _BLUE
        axes.scatter(x, y, s=44, facecolors=face, edgecolors=edge, zorder=3)
    if (best := chosen(known)) is not None:
        x, y = best.position_odom[:2].tolist()
        axes.scatter(x, y, s=80, color=_RED, edgecolors="white", zorder=4)
        axes.add_patch(Circle((x, y), _CLEAR_RADIUS_M, fill=False, color=_RED))
