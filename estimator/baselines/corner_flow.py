"""Corner tracking from image to image by pyramidal Lucas-Kanade (Bouguet 2001)."""

from __future__ import annotations

import cv2
import numpy as np

from touchdown.estimator.typing import Array, Grey, Indices

_WINDOW = (15, 15)
_LEVELS = 2
_STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 15, 0.01)


def follow(before: Grey, now: Grey, pixels: Array, guess: Array) -> tuple[Indices, Array]:
    """Tracks corners ``pixels`` (N, 2) of ``before`` into ``now``, from ``guess`` (N, 2): returns
    the indices (M,) of those found, and their pixels (M, 2)."""
    if len(pixels) == 0:
        return np.zeros(0, np.int64), np.zeros((0, 2))
    found, good, _ = cv2.calcOpticalFlowPyrLK(
        before, now, pixels.astype(np.float32)[:, None], guess.astype(np.float32)[:, None].copy(),
        winSize=_WINDOW, maxLevel=_LEVELS, criteria=_STOP, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    reached = found[:, 0].astype(np.float64)
    height, width = now.shape
    inside = (reached >= 0.0).all(axis=1) & (reached <= [width - 1, height - 1]).all(axis=1)
    kept = np.flatnonzero((good[:, 0] > 0) & inside)
    return kept, reached[kept]
