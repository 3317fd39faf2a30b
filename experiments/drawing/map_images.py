"""What is drawn of maps: coloured points and PLY files of them, take-off and survey."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import GridMap
from touchdown.landing.api import SurveyParams
from touchdown.landing.mission.waypoints import survey_waypoints
from touchdown.sim.frames import Pose, rotation_from_yaw
from touchdown.sim.typing import Array

Points = NDArray[np.float32]
Colours = NDArray[np.uint8]

_VERTEX = np.dtype(
    [(name, "<f4") for name in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")]
)


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


def transform_points(pose: Pose, points: Points) -> Points:
    """(N, 3) float32 through a pose."""
    return (points @ pose.rotation.T.astype(np.float32)) + pose.translation.astype(np.float32)


@dataclass(frozen=True, kw_only=True, slots=True)
class Marks:
    """Take-off and survey of a flight on a map, world frame."""

    takeoff_xy_m: Array
    """(2,)"""
    yaw: float
    """heading of the take-off, rad"""
    path_xy_m: Array
    """(N, 2) rectangle of the legs of a serpentine, closed; else the waypoints from the take-off
    on"""


def survey_marks(takeoff_xy_m: Array, yaw: float, survey: SurveyParams) -> Marks:
    """Marks of a survey from a take-off point at the heading ``yaw``, rad."""
    path = np.vstack([np.zeros(3), survey_waypoints(yaw, survey)])[:, :2]
    if survey.is_serpentine:
        length, width = survey.leg_length_m, (survey.legs - 1) * survey.leg_spacing_m
        box = np.array([[0, 0], [length, 0], [length, width], [0, width], [0, 0]])
        path = box @ rotation_from_yaw(yaw)[:2, :2].T
    return Marks(takeoff_xy_m=takeoff_xy_m, yaw=yaw, path_xy_m=takeoff_xy_m + path)
