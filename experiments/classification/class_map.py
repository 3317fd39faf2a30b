"""`touchdown classify`: class maps of aerial photographs, drawn over them."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.drawing.class_image import CLASS_RGB, UNSURE_RGB
from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.images import read_picture, write_png
from touchdown.landing.classification.engine import Classifier, class_probabilities
from touchdown.landing.classification.windows import class_map

Image = NDArray[np.uint8]

UNSURE = "unsure"
_COVER = 0.5
"""opacity of the class colours"""
_LEGEND_PX = 34
_BAND_ROWS = 256
"""rows that are drawn at a time, to save memory"""
MAX_CHANCES = 1 << 29
"""probabilities of one image: pixels times classes, 2 GiB"""


def classify_images(
    files: Sequence[Path],
    out: Path,
    classifier: Classifier,
    window_px: int | None,
    least: float,
    notes: Any,
) -> list[dict[str, Any]]:
    """Writes ``out``/NAME-classes.png for each file. Returns the share of each class in it.

    ``window_px``: side of the square that is classified, by default a quarter of the image's
    shorter side, at least the network's input size; windows overlap by three quarters. Pixels whose
    best class is less probable than ``least`` are ``unsure``. Raises UsageError, before anything is
    written, where a file is not an image or two results would have the same name.
    """
    if out.exists() and not out.is_dir():
        raise UsageError(f"--out: '{out}' is a file; name a folder")
    targets = [out / f"{file.stem}-classes.png" for file in files]
    if len(set(targets)) < len(targets):
        raise UsageError("two of the images have the same name: classify them one by one")
    for file in files:
        picture = read_picture(file)
        _window(picture, window_px, classifier.facts.image_size)
        _check_size(picture, len(classifier.facts.classes), file)
    out.mkdir(parents=True, exist_ok=True)
    rows = []
    for file, target in zip(files, targets, strict=True):
        notes(f"classifying {file}")
        image = read_picture(file)
        window = _window(image, window_px, classifier.facts.image_size)
        chance = class_chances(image, classifier, window)
        write_png(target, class_overlay(image, chance, classifier.facts.classes, least))
        rows.append({
            "picture": str(file),
            "classes": str(target),
            "window_px": window,
            "shares": _shares(chance, classifier.facts.classes, least),
        })  # fmt: skip
    return rows


def _check_size(image: Image, classes: int, file: Path) -> None:
    """Raises UsageError where the probabilities of all pixels would fill the memory."""
    height, width = image.shape[:2]
    if height * width * classes > MAX_CHANCES:
        raise UsageError(
            f"'{file}' has {width} x {height} pixels, more than {MAX_CHANCES // classes} for "
            f"{classes} classes; scale it down, or cut it in parts"
        )


def _window(image: Image, window_px: int | None, size: int) -> int:
    shorter = min(image.shape[:2])
    window = window_px or min(shorter, max(size, shorter // 4))
    if window > shorter:
        raise UsageError(
            f"--window: {window} pixels do not fit into an image of "
            f"{image.shape[1]} x {image.shape[0]}"
        )
    return window


def class_chances(image: Image, classifier: Classifier, window: int) -> NDArray[np.float32]:
    """Returns the probability (H, W, C) of each class at each pixel."""
    size = classifier.facts.image_size
    way = cv2.INTER_AREA if window >= size else cv2.INTER_LINEAR

    def classify(windows: Image) -> NDArray[np.float64]:
        scaled = [cv2.resize(w, (size, size), interpolation=way) for w in windows]
        return class_probabilities(classifier, np.stack(scaled))

    return class_map(image, window, max(1, window // 4), classify)


def class_colours(classes: Sequence[str]) -> dict[str, tuple[int, int, int]]:
    """Returns the RGB colour of each class: fixed for D_Land, else around the colour wheel."""
    if set(classes) == set(CLASS_RGB):
        return {name: CLASS_RGB[name] for name in classes}
    wheel = {}
    for number, name in enumerate(classes):
        hue, value = number / len(classes), 0.95 if number % 2 else 0.65
        red, green, blue = colorsys.hsv_to_rgb(hue, 0.75, value)
        wheel[name] = (round(255 * red), round(255 * green), round(255 * blue))
    return wheel


def _numbers(chance: NDArray[np.float32], least: float) -> NDArray[np.uint8]:
    """Returns the class (H, W) of each pixel; the number of classes where it is unsure."""
    numbers = np.empty(chance.shape[:2], np.uint8)
    for first in range(0, len(chance), _BAND_ROWS):
        band = chance[first : first + _BAND_ROWS]
        sure = band.max(axis=2) >= least
        numbers[first : first + _BAND_ROWS] = np.where(sure, band.argmax(axis=2), chance.shape[2])
    return numbers


def _shares(chance: NDArray[np.float32], classes: Sequence[str], least: float) -> dict[str, float]:
    numbers = _numbers(chance, least)
    counts = np.bincount(numbers.ravel(), minlength=len(classes) + 1) / numbers.size
    names = (*classes, UNSURE)
    return {name: float(share) for name, share in zip(names, counts, strict=True) if share > 0}


def class_overlay(
    image: Image, chance: NDArray[np.float32], classes: Sequence[str], least: float
) -> Image:
    """Returns the image in the colours of its classes, white where unsure, with a legend below:
    (H + legend, W, 3)."""
    colours = class_colours(classes) | {UNSURE: UNSURE_RGB}
    palette = np.array(list(colours.values()), np.float32)
    numbers = _numbers(chance, least)
    mixed = np.empty_like(image)
    for first in range(0, len(image), _BAND_ROWS):
        band = slice(first, first + _BAND_ROWS)
        mixed[band] = np.round((1.0 - _COVER) * image[band] + _COVER * palette[numbers[band]])
    shares = np.bincount(numbers.ravel(), minlength=len(colours)) / numbers.size
    shown = [name for name, share in zip(colours, shares, strict=True) if share >= 0.002]
    legend = _legend([(n, colours[n], shares[list(colours).index(n)]) for n in shown],
                     image.shape[1])  # fmt: skip
    return np.vstack([mixed, legend])


def _legend(rows: Sequence[tuple[str, tuple[int, int, int], float]], width: int) -> Image:
    """Returns the legend, in as many bands as the names need."""
    scale, gap = 0.5, 14
    bands = [np.full((_LEGEND_PX, width, 3), 24, np.uint8)]
    left = gap
    for name, colour, share in rows:
        text = f"{name} {share:.0%}"
        wide = 30 + cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)[0][0] + gap
        if left + wide > width and left > gap:
            bands.append(np.full((_LEGEND_PX, width, 3), 24, np.uint8))
            left = gap
        cv2.rectangle(bands[-1], (left, 9), (left + 18, 25), colour, -1)
        cv2.putText(bands[-1], text, (left + 24, 22), cv2.FONT_HERSHEY_SIMPLEX, scale,
                    (235, 235, 235), 1, cv2.LINE_AA)  # fmt: skip
        left += wide
    return np.vstack(bands)
