"""Class maps of large images by a sliding window."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]
Image = NDArray[np.uint8]


def window_starts(length: int, window: int, stride: int) -> NDArray[np.int64]:
    """Returns the first pixels of windows that cover ``length`` pixels, the last one flush with the
    end. Raises ValueError where no window fits."""
    if window > length:
        raise ValueError(f"a window of {window} pixels does not fit into {length}")
    starts = np.arange(0, length - window + 1, stride)
    if starts[-1] + window < length:
        starts = np.append(starts, length - window)
    return starts.astype(np.int64)


def class_map(
    image: Image, window: int, stride: int, classify: Callable[[Image], Array], batch: int = 32
) -> Float32:
    """Returns class probabilities (H, W, C) of the pixels of ``image`` (H, W, 3).

    ``classify`` maps windows (N, window, window, 3) to probabilities (N, C). Windows are ``stride``
    pixels apart; overlapping ones are averaged with a raised-cosine weight.
    """
    rows, cols = (window_starts(length, window, stride) for length in image.shape[:2])
    corners = [(int(row), int(col)) for row in rows for col in cols]
    ramp = 0.5 - 0.5 * np.cos(2.0 * np.pi * (np.arange(window) + 0.5) / window)
    weight = np.outer(ramp, ramp).astype(np.float32) + np.float32(1e-3)
    total: Float32 | None = None
    norm = np.zeros(image.shape[:2], np.float32)
    for first in range(0, len(corners), batch):
        some = corners[first : first + batch]
        found = classify(np.stack([image[r : r + window, c : c + window] for r, c in some]))
        if total is None:
            total = np.zeros((*image.shape[:2], found.shape[1]), np.float32)
        for (row, col), chance in zip(some, found.astype(np.float32), strict=True):
            inside = (slice(row, row + window), slice(col, col + window))
            total[inside] += weight[..., None] * chance
            norm[inside] += weight
    assert total is not None
    total /= norm[..., None]
    return total
