"""Reading of image files of users, and writing of images."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.errors import usage_errors
from touchdown.experiments.io.run_directory import whole_file
from touchdown.scenes.importers.pictures import read_rgb

Picture = NDArray[np.uint8]


def read_picture(path: Path) -> Picture:
    """(H, W, 3) uint8 RGB, turned as the camera was held. Transparency is dropped.

    Raises UsageError for a file that is no picture, is damaged or too large, and for a grey or a
    16-bit one: colour is half of what distinguishes ground, and what the levels of 16 bits mean
    differs from camera to camera.
    """
    return np.asarray(usage_errors(lambda: read_rgb(path, grey=False, what="image")), np.uint8)


def squared(picture: Picture, pixels: int) -> Picture:
    """(pixels, pixels, 3): the largest square in the middle, scaled."""
    side = min(picture.shape[:2])
    top, left = (picture.shape[0] - side) // 2, (picture.shape[1] - side) // 2
    square = picture[top : top + side, left : left + side]
    way = cv2.INTER_AREA if side >= pixels else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(square, (pixels, pixels), interpolation=way), np.uint8)


def write_png(path: Path, rgb: Picture) -> None:
    """Writes (H, W, 3) RGB; the same image gives the same bytes. Raises OSError."""
    done, data = cv2.imencode(".png", rgb[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 6])
    if not done:
        raise OSError(f"'{path}' cannot be written")
    with whole_file(path) as partial:
        partial.write_bytes(data.tobytes())
