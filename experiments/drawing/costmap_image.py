"""The picture of a choice: the map and what ranks its sites, the candidates, and their terms."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.drawing.candidate_signs import (
    ACCEPTED_RGB,
    CHOSEN_RGB,
    REFUSED_RGB,
    draw_ranks,
    draw_sign,
    draw_winner,
)
from touchdown.experiments.drawing.choice_table import choice_table
from touchdown.experiments.drawing.map_axes import PAPER, MapFrame, Marks
from touchdown.landing.api import CostmapView, LanderView
from touchdown.sim.frames import Pose

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]
Colours = NDArray[np.uint8]

_UNKNOWN_RGB = (30, 32, 38)
_PANEL_PIXELS = 1200
_MARGIN_CELLS = 8
_CAPTION = "x east, y north (m, world); white circle: take-off; dashed: the survey's legs"
_DARKEST, _BRIGHTEST = 48, 120
"""grey levels of refused ground, by its score"""


def costmap_image(view: LanderView, site_odom: Array | None) -> Colours:
    """Returns the coloured map beside the map of the score that ranks the sites, north up, with the
    candidates of the last decision: (H, W, 3) RGB. Raises ValueError as `costmap_of`."""
    left, right = _maps(costmap_of(view))
    _draw_candidates((left, right), view, site_odom)
    gap = np.full((left.shape[0], 12, 3), 255, np.uint8)
    return np.hstack([left, gap, right])


def write_costmap(
    path: Path, view: LanderView, site_odom: Array | None, world_from_odom: Pose, marks: Marks
) -> None:
    """Writes the image of `costmap_image` with ticks in metres of the world frame, take-off
    point, the survey's rectangle, a key of its colours and a table of the candidates' terms."""
    costmap = costmap_of(view)
    panels = _maps(costmap)
    frame = frame_of(costmap, world_from_odom)
    for panel in panels:
        frame.draw_marks(panel, marks)
    _draw_candidates(panels, view, site_odom)
    image = frame.around(panels, _CAPTION)
    image = frame.below(image, _key(frame, costmap, image.shape[1]))
    if view.decisions:
        table = choice_table(
            view.decisions[-1], image.shape[1], frame.scale, chosen=site_odom is not None
        )
        image = np.vstack([image, table])
    if not cv2.imwrite(str(path), cv2.cvtColor(image, cv2.COLOR_RGB2BGR)):
        raise OSError(f"{path} cannot be written")


def frame_of(costmap: CostmapView, world_from_odom: Pose) -> MapFrame:
    """Returns the frame, in the world, of maps that show the seen part of ``costmap``."""
    rows, cols = seen_box(costmap)
    corner = costmap.origin_xy_m + costmap.cell_m * np.array([cols.start, rows.start])
    size_m = costmap.cell_m * np.array([cols.stop - cols.start, rows.stop - rows.start])
    # The frames differ by a rotation of a fraction of a degree: exact in the middle of the map,
    # approximate elsewhere.
    middle = np.array([*(corner + 0.5 * size_m), 0.0])
    west, south = (corner + (world_from_odom.apply(middle) - middle)[:2]).tolist()
    zoom = _zoom(rows, cols)
    return MapFrame(
        west_m=west,
        south_m=south,
        pixels_per_m=zoom / costmap.cell_m,
        scale=zoom * (cols.stop - cols.start) / 800.0,
    )


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


def score_colours(view: CostmapView) -> Colours:
    """Returns the colours (rows, cols, 3) RGB of the score that ranks: viridis where a site is
    accepted, over the range of these cells; grey where none is; dark where it is unknown."""
    low, high = _accepted_range(view)
    image = _viridis((view.value - low) / max(high - low, 1e-6))
    known = np.isfinite(view.value)
    refused = known & ~view.allowed
    if refused.any():
        least, most = np.percentile(view.value[refused], (1.0, 99.0))
        share = np.clip((view.value - least) / max(most - least, 1e-6), 0.0, 1.0)
        grey = _DARKEST + (_BRIGHTEST - _DARKEST) * np.nan_to_num(share)
        image[refused] = grey.astype(np.uint8)[refused][:, None]
    image[~known] = _UNKNOWN_RGB
    return image


def _accepted_range(view: CostmapView) -> tuple[float, float]:
    """Least and highest score of accepted ground, but for the lowest fiftieth; (0, 1) without."""
    values = view.value[view.allowed & np.isfinite(view.value)]
    if not values.size:
        return 0.0, 1.0
    return float(np.percentile(values, 2.0)), float(values.max())


def _viridis(share: Float32) -> Colours:
    """(H, W) in [0, 1] to (H, W, 3) RGB."""
    levels = np.nan_to_num(np.clip(share, 0.0, 1.0) * 255.0).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS)[:, :, ::-1]).copy()


def costmap_of(view: LanderView) -> CostmapView:
    """Returns the costmap. Raises ValueError for a view without one."""
    if view.costmap is None:
        raise ValueError("nothing is mapped: there is no costmap to draw")
    return view.costmap


def _maps(costmap: CostmapView) -> tuple[Colours, Colours]:
    """Coloured map and score, (H, W, 3) RGB each."""
    rows, cols = seen_box(costmap)
    score = score_colours(costmap)[rows, cols]
    return enlarged(photo_of(costmap), costmap), enlarged(score, costmap)


def photo_of(costmap: CostmapView) -> Colours:
    """Returns the colours (H, W, 3) of the seen part of the map, south first."""
    rows, cols = seen_box(costmap)
    photo = costmap.rgb[rows, cols].copy()
    photo[~np.isfinite(costmap.total[rows, cols]) & ~photo.any(axis=2)] = _UNKNOWN_RGB
    return photo


def enlarged(source: Colours, costmap: CostmapView) -> Colours:
    """Returns a map of the seen part with whole pixels for a cell, north up."""
    zoom = _zoom(*seen_box(costmap))
    return np.ascontiguousarray(np.repeat(np.repeat(source[::-1], zoom, axis=0), zoom, axis=1))


def _zoom(rows: slice, cols: slice) -> int:
    """Pixels per cell."""
    return max(1, round(_PANEL_PIXELS / max(rows.stop - rows.start, cols.stop - cols.start)))


def _draw_candidates(
    panels: tuple[Colours, Colours], view: LanderView, site_odom: Array | None
) -> None:
    """Draws the candidates into both maps."""
    costmap = costmap_of(view)
    rows, cols = seen_box(costmap)
    zoom, height = _zoom(rows, cols), panels[0].shape[0]
    scale, chosen = panels[0].shape[1] / 800.0, site_odom is not None

    def pixel(position: Array) -> tuple[int, int]:
        col = (position[0] - costmap.origin_xy_m[0]) / costmap.cell_m - cols.start
        row = (position[1] - costmap.origin_xy_m[1]) / costmap.cell_m - rows.start
        return round(col * zoom), round(height - row * zoom)

    spots = [pixel(candidate.position_odom) for candidate in view.candidates]
    for panel in panels:
        for number, (spot, candidate) in enumerate(zip(spots, view.candidates, strict=True)):
            if number or not chosen:
                draw_sign(panel, spot, candidate, round(6 * scale))
        if site_odom is not None:
            draw_winner(panel, pixel(site_odom), round(8 * scale))
        draw_ranks(panel, spots, view.candidates, scale=scale, chosen=chosen)


def _key(frame: MapFrame, view: CostmapView, width: int) -> Colours:
    """The colours of the score and the signs of the candidates."""
    scale = frame.scale
    top, bottom, base = round(6 * scale), round(24 * scale), round(20 * scale)
    strip = np.full((round(34 * scale), width, 3), PAPER, np.uint8)
    low, high = _accepted_range(view)
    at = frame.write(strip, f"score of accepted ground (no unit)  {low:.2f}", 0, base)
    ramp = np.linspace(0.0, 1.0, round(170 * scale), dtype=np.float32)
    at += round(8 * scale)
    strip[top:bottom, at : at + len(ramp)] = np.repeat(_viridis(ramp[None]), bottom - top, axis=0)
    at = frame.write(strip, f"{high:.2f} (best)", at + len(ramp) + round(8 * scale), base)
    for name, rgb in (
        ("refused ground, brighter for a higher score", (_BRIGHTEST,) * 3),
        ("unknown", _UNKNOWN_RGB),
        ("1: the chosen site", CHOSEN_RGB),
        ("accepted", ACCEPTED_RGB),
        ("refused", REFUSED_RGB),
    ):
        at += round(20 * scale)
        strip[top:bottom, at : at + bottom - top] = rgb
        at = frame.write(strip, name, at + bottom - top + round(8 * scale), base)
    return strip
