"""Maps and costmaps as files: PLY clouds and PNG images."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import GridMap
from touchdown.experiments.drawing.map_axes import PAPER, MapFrame, Marks
from touchdown.landing.api import Candidate, CostmapView
from touchdown.sim.frames import Pose

Array = NDArray[np.float64]
Points = NDArray[np.float32]
Colours = NDArray[np.uint8]

_UNKNOWN_BGR = (38, 32, 30)
_CHOSEN_BGR = (80, 255, 80)
_ACCEPTED_BGR = (255, 230, 120)
_REFUSED_BGR = (80, 80, 255)
_PANEL_PIXELS = 1200
_MARGIN_CELLS = 8
_VERTEX = np.dtype(
    [(name, "<f4") for name in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")]
)
_LABEL_PIXELS = 66
_CAPTION = "x east, y north (m, world); white circle: take-off; dashed: the survey's legs"


def map_points(
    grid: GridMap, rows: slice = slice(None), cols: slice = slice(None)
) -> tuple[Points, Colours]:
    """Occupied cells of a part of the map: (N, 3) points in the odom frame, (N, 3) RGB. A cell that
    no image covered is grey by its LIDAR intensity."""
    row, col = np.nonzero(grid.count[rows, cols] > 0)
    row_start, col_start = rows.start or 0, cols.start or 0
    x = grid.origin_xy_m[0] + (col + col_start + 0.5) * grid.cell_m
    y = grid.origin_xy_m[1] + (row + row_start + 0.5) * grid.cell_m
    z = grid.height_m[rows, cols][row, col]
    rgb = grid.rgb[rows, cols][row, col]
    grey = np.clip(grid.intensity[rows, cols][row, col], 0.0, 100.0)[:, None]
    rgb = np.where(np.isfinite(rgb), rgb, 30.0 + 1.5 * np.nan_to_num(grey))
    keep = np.isfinite(z)
    points = np.column_stack([x, y, z]).astype(np.float32)[keep]
    return points, np.clip(rgb, 0.0, 255.0).astype(np.uint8)[keep]


def write_ply(path: Path, points: Points, colours: Colours) -> None:
    """Binary little-endian PLY: points (N, 3) metres, colours (N, 3) RGB."""
    from plyfile import PlyData, PlyElement

    rows = np.empty(len(points), dtype=_VERTEX)
    for column, name in enumerate(_VERTEX.names or ()):
        rows[name] = points[:, column] if column < 3 else colours[:, column - 3]
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(path)


def costmap_image(
    view: CostmapView, candidates: tuple[Candidate, ...], site_odom: Array | None
) -> Colours:
    """The coloured map beside the total cost, north up, with every candidate: (H, W, 3) RGB."""
    panels = _panels(view, candidates, site_odom)
    gap = np.full((panels[0].shape[0], 12, 3), 255, np.uint8)
    return np.hstack([panels[0], gap, panels[1]])


def _panels(
    view: CostmapView, candidates: tuple[Candidate, ...], site_odom: Array | None
) -> list[Colours]:
    """Map and total cost, (H, W, 3) RGB each."""
    rows, cols = seen_box(view)
    zoom = _zoom(rows, cols)
    photo = view.rgb[rows, cols, ::-1].copy()
    photo[~np.isfinite(view.total[rows, cols]) & ~photo.any(axis=2)] = _UNKNOWN_BGR
    panels: list[Colours] = []
    for source in (photo, _coloured(view.total[rows, cols])):
        panel = np.repeat(np.repeat(source[::-1], zoom, axis=0), zoom, axis=1)
        _draw_candidates(panel, view, rows, cols, zoom, candidates, site_odom)
        panels.append(np.ascontiguousarray(panel[:, :, ::-1]))
    return panels


def _zoom(rows: slice, cols: slice) -> int:
    """Pixels per cell."""
    return max(1, round(_PANEL_PIXELS / max(rows.stop - rows.start, cols.stop - cols.start)))


def write_costmap(
    path: Path,
    view: CostmapView,
    candidates: tuple[Candidate, ...],
    site_odom: Array | None,
    world_from_odom: Pose,
    marks: Marks,
) -> None:
    """Writes the image of `costmap_image` with ticks in metres of the world frame, take-off
    point, the survey's rectangle and a key of its colours."""
    rows, cols = seen_box(view)
    panels = _panels(view, candidates, site_odom)
    corner = view.origin_xy_m + view.cell_m * np.array([cols.start, rows.start])
    size_m = view.cell_m * np.array([cols.stop - cols.start, rows.stop - rows.start])
    # The frames differ by a rotation of a fraction of a degree: exact in the middle of the map,
    # approximate elsewhere.
    middle = np.array([*(corner + 0.5 * size_m), 0.0])
    west, south = (corner + (world_from_odom.apply(middle) - middle)[:2]).tolist()
    scale = panels[0].shape[1] / 800.0
    frame = MapFrame(
        west_m=west, south_m=south, pixels_per_m=_zoom(rows, cols) / view.cell_m, scale=scale
    )
    for panel in panels:
        frame.draw_marks(panel, marks)
    image = frame.around(panels, _CAPTION)
    image = frame.below(image, _key(frame, image.shape[1]))
    if not cv2.imwrite(str(path), cv2.cvtColor(image, cv2.COLOR_RGB2BGR)):
        raise OSError(f"{path} cannot be written")


def _key(frame: MapFrame, width: int) -> Colours:
    """The colours of the cost and of the candidates' circles."""
    scale = frame.scale
    top, bottom, base = round(6 * scale), round(24 * scale), round(20 * scale)
    strip = np.full((round(34 * scale), width, 3), PAPER, np.uint8)
    at = frame.write(strip, "C_sum 0", 0, base) + round(8 * scale)
    ramp = np.linspace(0.0, 1.0, round(150 * scale), dtype=np.float32)
    colours = np.repeat(_coloured(ramp[None])[:, :, ::-1], bottom - top, axis=0)
    strip[top:bottom, at : at + len(ramp)] = colours
    at = frame.write(strip, "1 (best)", at + len(ramp) + round(8 * scale), base)
    for name, bgr in (
        ("unknown", _UNKNOWN_BGR),
        ("chosen site", _CHOSEN_BGR),
        ("candidate and its score", _ACCEPTED_BGR),
        ("refused", _REFUSED_BGR),
    ):
        at += round(22 * scale)
        strip[top:bottom, at : at + bottom - top] = bgr[::-1]
        at = frame.write(strip, name, at + bottom - top + round(8 * scale), base)
    return strip


def transform_points(pose: Pose, points: Points) -> Points:
    """(N, 3) float32 through a pose."""
    return (points @ pose.rotation.T.astype(np.float32)) + pose.translation.astype(np.float32)


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


def _coloured(total: NDArray[np.float32]) -> Colours:
    """(H, W) in [0, 1], higher is better, to (H, W, 3) BGR; unknown cells dark."""
    scaled = np.nan_to_num(np.clip(total, 0.0, 1.0) * 255.0).astype(np.uint8)
    image = cv2.applyColorMap(scaled, cv2.COLORMAP_VIRIDIS)
    image[~np.isfinite(total)] = _UNKNOWN_BGR
    return image


def _draw_candidates(
    panel: Colours,
    view: CostmapView,
    rows: slice,
    cols: slice,
    zoom: int,
    candidates: tuple[Candidate, ...],
    site_odom: Array | None,
) -> None:
    def pixel(position: Array) -> tuple[int, int]:
        col = (position[0] - view.origin_xy_m[0]) / view.cell_m - cols.start
        row = (position[1] - view.origin_xy_m[1]) / view.cell_m - rows.start
        return round(col * zoom), round(panel.shape[0] - row * zoom)

    metre, scale = zoom / view.cell_m, panel.shape[0] / 700.0
    radius, width = max(5, round(0.6 * metre)), max(2, round(2 * scale))
    for number, candidate in reversed(list(enumerate(candidates, start=1))):
        centre = pixel(candidate.position_odom)
        colour = _ACCEPTED_BGR if candidate.accepted else _REFUSED_BGR
        cv2.circle(panel, centre, radius, colour, width, cv2.LINE_AA)
        label = f"{number}: {candidate.score:.2f}"
        left, room = centre[0] + radius + 3, round(_LABEL_PIXELS * scale)
        if left + room > panel.shape[1]:
            left = centre[0] - radius - 3 - room
        _text(panel, label, (left, centre[1] + round(5 * scale)), colour, scale)
    if site_odom is not None:
        centre = pixel(site_odom)
        cv2.circle(panel, centre, max(12, round(1.5 * metre)), _CHOSEN_BGR, width + 1, cv2.LINE_AA)
        cv2.drawMarker(
            panel, centre, _CHOSEN_BGR, cv2.MARKER_CROSS, round(14 * scale), width, cv2.LINE_AA
        )


def _text(
    panel: Colours,
    text: str,
    corner: tuple[int, int],
    colour: tuple[int, int, int],
    scale: float,
) -> None:
    """Text with a dark rim, legible on any ground."""
    rim = max(1, round(scale))
    for dx, dy, shade in (
        (-rim, 0, (0, 0, 0)),
        (rim, 0, (0, 0, 0)),
        (0, -rim, (0, 0, 0)),
        (0, rim, (0, 0, 0)),
        (0, 0, colour),
    ):
        anchor = (corner[0] + dx, corner[1] + dy)
        cv2.putText(
            panel, text, anchor, cv2.FONT_HERSHEY_SIMPLEX, 0.5 * scale, shade, 1, cv2.LINE_AA
        )
