"""Motion between two images: corners tracked by pyramidal Lucas-Kanade (Bouguet 2001), and the
shift by phase correlation from coarse to fine.

The inverse transform of the normalised cross-power spectrum of two shifted images has a single peak
at the shift (Kuglin and Hines 1975). A coarse image finds shifts of up to half its side reliably;
finer ones, cropped along the shift found so far, refine it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from touchdown.estimator.typing import Array, Float32, Grey, Indices

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


_MIN_RESPONSE = 0.05
"""fraction of the energy in the peak's neighbourhood below which a scale is rejected"""

_MIN_CONTRAST = 0.5
"""grey levels, standard deviation"""


@dataclass(frozen=True, slots=True)
class Shift:
    """``pixels`` (2,): x and y motion of the content from the first image to the second;
    ``response``: fraction of the energy in the peak of the finest accepted scale, 0 for none."""

    pixels: Array
    response: float


def phase_shift(before: Grey, now: Grey, levels: int = 3) -> Shift:
    """Returns the shift between two images of equal, even shape (H, W), to a fraction of a pixel.

    ``levels``: number of halvings of the side for the coarsest scale, plus one. A scale is rejected
    where its response is low, or where it moves the result by more than two of the coarser pixels.
    """
    scales = [(before, now)]
    for _ in range(levels - 1):
        first, second = (np.asarray(cv2.pyrDown(image), np.uint8) for image in scales[-1])
        scales.append((first, second))
    shift, response = np.zeros(2), 0.0
    for level in range(levels - 1, -1, -1):
        factor = float(1 << level)
        whole = np.rint(shift / factor).astype(int)
        pair = _common(*scales[level], whole)
        if pair is None:
            continue
        # Hann's window suppresses the image border in the spectrum
        window = cv2.createHanningWindow(pair[0].shape[::-1], cv2.CV_32F)
        (dx, dy), peak = cv2.phaseCorrelate(*pair, window)
        found = factor * (whole + np.array([dx, dy]))
        coarsest = level == levels - 1
        if peak > _MIN_RESPONSE and (coarsest or np.abs(found - shift).max() < 4.0 * factor):
            shift, response = found, float(peak)
    return Shift(shift, response)


def _common(before: Grey, now: Grey, shift: Indices) -> tuple[Float32, Float32] | None:
    """Returns the common part of both images once ``now`` is moved back by ``shift``, without the
    mean; None if it is too small or has no contrast."""
    height, width = before.shape
    dx, dy = int(shift[0]), int(shift[1])
    if width - abs(dx) < 24 or height - abs(dy) < 24:
        return None
    first = before[max(-dy, 0) : height - max(dy, 0), max(-dx, 0) : width - max(dx, 0)]
    second = now[max(dy, 0) : height - max(-dy, 0), max(dx, 0) : width - max(-dx, 0)]
    pair = first.astype(np.float32), second.astype(np.float32)
    if min(float(image.std()) for image in pair) < _MIN_CONTRAST:
        return None
    return pair[0] - pair[0].mean(), pair[1] - pair[1].mean()
