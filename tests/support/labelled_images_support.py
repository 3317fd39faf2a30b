"""Images that a small network learns to classify within seconds."""

from pathlib import Path

import cv2
import numpy as np

from touchdown.landing.api import LabelledImages
from touchdown.landing.classification.labels import D_LAND


def coloured(count: int, seed: int, size: int = 32) -> LabelledImages:
    """Lawn is green, water is blue, buildings are red; with noise."""
    rng = np.random.default_rng([seed, 11])
    kinds = {"lawn": 1, "water": 2, "building": 0}
    names = [list(kinds)[number % 3] for number in range(count)]
    images = rng.integers(60, 120, (count, size, size, 3))
    for image, name in zip(images, names, strict=True):
        image[..., kinds[name]] += 80
    return LabelledImages(
        images=images.astype(np.uint8),
        labels=np.array([D_LAND.index(name) for name in names], np.int64), classes=D_LAND,
        source=np.zeros(count, np.int64), sources=("made up",),
    )  # fmt: skip


def coloured_folders(home: Path, count: int, seed: int, size: int) -> Path:
    """Writes `coloured` as PNG files, a folder for each class."""
    pictures = coloured(count, seed, size)
    for number, (image, label) in enumerate(zip(pictures.images, pictures.labels, strict=True)):
        path = home / D_LAND[label]
        path.mkdir(exist_ok=True)
        cv2.imwrite(str(path / f"{number}.png"), image[..., ::-1])
    return home
