"""`touchdown classify`: class maps of aerial photographs by a sliding window, drawn over them."""

import colorsys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.drawing.class_image import CLASS_RGB, UNSURE_RGB
from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.images import read_picture, write_png
from touchdown.landing.classification.engine import OnnxClassifier
from touchdown.landing.classification.scores import probabilities
from touchdown.sim.typing import Float32, Image

UNSURE = "unsure"
_BATCH = 32
_OPACITY = 0.5
"""of the class colours"""
_LEGEND_PX = 34
MAX_CHANCES = 1 << 29
"""probabilities of one image: pixels times classes, 2 GiB"""


def classify_images(
    files: Sequence[Path],
    out: Path,
    classifier: OnnxClassifier,
    window_px: int | None,
    minimum: float,
    notes: Any,
) -> list[dict[str, Any]]:
    """Writes ``out``/NAME-classes.png for each file. Returns the fraction of each class in it.

    ``window_px``: side of the square that is classified, by default a quarter of the image's
    shorter side, at least the network's input size; windows overlap by three quarters. Pixels whose
    best class is less probable than ``minimum`` are ``unsure``. Raises UsageError, before anything
    is written, where a file is not an image or two results would have the same name.
    """
    if out.exists() and not out.is_dir():
        raise UsageError(f"--out: '{out}' is a file; name a folder")
    targets = [out / f"{file.stem}-classes.png" for file in files]
    if len(set(targets)) < len(targets):
        raise UsageError("two of the images have the same name: classify them one by one")
    classes, size = classifier.facts.classes, classifier.facts.image_size
    for file in files:
        picture = read_picture(file)
        _window(picture, window_px, size)
        _check_size(picture, len(classes), file)
    out.mkdir(parents=True, exist_ok=True)
    rows = []
    for file, target in zip(files, targets, strict=True):
        notes(f"classifying {file}")
        image = read_picture(file)
        window = _window(image, window_px, size)
        way = cv2.INTER_AREA if window >= size else cv2.INTER_LINEAR

        def classify(windows: Image, way: int = way) -> Float32:
            scaled = [cv2.resize(w, (size, size), interpolation=way) for w in windows]
            return probabilities(classifier.scores(np.stack(scaled))).astype(np.float32)

        chance = class_map(image, window, max(1, window // 4), classify)
        numbers = sure_classes(chance, minimum)
        write_png(target, class_overlay(image, numbers, classes))
        rows.append({
            "picture": str(file),
            "classes": str(target),
            "window_px": window,
            "shares": fractions(numbers, classes),
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


def window_starts(length: int, window: int, stride: int) -> list[int]:
    """Returns the first pixels of windows that cover ``length`` pixels, the last one flush with the
    end."""
    return sorted({*range(0, length - window + 1, stride), length - window})


def class_map(
    image: Image, window: int, stride: int, classify: Callable[[Image], Float32]
) -> Float32:
    """Returns class probabilities (H, W, C) of the pixels of ``image`` (H, W, 3).

    ``classify`` maps windows (N, window, window, 3) to probabilities (N, C). Windows are ``stride``
    pixels apart; overlapping ones are averaged with a raised-cosine weight.
    """
    rows, cols = (window_starts(length, window, stride) for length in image.shape[:2])
    places = [np.s_[r : r + window, c : c + window] for r in rows for c in cols]
    ramp = 0.5 - 0.5 * np.cos(2.0 * np.pi * (np.arange(window) + 0.5) / window)
    weight = np.outer(ramp, ramp).astype(np.float32) + np.float32(1e-3)
    total, norm = np.zeros(0, np.float32), np.zeros(image.shape[:2], np.float32)
    for first in range(0, len(places), _BATCH):
        some = places[first : first + _BATCH]
        found = classify(np.stack([image[place] for place in some]))
        if not total.size:
            total = np.zeros((*image.shape[:2], found.shape[1]), np.float32)
        for place, chance in zip(some, found, strict=True):
            total[place] += weight[..., None] * chance
            norm[place] += weight
    total /= norm[..., None]
    return total


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


def sure_classes(chance: Float32, minimum: float) -> NDArray[np.int64]:
    """Returns the number of the class (H, W) of each pixel; one more than the last where the best
    of the probabilities (H, W, C) is below ``minimum``."""
    return np.where(chance.max(axis=2) >= minimum, chance.argmax(axis=2), chance.shape[2])


def fractions(numbers: NDArray[np.int64], classes: Sequence[str]) -> dict[str, float]:
    """Returns the fraction of the pixels of each class that occurs; ``numbers`` (H, W) are those of
    `sure_classes`."""
    names = (*classes, UNSURE)
    counts = np.bincount(numbers.ravel(), minlength=len(names)) / numbers.size
    return {name: float(count) for name, count in zip(names, counts, strict=True) if count > 0}


def class_overlay(image: Image, numbers: NDArray[np.int64], classes: Sequence[str]) -> Image:
    """Returns the image in the colours of its classes, ``numbers`` of `sure_classes`, white where
    unsure, with a legend below: (H + legend, W, 3)."""
    colours = class_colours(classes) | {UNSURE: UNSURE_RGB}
    palette = np.array(list(colours.values()), np.uint8)
    mixed = cv2.addWeighted(image, 1.0 - _OPACITY, palette[numbers], _OPACITY, 0.0)
    shown = {name: part for name, part in fractions(numbers, classes).items() if part >= 0.002}
    legend = _legend([(f"{n} {part:.0%}", colours[n]) for n, part in shown.items()], image.shape[1])
    return np.vstack([np.asarray(mixed, np.uint8), legend])


def _legend(entries: Sequence[tuple[str, tuple[int, int, int]]], width: int) -> Image:
    """Returns the legend, in as many bands as the texts need."""
    scale, gap = 0.5, 14
    bands = [np.full((_LEGEND_PX, width, 3), 24, np.uint8)]
    left = gap
    for text, colour in entries:
        wide = 30 + cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)[0][0] + gap
        if left + wide > width and left > gap:
            bands.append(np.full((_LEGEND_PX, width, 3), 24, np.uint8))
            left = gap
        cv2.rectangle(bands[-1], (left, 9), (left + 18, 25), colour, -1)
        cv2.putText(bands[-1], text, (left + 24, 22), cv2.FONT_HERSHEY_SIMPLEX, scale,
                    (235, 235, 235), 1, cv2.LINE_AA)  # fmt: skip
        left += wide
    return np.vstack(bands)
