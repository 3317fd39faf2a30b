"""Height rasters from GeoTIFF files: pixels by OpenCV, the few tags that matter read here."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# OGC GeoTIFF standard 1.1, annex G; GDAL's own tag for holes.
PIXEL_SCALE, TIEPOINT, TRANSFORMATION, GEO_KEYS, NODATA = 33550, 33922, 34264, 34735, 42113
MODEL_TYPE_KEY, LINEAR_UNITS_KEY, VERTICAL_UNITS_KEY = 1024, 3076, 4099
GEOGRAPHIC = 2
METRES_PER_UNIT = {9001: 1.0, 9002: 0.3048, 9003: 1200.0 / 3937.0}
METRES_PER_DEGREE = 111_132.95
"""Of latitude, mean; of longitude times its cosine."""
_FORMATS = {1: "B", 2: "s", 3: "H", 4: "I", 5: "II", 6: "b", 8: "h", 9: "i", 11: "f", 12: "d",
            13: "I", 16: "Q", 17: "q", 18: "Q"}  # fmt: skip
_ABSURD_M = 20_000.0
"""No ground is that high or deep: what lies beyond is a mark for "no data"."""

Tags = dict[int, tuple[float, ...] | str]


@dataclass(frozen=True, kw_only=True, slots=True)
class HeightRaster:
    """Heights as in the file: row 0 is the northern edge, values hold at the cells' centres."""

    heights_m: Array
    """(rows, cols), NaN where the file has none"""
    cell_m: Array
    """(2,) cell size eastwards and northwards"""
    origin: Array | None
    """(2,) the file's coordinates of the outer north-west corner, None where it has none"""
    unit_cell: Array
    """(2,) cell size in the file's own coordinates, from which `origin` counts"""


def read_heights(path: Path) -> HeightRaster:
    """Reads a single-band raster of heights; without geographic tags a cell is 1 m.

    Coordinates in degrees and feet are turned into metres. Raises FileNotFoundError, or ValueError
    for what is no TIFF, has more than one band, is empty, or is turned against north.
    """
    if not path.is_file():
        raise FileNotFoundError(f"elevation model not found: {path}")
    tags = read_tags(path)
    with _silent():
        pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.size == 0:
        raise ValueError(f"{path} is a TIFF without pixels that can be read; export it anew")
    if pixels.ndim != 2:
        raise ValueError(
            f"{path} has {pixels.shape[2]} bands; an elevation model has one band of heights"
        )
    unit_cell = cell_size(tags, path)
    cell = unit_cell * _metres_per_coordinate(tags, unit_cell, pixels.shape[0])
    heights = pixels.astype(np.float64)
    hole = ~np.isfinite(heights) | (np.abs(heights) > _ABSURD_M) | (heights == -9999.0)
    nodata = _number(tags.get(NODATA))
    if nodata is not None:
        hole |= heights == nodata
    heights *= METRES_PER_UNIT.get(_geo_key(tags, VERTICAL_UNITS_KEY), 1.0)
    heights[hole] = np.nan
    return HeightRaster(
        heights_m=heights, cell_m=cell, origin=corner(tags, unit_cell), unit_cell=unit_cell
    )


def read_tags(path: Path) -> Tags:
    """The tags of a TIFF's first image (classic or BigTIFF). ValueError: not a TIFF."""
    data = path.read_bytes()
    order = {b"II": "<", b"MM": ">"}.get(data[:2])
    version = struct.unpack_from(f"{order}H", data, 2)[0] if order and len(data) > 16 else 0
    if order is None or version not in (42, 43):
        raise ValueError(f"{path} is not a TIFF file; give an elevation model as GeoTIFF (.tif)")
    big = version == 43
    try:
        start = struct.unpack_from(f"{order}{'Q' if big else 'I'}", data, 8 if big else 4)[0]
        count = struct.unpack_from(f"{order}{'Q' if big else 'H'}", data, start)[0]
        first, step = start + (8 if big else 2), 20 if big else 12
        entries = [_entry(data, order, big, first + step * index) for index in range(count)]
    except struct.error as error:
        raise ValueError(f"{path} is a damaged TIFF file: it ends too early") from error
    return {tag: value for tag, value in entries if value}


def _entry(data: bytes, order: str, big: bool, at: int) -> tuple[int, tuple[float, ...] | str]:
    tag, kind, count = struct.unpack_from(f"{order}HH{'Q' if big else 'I'}", data, at)
    wanted = (PIXEL_SCALE, TIEPOINT, TRANSFORMATION, GEO_KEYS, NODATA)
    code = _FORMATS.get(kind)
    if code is None or tag not in wanted:
        return tag, ()
    layout = f"{order}{count}{code}"
    place = at + (12 if big else 8)
    if struct.calcsize(layout) > (8 if big else 4):
        place = struct.unpack_from(f"{order}{'Q' if big else 'I'}", data, place)[0]
    values = struct.unpack_from(layout, data, place)
    if kind == 2:
        return tag, values[0].split(b"\0")[0].decode("ascii", "replace").strip()
    return tag, values


def cell_size(tags: Tags, path: Path) -> Array:
    """(2,) cell size in the file's coordinates, 1 without tags. ValueError: turned, or not
    positive."""
    scale, matrix = tags.get(PIXEL_SCALE), tags.get(TRANSFORMATION)
    if isinstance(matrix, tuple) and len(matrix) == 16:
        if matrix[1] or matrix[4]:
            raise ValueError(f"{path} is turned against north; warp it to north up first")
        scale = (matrix[0], -matrix[5])
    size = np.array(scale[:2] if isinstance(scale, tuple) else (1.0, 1.0), np.float64)
    if size.shape != (2,) or not (np.isfinite(size).all() and (size > 0.0).all()):
        raise ValueError(f"{path} has cells of size {size.tolist()}; it must be positive")
    return size


def corner(tags: Tags, unit_cell: Array) -> Array | None:
    """(2,) the file's coordinates of the outer north-west corner, None without tags."""
    tie, matrix = tags.get(TIEPOINT), tags.get(TRANSFORMATION)
    if isinstance(matrix, tuple) and len(matrix) == 16:
        return np.array([matrix[3], matrix[7]])
    if isinstance(tie, tuple) and len(tie) >= 6:
        return np.array(tie[3:5]) + np.array([-1.0, 1.0]) * unit_cell * np.array(tie[:2])
    return None


def _metres_per_coordinate(tags: Tags, unit_cell: Array, rows: int) -> Array:
    """(2,) metres per unit of the file's coordinates, eastwards and northwards."""
    if _geo_key(tags, MODEL_TYPE_KEY) == GEOGRAPHIC:
        top = corner(tags, unit_cell)
        latitude = 0.0 if top is None else float(top[1]) - 0.5 * rows * float(unit_cell[1])
        return METRES_PER_DEGREE * np.array([np.cos(np.deg2rad(latitude)), 1.0])
    return np.full(2, METRES_PER_UNIT.get(_geo_key(tags, LINEAR_UNITS_KEY), 1.0))


def _geo_key(tags: Tags, key: int) -> int:
    """The value of a GeoKey that is kept in the directory itself, 0 where it is missing."""
    directory = tags.get(GEO_KEYS, ())
    if isinstance(directory, tuple):
        for at in range(4, len(directory) - 3, 4):
            if directory[at] == key and directory[at + 1] == 0:
                return int(directory[at + 3])
    return 0


def _number(text: tuple[float, ...] | str | None) -> float | None:
    try:
        return float(text) if isinstance(text, str) else None
    except ValueError:
        return None


@contextmanager
def _silent() -> Iterator[None]:
    """Without OpenCV's remark on every geographic tag."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)
