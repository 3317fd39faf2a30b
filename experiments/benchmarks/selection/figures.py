"""Figures of the steps of one selection, from the map to the site (the paper's Fig. 11)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import NDArray

from touchdown.experiments.drawing.costmap_image import seen_box
from touchdown.experiments.errors import UsageError
from touchdown.landing.api import Candidate, CostmapView, Selection
from touchdown.scenes.api import short_name

Array = NDArray[np.float64]
Colours = NDArray[np.uint8]
Layer = NDArray[Any]

MOST_BYTES = 250_000
_DPI = 110
_PANEL_IN = 3.0
"""height of a panel"""
_LEAST_SHAPE, _MOST_SHAPE = 0.75, 1.6
"""of a panel's width to its height"""
_QUALITIES = range(90, 30, -5)
_INK, _FAINT, _UNKNOWN = "#1b1f27", "#6a7280", "#23272e"
_BLUE, _RED = "#2f8dff", "#ff2d2d"
_CLEAR_RADIUS_M = 1.5
_INSET_M = 5.0
"""half the side of the enlarged site"""
_UNKNOWN_RGB = np.array([0x23, 0x27, 0x2E], np.uint8)
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


def steps_figure(selection: Selection, title: str) -> Colours:
    """Returns a figure (H, W, 3) RGB of two rows of panels, north up, metres of the odom frame.

    Panels: the coloured map, every term of the selector and the score over the range in its title,
    what passes the gates, clusters, and the candidates (blue, open where refused) with the site
    (red). Raises ValueError where nothing was mapped."""
    view = selection.costmap
    if view is None:
        raise ValueError("nothing was mapped: there are no steps to draw")
    with matplotlib.rc_context(_STYLE):
        rows, cols = seen_box(view)
        shape = (cols.stop - cols.start) / (rows.stop - rows.start)
        width = _PANEL_IN * min(max(shape, _LEAST_SHAPE), _MOST_SHAPE)
        count = (len(view.terms) + 6) // 2
        figure = Figure(
            figsize=(count * (width + 0.15) + 1.3, 2.0 * (_PANEL_IN + 0.3) + 0.8),
            dpi=_DPI,
            layout="constrained",
            facecolor="white",
        )
        panels = figure.subplots(2, count, sharex=True, sharey=True)
        _paint(figure, panels, selection, view)
        figure.suptitle(title, x=0.012, ha="left", fontsize=10, color=_INK)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def write_steps(path: Path, place: str, selection: Selection) -> None:
    """Writes `steps_figure` of a selection over ``place`` as JPEG of at most 250 kB.

    Raises ValueError as `steps_figure`, and OSError where the file cannot be written."""
    site = chosen(selection.candidates)
    verdict = "no site"
    if site is not None:
        east, north = site.position_odom[:2]
        verdict = f"site at ({east:.1f}, {north:.1f}) m, {site.reason}"
    title = f"{place}\n{verdict}"
    path.write_bytes(jpeg(steps_figure(selection, title)))


def figure_files(places: Sequence[tuple[str, int]], folder: Path) -> list[Path]:
    """Creates ``folder`` and returns a file in it for each scene and seed, such as
    ``site_turf.jpg``, with the seed in the name where there are several. Raises UsageError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"--pictures: '{folder}' cannot be created: {error.strerror}") from error
    several = len({seed for _, seed in places}) > 1
    return [
        folder / f"site_{short_name(scene)}{f'_{seed}' if several else ''}.jpg"
        for scene, seed in places
    ]


def chosen(candidates: Sequence[Candidate]) -> Candidate | None:
    """Returns the site: the first candidate that was accepted."""
    return next((site for site in candidates if site.accepted), None)


def jpeg(image: Colours, most_bytes: int = MOST_BYTES) -> bytes:
    """Returns an image (H, W, 3) RGB as JPEG in the best quality that fits, else in the lowest."""
    content = b""
    for quality in _QUALITIES:
        _, coded = cv2.imencode(
            ".jpg", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, quality]
        )
        content = coded.tobytes()
        if len(content) <= most_bytes:
            break
    return content


def _paint(figure: Figure, panels: NDArray[Any], selection: Selection, view: CostmapView) -> None:
    photo = _photo(view)
    known = np.isfinite(view.flatness)
    if not known.any():  # the terms of Eqs. 14 to 18 are those of the shipped selectors
        known = view.rgb.any(axis=2) | np.isfinite(view.value)
    passed = np.where(known, selection.allowed.astype(np.float32), np.float32(np.nan))
    layers: list[tuple[str, Layer]] = [
        ("map, from above", photo),
        *(_over_its_range(term.name, np.where(known, term.value, np.nan)) for term in view.terms),
        _over_its_range("score", view.value),
        ("gates", passed),
    ]
    if len(selection.modes):
        clusters = cluster_colours(np.where(known, selection.cluster, np.int32(-1)))
        layers.append((f"{len(selection.modes)} clusters, Quick Shift (Eq. 19)", clusters))
    layers.append(("candidates (blue), site (red)", photo))
    shown: Any = None
    for axes in panels.ravel()[len(layers) :]:
        axes.set_visible(False)
    for number, (axes, (name, layer)) in enumerate(zip(panels.ravel(), layers, strict=False)):
        image = _show(axes, view, layer)
        shown = image if layer.ndim == 2 else shown
        axes.set_title(f"({chr(ord('a') + number)}) {name}", color=_INK)
        axes.tick_params(labelsize=7, length=2)
    bar = figure.colorbar(shown, ax=panels, shrink=0.55, aspect=32, pad=0.008)
    bar.set_label("higher is better", fontsize=8, color=_INK)
    bar.ax.tick_params(labelsize=7)
    bar.outline.set_visible(False)
    if len(selection.modes):
        _paint_modes(panels.ravel()[len(layers) - 2], view, selection)
    _paint_candidates(panels.ravel()[len(layers) - 1], view, photo, selection.candidates)
    rows, cols = seen_box(view)
    low, high = _corner(view, rows.start, cols.start), _corner(view, rows.stop, cols.stop)
    panels[0, 0].set_xlim(low[0], high[0])
    panels[0, 0].set_ylim(low[1], high[1])
    figure.supxlabel("east (m)", fontsize=8, color=_FAINT)
    figure.supylabel("north (m)", fontsize=8, color=_FAINT)


def _over_its_range(name: str, layer: Layer) -> tuple[str, Layer]:
    """Returns a panel of ``layer`` from its least to its highest value, which its title names."""
    seen = layer[np.isfinite(layer)]
    low, high = (float(seen.min()) + 0.0, float(seen.max()) + 0.0) if seen.size else (0.0, 0.0)
    return f"{name}, {low:.2f} to {high:.2f}", (layer - low) / max(high - low, 1e-6)


def cluster_colours(label: NDArray[np.int32]) -> Colours:
    """Returns the colours (rows, cols, 3) RGB of cluster numbers (rows, cols), dark outside."""
    colours = matplotlib.colormaps["tab20"](label % 20, bytes=True)[..., :3]
    return np.where(label[..., None] >= 0, colours, _UNKNOWN_RGB).astype(np.uint8)


def _photo(view: CostmapView) -> Colours:
    """Returns the coloured map, dark where unknown, grey where it has no colour."""
    photo = view.rgb.copy()
    bare = ~photo.any(axis=2)
    photo[bare] = _UNKNOWN_RGB
    photo[bare & np.isfinite(view.flatness)] = 70
    return photo


def _show(axes: Axes, view: CostmapView, layer: Layer) -> Any:
    """Draws a raster at its position: (rows, cols) in [0, 1] or (rows, cols, 3) RGB."""
    low, high = _corner(view, 0, 0), _corner(view, *layer.shape[:2])
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


def _paint_modes(axes: Axes, view: CostmapView, selection: Selection) -> None:
    positions = _corner(view, 0, 0) + (selection.modes[:, ::-1] + 0.5) * view.cell_m
    axes.scatter(
        positions[:, 0], positions[:, 1], s=5, color="white", edgecolors=_INK, linewidths=0.4
    )


def _paint_candidates(
    axes: Axes, view: CostmapView, photo: Colours, candidates: Sequence[Candidate]
) -> None:
    """Draws the candidates, the site, and an inset around it."""
    known = [site for site in candidates if np.isfinite(site.position_odom[:2]).all()]
    site = chosen(known)
    for other in known:
        if other is not site:
            face = _BLUE if other.accepted else "none"
            axes.scatter(
                other.position_odom[0],
                other.position_odom[1], s=44, facecolors=face,
                edgecolors="white" if other.accepted else _BLUE,
                linewidths=0.8 if other.accepted else 1.8, zorder=3,
            )  # fmt: skip
    if site is None:
        return
    east, north = site.position_odom[:2]
    axes.scatter(east, north, s=80, color=_RED, edgecolors="white", linewidths=1.2, zorder=4)
    _paint_inset(axes, view, photo, site, np.array([c.position_odom[:2] for c in known]))


def _paint_inset(
    axes: Axes, view: CostmapView, photo: Colours, site: Candidate, positions: Array
) -> None:
    """Draws the enlarged site in the corner with the fewest of ``positions`` (N, 2), of those the
    farthest from the site; the ring is the radius of 1.5 m that must be clear."""
    east, north = (float(value) for value in site.position_odom[:2])
    rows, cols = seen_box(view)
    low, high = _corner(view, rows.start, cols.start), _corner(view, rows.stop, cols.stop)
    size = np.array([0.34, 0.34 * min(1.3, float((high - low)[0] / (high - low)[1]))])
    share, own = (positions - low) / (high - low), (np.array([east, north]) - low) / (high - low)

    def cost(corner: Array) -> tuple[int, float]:
        hidden = (np.abs(share - (corner + 0.5 * size)) < 0.5 * size + 0.02).all(axis=1)
        return int(hidden.sum()), -float(np.linalg.norm(corner + 0.5 * size - own))

    corners = [np.array([x, y]) for x in (0.02, 0.98 - size[0]) for y in (0.02, 0.98 - size[1])]
    left, bottom = min(corners, key=cost)
    inset = axes.inset_axes((float(left), float(bottom), *size.tolist()))
    _show(inset, view, photo)
    inset.add_patch(Circle((east, north), _CLEAR_RADIUS_M, fill=False, color=_RED, linewidth=1.4))
    inset.scatter(east, north, s=14, color=_RED)
    inset.set_xlim(east - _INSET_M, east + _INSET_M)
    inset.set_ylim(north - _INSET_M, north + _INSET_M)
    inset.set_xticks([])
    inset.set_yticks([])
    for spine in inset.spines.values():
        spine.set_edgecolor("white")
        spine.set_linewidth(1.2)


def _corner(view: CostmapView, row: int, col: int) -> Array:
    """Returns east and north (2,) of the lower left corner of a cell."""
    return np.asarray(view.origin_xy_m + view.cell_m * np.array([col, row], np.float64))
