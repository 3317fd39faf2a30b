"""Height rasters from GeoTIFF files, read by GDAL through rasterio."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MAX_CELLS = 2**30
METRES_PER_DEGREE = 111_132.95
"""Of latitude, mean; of longitude times its cosine."""
_METRES_PER_VERTICAL_UNIT = {
    "foot": 0.3048,
    "ft": 0.3048,
    "US survey foot": 1200.0 / 3937.0,
    "ftUS": 1200.0 / 3937.0,
}
_SIGNATURES = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
"""First bytes of classic and BigTIFF files of both byte orders."""
_ABSURD_M = 20_000.0
"""No ground is that high or deep: such values mark missing data."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Georeference:
    """Position of a north-up raster in its coordinate system."""

    unit_cell: Array
    """(2,) cell size eastwards and northwards in the file's coordinates, 1 without tags"""
    origin: Array | None = None
    """(2,) the file's coordinates of the outer north-west corner, None where it has none"""


@dataclass(frozen=True, kw_only=True, slots=True)
class HeightRaster:
    """Heights as in the file: row 0 is the northern edge, values hold at the cells' centres."""

    heights_m: Array
    """(rows, cols), NaN where the file has none"""
    cell_m: Array
    """(2,) cell size eastwards and northwards"""
    georeference: Georeference


def read_heights(path: Path) -> HeightRaster:
    """Reads a single-band raster of heights; without geographic tags a cell is 1 m.

    Coordinates in degrees and feet are converted to metres; the nodata value, masks, -9999 and
    values beyond 20 km become NaN. Raises FileNotFoundError, or ValueError for a file that is no
    TIFF, is damaged, has more than one band or 2^30 cells, or is turned against north.
    """
    if not path.is_file():
        raise FileNotFoundError(f"elevation model not found: {path}")
    with _opened(path) as dataset:
        if dataset.count != 1:
            raise ValueError(
                f"{path} has {dataset.count} bands; an elevation model has one band of heights"
            )
        if dataset.width * dataset.height > MAX_CELLS:
            raise ValueError(
                f"{path} has {dataset.width} x {dataset.height} cells, more than {MAX_CELLS}; "
                "cut out a part first (gdal_translate -srcwin)"
            )
        reference = _georeference(dataset, path)
        stored = dataset.read(1, masked=True)
        heights = stored.data.astype(np.float64)
        hole = np.ma.getmaskarray(stored) | (heights == -9999.0)
        heights = heights * dataset.scales[0] + dataset.offsets[0]
        hole |= ~np.isfinite(heights) | (np.abs(heights) > _ABSURD_M)
        heights *= _METRES_PER_VERTICAL_UNIT.get(dataset.units[0], 1.0)
        cell = reference.unit_cell * _metres_per_coordinate(dataset, reference)
    heights[hole] = np.nan
    return HeightRaster(heights_m=heights, cell_m=cell, georeference=reference)


def read_georeference(path: Path) -> Georeference:
    """Reads the position of a TIFF of any kind. Raises ValueError as `read_heights`."""
    with _opened(path) as dataset:
        return _georeference(dataset, path)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The file as a rasterio dataset. ValueError: not a TIFF, or damaged."""
    import rasterio

    with path.open("rb") as file:
        signature = file.read(4)
    if signature not in _SIGNATURES:
        raise ValueError(f"{path} is not a TIFF file; give an elevation model as GeoTIFF (.tif)")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            with rasterio.open(path, driver="GTiff") as dataset:
                yield dataset
    except rasterio.errors.RasterioError as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"{path} is a damaged TIFF file; export it anew ({reason})") from error


def _georeference(dataset: Any, path: Path) -> Georeference:
    """ValueError: turned against north, or cells of no positive size."""
    transform = dataset.transform
    if transform.is_identity:
        return Georeference(unit_cell=np.ones(2))
    if transform.b or transform.d:
        raise ValueError(f"{path} is turned against north; warp it to north up first")
    size = np.array([transform.a, -transform.e])
    if not (np.isfinite(size).all() and (size > 0.0).all()):
        raise ValueError(f"{path} has cells of size {size.tolist()}; it must be positive")
    return Georeference(unit_cell=size, origin=np.array([transform.c, transform.f]))


def _metres_per_coordinate(dataset: Any, reference: Georeference) -> Array:
    """(2,) metres per unit of the file's coordinates, eastwards and northwards."""
    if dataset.crs is None:
        return np.ones(2)
    if dataset.crs.is_geographic:
        top = 0.0 if reference.origin is None else float(reference.origin[1])
        latitude = top - 0.5 * dataset.height * float(reference.unit_cell[1])
        return METRES_PER_DEGREE * np.array([np.cos(np.deg2rad(latitude)), 1.0])
    factor = dataset.crs.linear_units_factor[1] if dataset.crs.is_projected else 1.0
    return np.full(2, factor)
