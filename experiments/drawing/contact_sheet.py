"""Contact sheet of many scenes: one row of small images per scene."""

from collections.abc import Mapping

import cv2
import numpy as np

from touchdown.sim.typing import Image

SHEET_VIEWS = ("above", "oblique", "camera", "depth", "lidar", "height", "class", "safe")
_ROW_PIXELS = 230
_GAP_PIXELS = 8
_TITLE_PIXELS = 34
_PAPER, _INK = 255, (30, 30, 30)


def thumbnails(images: Mapping[str, Image]) -> dict[str, Image]:
    """Small views of one scene for the sheet, so that many scenes fit into memory."""
    return {view: _fit(images[view]) for view in SHEET_VIEWS}


def contact_sheet(scenes: Mapping[str, Mapping[str, Image]]) -> Image:
    """(H, W, 3) RGB of the `thumbnails` by scene name; columns line up, the top row names them."""
    widths = [max(views[view].shape[1] for views in scenes.values()) for view in SHEET_VIEWS]
    lefts = np.cumsum([_GAP_PIXELS, *(width + _GAP_PIXELS for width in widths)])
    header = np.full((_TITLE_PIXELS, lefts[-1], 3), _PAPER, np.uint8)
    for view, left in zip(SHEET_VIEWS, lefts, strict=False):
        _write(header, view, left, 0.55)
    bands = [header]
    for name, views in scenes.items():
        band = np.full((_TITLE_PIXELS + _ROW_PIXELS + _GAP_PIXELS, lefts[-1], 3), _PAPER, np.uint8)
        _write(band, name, _GAP_PIXELS, 0.75)
        for view, left in zip(SHEET_VIEWS, lefts, strict=False):
            height, width = views[view].shape[:2]
            top = _TITLE_PIXELS + (_ROW_PIXELS - height) // 2
            band[top : top + height, left : left + width] = views[view]
        bands.append(band)
    return np.vstack(bands)


def _fit(image: Image) -> Image:
    """Image scaled to at most the height of a row and twice that width."""
    rows, cols = image.shape[:2]
    scale = min(_ROW_PIXELS / rows, 2.0 * _ROW_PIXELS / cols)
    size = (round(cols * scale), round(rows * scale))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _write(band: Image, text: str, left: int, scale: float) -> None:
    cv2.putText(band, text, (int(left), 25), cv2.FONT_HERSHEY_SIMPLEX, scale, _INK, 1, cv2.LINE_AA)
