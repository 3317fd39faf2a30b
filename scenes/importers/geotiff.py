"""Height rasters from GeoTIFF files, read by GDAL through rasterio."""

import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.sim.files.opening import check_file

Array = NDArray[np.float64]

PART_CELLS, FINE_CELLS = 4096, 6144
"""Rows and columns up to which a file is read whole, and up to which cells are kept as they are."""
MAX_PART_CELLS = 1 << 28
COARSEST_M = 1000.0
MAX_BLOCK_BYTES = 1 << 29
_MARGIN_CELLS = 16
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
_ENVIRONMENT = {"GDAL_CACHEMAX": 256, "CPL_VSIL_CURL_ALLOWED_FILENAME": "none"}
"""Megabytes of blocks that are kept; nothing is fetched from a network."""
_NEIGHBOURS = (".msk", ".MSK", ".ovr", ".OVR")
"""Endings of files beside a TIFF that GDAL opens with it, by whichever driver knows them."""
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
    """Heights of a part of a file: row 0 is its northern edge, values hold at centres of cells."""

    heights_m: Array
    """(rows, cols), NaN where the file has none"""
    cell_m: Array
    """(2,) cell size eastwards and northwards"""
    georeference: Georeference
    """of the whole file"""
    metres_per_unit: Array
    """(2,) metres per unit of the file's coordinates, eastwards and northwards"""
    size_m: Array
    """(2,) width and height of the whole file"""
    corner_m: Array
    """(2,) offset, east and south, of the part's north-west corner from that of the file"""


def read_heights(
    path: Path, centre_m: tuple[float, float] | None = None, side_m: float = 0.0
) -> HeightRaster:
    """Reads a single-band raster of heights, or of a large one the part that is needed; without
    geographic tags a cell is 1 m.

    Of a file of more than `PART_CELLS` rows or columns a part of that many is read around
    ``centre_m`` (metres east and north of the south-west corner) or the middle; a larger one where
    ``side_m`` asks for it. The cells of a part of more than `FINE_CELLS` are averaged.

    Coordinates in degrees and feet are converted to metres; the nodata value, masks, -9999 and
    values beyond 20 km become NaN. Raises FileNotFoundError, or ValueError for a file that is no
    TIFF, is damaged or compressed in a way that this GDAL cannot read, has more than one band or
    complex values, is stored in blocks above `MAX_BLOCK_BYTES`, is turned against north, and for a
    part of more than `MAX_PART_CELLS`.
    """
    with opened_tiff(path) as dataset:
        _check_layout(dataset, path)
        reference = _georeference(dataset, path)
        metres = _metres_per_coordinate(dataset, reference)
        cell = reference.unit_cell * metres
        if not ((cell > 0.0) & (cell <= COARSEST_M)).all():
            raise ValueError(
                f"{path} has cells of {cell[0]:.3g} x {cell[1]:.3g} m; they must be above 0 and at "
                f"most {COARSEST_M:g} m"
            )
        rows, cols = _part(dataset, cell, centre_m, side_m)
        if len(rows) * len(cols) > MAX_PART_CELLS:
            raise ValueError(
                f"{path}: the window covers {len(cols)} x {len(rows)} cells, more than "
                f"{MAX_PART_CELLS}; choose a smaller --window, or a coarser model (gdal_translate "
                "-tr)"
            )
        factor = -(-max(len(rows), len(cols)) // FINE_CELLS)
        heights = _read_part(dataset, rows, cols) if factor == 1 else _averaged(
            dataset, rows, cols, factor
        )  # fmt: skip
        return HeightRaster(
            heights_m=heights,
            cell_m=factor * cell,
            georeference=reference,
            metres_per_unit=metres,
            size_m=np.array([dataset.width, dataset.height]) * cell,
            corner_m=np.array([cols.start, rows.start]) * cell,
        )


def _check_layout(dataset: Any, path: Path) -> None:
    """ValueError: more bands than one, complex values, blocks that fill the memory."""
    if dataset.count != 1:
        raise ValueError(
            f"{path} has {dataset.count} bands; an elevation model has one band of heights"
        )
    kind = str(dataset.dtypes[0])
    if kind.startswith("complex"):
        raise ValueError(f"{path} has {kind} values; heights are real numbers")
    check_blocks(dataset, path)


def check_blocks(dataset: Any, path: Path) -> None:
    """Raises ValueError where a block, which is read as a whole, is above `MAX_BLOCK_BYTES`."""
    size = max(
        rows * cols * np.dtype(kind if kind != "complex_int16" else "c8").itemsize
        for (rows, cols), kind in zip(dataset.block_shapes, dataset.dtypes, strict=True)
    )
    if size > MAX_BLOCK_BYTES:
        raise ValueError(
            f"{path} is stored in blocks of {size >> 20} MiB, more than {MAX_BLOCK_BYTES >> 20} "
            "MiB; rewrite it in tiles (gdal_translate -co TILED=YES)"
        )


def _part(
    dataset: Any, cell: Array, centre_m: tuple[float, float] | None, side_m: float
) -> tuple[range, range]:
    """Rows and columns to be read."""
    middle = [0.5 * dataset.height, 0.5 * dataset.width]
    if centre_m is not None and np.isfinite(centre_m).all():
        middle = [dataset.height - centre_m[1] / cell[1], centre_m[0] / cell[0]]
    wanted = np.nan_to_num(side_m / cell[::-1], nan=0.0, posinf=1e9) + _MARGIN_CELLS
    spans = []
    for axis, length in enumerate((dataset.height, dataset.width)):
        size = min(length, max(PART_CELLS, int(min(wanted[axis], 1e9))))
        first = int(np.clip(middle[axis] - 0.5 * size, 0, length - size))
        spans.append(range(first, first + size))
    return spans[0], spans[1]


def _read_part(dataset: Any, rows: range, cols: range) -> Array:
    """(rows, cols) heights in metres, NaN for holes."""
    from rasterio.windows import Window

    window = Window(cols.start, rows.start, len(cols), len(rows))
    stored = dataset.read(1, masked=True, window=window)
    heights = stored.data.astype(np.float64)
    hole = np.ma.getmaskarray(stored) | (heights == -9999.0)
    with np.errstate(over="ignore", invalid="ignore"):
        heights = heights * dataset.scales[0] + dataset.offsets[0]
        hole |= ~(np.abs(heights) <= _ABSURD_M)
        heights *= _METRES_PER_VERTICAL_UNIT.get(dataset.units[0], 1.0)
    heights[hole] = np.nan
    return np.asarray(heights, np.float64)


def _averaged(dataset: Any, rows: range, cols: range, factor: int) -> Array:
    """Means over squares of ``factor`` cells, of those that hold a height; what is left over at the
    southern and eastern edge is dropped."""
    wide = len(cols) // factor
    means = np.full((len(rows) // factor, wide), np.nan)
    for row in range(len(means)):
        first = rows.start + row * factor
        strip = _read_part(
            dataset, range(first, first + factor), range(cols.start, cols.start + wide * factor)
        )
        squares = strip.reshape(factor, wide, factor)
        known = np.isfinite(squares)
        count = known.sum(axis=(0, 2))
        total = np.where(known, squares, 0.0).sum(axis=(0, 2))
        means[row] = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return means


def read_georeference(path: Path) -> Georeference:
    """Reads the position of a TIFF of any kind. Raises ValueError as `read_heights`."""
    with opened_tiff(path) as dataset:
        return _georeference(dataset, path)


@contextmanager
def opened_tiff(path: Path) -> Iterator[Any]:
    """Yields the file as a rasterio dataset. Raises FileNotFoundError, and ValueError for a file
    that is not a TIFF or is damaged.

    Only a file of this machine is opened, by one driver: GDAL itself would take the name of an
    archive or an address, or a file (VRT) that leads to others.
    """
    import rasterio

    if str(path).startswith(("/vsi", "\\vsi")) or re.match(r"\w+:/", str(path)):
        raise ValueError(
            f"'{path}' is no file of this machine: download or unpack it first, and give the file"
        )
    check_file(path, "elevation model")
    with path.open("rb") as file:
        signature = file.read(4)
    for beside in (path.with_name(path.name + ending) for ending in _NEIGHBOURS):
        if beside.exists():
            check_file(beside, "the mask or overview of an elevation model")
            with beside.open("rb") as file:
                if file.read(4) not in _SIGNATURES:
                    raise ValueError(f"{beside} is not a TIFF file; remove it")
    if signature not in _SIGNATURES:
        raise ValueError(f"{path} is not a TIFF file; give an elevation model as GeoTIFF (.tif)")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            with (
                rasterio.Env(**_ENVIRONMENT),
                rasterio.open(path.resolve(), driver="GTiff") as dataset,
            ):
                yield dataset
    except (rasterio.errors.RasterioError, MemoryError) as error:
        reason = " ".join(str(error.__cause__ or error).split())
        codec = re.search(r"missing codec (\w+)|(\w+) compression support is not", reason)
        if codec:
            name = codec.group(1) or codec.group(2)
            raise ValueError(
                f"{path} is compressed by {name}, which this GDAL cannot read; rewrite it "
                "(gdal_translate -co COMPRESS=DEFLATE)"
            ) from error
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
