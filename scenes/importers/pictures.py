"""Images of users: checked by their header, decoded only below a limit, GeoTIFFs in parts."""

import math
import mmap
import re
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from touchdown.scenes.importers.geotiff import check_blocks, opened_tiff
from touchdown.sim.files.opening import MIB, check_file, quiet_libraries

Image = NDArray[np.uint8]

MAX_PIXELS = 1 << 27
"""of an image that is decoded whole, 11 585 x 11 585"""
MAX_FILE_BYTES = 1024 * MIB
MAX_SCANNED_PIXELS = 1 << 31
"""of all scans of a progressive JPEG together: each takes the time of a whole image"""
MAX_PART_PIXELS = 1 << 30
"""of the part of a GeoTIFF"""
SMALLEST = 16
_PART_SIDE = 8192
"""Larger parts of a GeoTIFF are averaged to this side while they are read."""
_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "WEBP")
_GREY = ("1", "L", "LA", "La", "I", "F")
_TILE_SIDES = (322, 323)
"""Tags of a TIFF: a tile is decoded as a whole, however small the image"""
_SCAN = rb"\xff\xda"
"""begins a scan of a JPEG; compressed data never hold these bytes, a thumbnail in it may, once"""
_TIFF_ENDINGS = (".tif", ".tiff")


class Picture(Protocol):
    """An image of which a part can be read."""

    size: NDArray[np.int64]
    """(2,) width and height, pixels"""
    is_tiff: bool

    def part(self, low: NDArray[np.int64], high: NDArray[np.int64]) -> Image:
        """Returns (H, W, 3) RGB from column and row ``low`` to below ``high``."""


def read_rgb(path: Path, *, grey: bool = True, what: str = "an image") -> Image:
    """Returns (H, W, 3) RGB, turned as the camera was held (EXIF). Transparency is dropped.

    Raises FileNotFoundError, and ValueError for a file that is no image, is damaged or cut short,
    has more than `MAX_PIXELS`, more than 8 bits a channel or colours of print (CMYK), or, unless
    ``grey``, no colours.
    """
    from PIL import ImageOps

    with _decoded(path, what) as image, quiet_libraries():
        _check_kind(image, path, grey)
        turned = ImageOps.exif_transpose(image)
        return np.ascontiguousarray(np.asarray(turned.convert("RGB")))


@contextmanager
def opened_picture(path: Path) -> Iterator[Picture]:
    """Yields an aerial image; a GeoTIFF of any size, of which parts are read. Raises as
    `read_rgb`, and ValueError for an image of fewer than `SMALLEST` pixels along a side."""
    check_file(path, "aerial image")
    with ExitStack() as held:
        picture: Picture = (
            _TiffPicture(held.enter_context(opened_tiff(path)), path)
            if path.suffix.lower() in _TIFF_ENDINGS
            else _WholePicture(path)
        )
        if min(picture.size) < SMALLEST:
            width, height = picture.size.tolist()
            raise ValueError(
                f"{path} is not an image of the ground: it has {width} x {height} pixels"
            )
        yield picture


class _WholePicture:
    is_tiff = False

    def __init__(self, path: Path) -> None:
        self._path = path
        with _decoded(path, "aerial image") as image:
            _check_kind(image, path, grey=True)
            size = image.size
            if image.getexif().get(_ORIENTATION, 1) >= 5:  # a quarter turn
                size = size[::-1]
        self.size = np.array(size)

    def part(self, low: NDArray[np.int64], high: NDArray[np.int64]) -> Image:
        image = read_rgb(self._path, what="aerial image")
        return image[low[1] : high[1], low[0] : high[0]]


_ORIENTATION = 0x0112
"""EXIF tag"""


class _TiffPicture:
    is_tiff = True

    def __init__(self, dataset: Any, path: Path) -> None:
        kinds = set(dataset.dtypes)
        if kinds != {"uint8"}:
            raise ValueError(
                f"{path} has {', '.join(sorted(map(str, kinds)))} values; convert it to 8-bit RGB"
            )
        check_blocks(dataset, path)
        self.size = np.array([dataset.width, dataset.height])
        self._dataset, self._path = dataset, path

    def part(self, low: NDArray[np.int64], high: NDArray[np.int64]) -> Image:
        from rasterio.enums import Resampling
        from rasterio.windows import Window

        data = self._dataset
        width, height = (high - low).tolist()
        if width * height > MAX_PART_PIXELS:
            raise ValueError(
                f"{self._path}: the window covers {width} x {height} pixels, more than "
                f"{MAX_PART_PIXELS}; choose a smaller --window, or scale the image down"
            )
        shape = min(height, _PART_SIDE), min(width, _PART_SIDE)
        bands = [1, 2, 3] if data.count >= 3 else [1]
        found = data.read(
            bands,
            window=Window(*low.tolist(), width, height),
            out_shape=(len(bands), *shape),
            resampling=Resampling.average,
        )
        if len(bands) == 3:
            return np.ascontiguousarray(found.transpose(1, 2, 0))
        table = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1)
        if data.colorinterp[0].name == "palette":
            for index, colour in data.colormap(1).items():
                table[index] = colour[:3]
        return np.ascontiguousarray(table[found[0]])


@contextmanager
def _decoded(path: Path, what: str) -> Iterator[Any]:
    """Yields Pillow's image, of which only the header has been read."""
    from PIL import Image as Pillow

    check_file(path, what, MAX_FILE_BYTES)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Pillow.open(path, formats=_FORMATS) as image:
                width, height = image.size
                if width * height > MAX_PIXELS:
                    raise _too_large(path, f"{width} x {height}")
                tags = getattr(image, "tag_v2", {})  # of a TIFF
                tile = math.prod(int(tags.get(tag, 0)) for tag in _TILE_SIDES)
                if tile > MAX_PIXELS:
                    raise _too_large(path, f"tiles of {tile}")
                if image.format == "JPEG":
                    _check_scans(path, width * height)
                yield image
    except Pillow.DecompressionBombError as error:
        count = re.search(r"\d+", str(error))
        raise _too_large(path, count.group() if count else "too many") from None
    except Pillow.UnidentifiedImageError:
        raise ValueError(
            f"{path} is not an image that can be read; give a PNG, JPEG or TIFF"
        ) from None
    except ValueError:
        raise
    except Exception as error:  # decoders raise errors of many kinds for damaged data
        if isinstance(error, OSError) and error.errno:
            raise
        reason = " ".join(str(error).split()) or "damaged data"
        raise ValueError(f"{path} is a damaged image, copy or export it anew ({reason})") from error


def _too_large(path: Path, pixels: str) -> ValueError:
    return ValueError(
        f"{path} has {pixels} pixels, more than {MAX_PIXELS}; scale it down, or cut it in parts"
    )


def _check_scans(path: Path, pixels: int) -> None:
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        scans = sum(1 for _ in re.finditer(_SCAN, data))
    if scans * pixels > MAX_SCANNED_PIXELS:
        raise ValueError(
            f"{path} has {scans} scans of {pixels} pixels, more than {MAX_SCANNED_PIXELS} pixels "
            "together; save it with fewer, or not as a progressive JPEG"
        )


def _check_kind(image: Any, path: Path, grey: bool) -> None:
    """ValueError: more than 8 bits a channel, colours of print, or none."""
    bits = _bits(image)
    if bits > 8:
        raise ValueError(f"'{path}' has {bits} bits a channel: convert it to 8-bit RGB")
    if image.mode == "CMYK":
        raise ValueError(f"'{path}' has colours of print (CMYK): convert it to 8-bit RGB")
    if not grey and image.mode in _GREY:
        raise ValueError(f"'{path}' is grey: ground classification needs colour, 8-bit RGB")


def _bits(image: Any) -> int:
    """Bits of a channel in the file, which Pillow's mode does not give for colours."""
    if image.mode.startswith(("I", "F")):
        return 32 if image.mode in ("I", "F") else 16
    for tile in image.tile:
        if re.search(r";16|;32", str(tile[3])):
            return 16
    return 8
