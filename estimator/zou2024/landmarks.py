"""SIFT and BRISK landmarks of an image (paper, section 3.3.2).

The paper names SURF as well. OpenCV's wheels are built without it (its patented build flag is off;
``cv2.xfeatures2d.SURF_create`` raises), so that SIFT is the only real-valued descriptor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from touchdown.estimator.typing import Array, Bytes, Grey, Indices

SIFT, BRISK = 0, 1
SIFT_BYTES, BRISK_BYTES = 128, 64


@dataclass(frozen=True, slots=True)
class Features:
    """Landmark features of one kind in one image."""

    pixels: Array
    """(N, 2), full size"""
    descriptors: Bytes
    """(N, 128) SIFT, numbers 0..255; (N, 64) BRISK, bits"""

    def __len__(self) -> int:
        return len(self.pixels)


def spread(
    pixels: Array, responses: Array, size: tuple[int, int], cell_px: int, maximum: int
) -> Indices:
    """Returns indices of up to ``most`` of (N, 2) keypoints, the strongest of every cell first,
    then the second of every cell, and so on: evenly spread over the image, and deterministic."""
    if len(pixels) == 0:
        return np.zeros(0, dtype=np.int64)
    columns = -(-size[0] // cell_px)
    cell = (pixels[:, 1] // cell_px).astype(np.int64) * columns
    cell += (pixels[:, 0] // cell_px).astype(np.int64)
    order = np.lexsort((np.arange(len(cell)), -responses, cell))
    starts = np.flatnonzero(np.diff(cell[order], prepend=-1))
    rank = np.arange(len(order)) - np.repeat(starts, np.diff(starts, append=len(order)))
    by_rank = order[np.lexsort((-responses[order], rank))]
    return np.sort(by_rank[:maximum])


class LandmarkDetector:
    """Finds SIFT features of an image and BRISK features, whose threshold follows the texture so
    that its time stays bounded.

    SIFT is given the image at a quarter of its size, which it doubles before it begins (Lowe 2004,
    section 3.3): its finest octave is that of half the size. Given half the size, it takes three
    times as long, and positions are no better."""

    def __init__(self, sift: int, brisk: int, border_px: float = 10.0) -> None:
        self._counts = (sift, brisk)
        self._border = border_px
        # OpenCV's plain doubling shifts features by a quarter of a pixel of what it is given
        self._sift: cv2.Feature2D = cv2.SIFT.create(
            nfeatures=2 * sift, contrastThreshold=0.02, enable_precise_upscale=True
        )
        self._brisk_threshold = 50
        self._brisk = cv2.xfeatures2d.BRISK.create(self._brisk_threshold, 2)

    def __call__(self, grey: Grey) -> tuple[Features, Features]:
        """(SIFT, BRISK) features of a (H, W) uint8 image."""
        quarter = cv2.resize(grey, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
        sift = self._find(SIFT, self._sift, np.asarray(quarter, dtype=np.uint8), 4.0, 64)
        brisk = self._find(BRISK, self._brisk, grey, 1.0, 64)
        return sift, brisk

    def _find(
        self, kind: int, detector: cv2.Feature2D, image: Grey, scale: float, cell_px: int
    ) -> Features:
        maximum, descriptors = self._counts[kind], None
        keypoints: Sequence[cv2.KeyPoint] = ()
        if maximum > 0 and kind == SIFT:
            keypoints, descriptors = detector.detectAndCompute(image, None)
        elif maximum > 0:
            keypoints = detector.detect(image, None)
            self._adapt_threshold(len(keypoints))
        pixels = np.array([k.pt for k in keypoints], dtype=np.float64).reshape(-1, 2)
        # the centre of a pixel of the smaller image lies between those that it covers
        pixels = scale * pixels + 0.5 * (scale - 1.0)
        height, width = round(scale * image.shape[0]), round(scale * image.shape[1])
        inside = (pixels >= self._border).all(axis=1)
        inside &= (pixels <= np.array([width, height]) - 1 - self._border).all(axis=1)
        usable = np.flatnonzero(inside)
        responses = np.array([keypoints[i].response for i in usable.tolist()])
        chosen = usable[spread(pixels[usable], responses, (width, height), cell_px, maximum)]
        if kind == BRISK and len(chosen):
            # most of the keypoints are not wanted, and need no descriptors
            _, descriptors = detector.compute(image, [keypoints[i] for i in chosen.tolist()])
            pixels, chosen = pixels[chosen], np.arange(len(chosen))
        if descriptors is None:
            descriptors = np.zeros((0, SIFT_BYTES if kind == SIFT else BRISK_BYTES))
        return Features(pixels[chosen], np.asarray(descriptors)[chosen].astype(np.uint8))

    def _adapt_threshold(self, found: int) -> None:
        """Aims at 1.7 times the features wanted, of which ten grey levels keep one in e."""
        step = round(10.0 * float(np.log(max(found, 1) / (1.7 * self._counts[BRISK]))))
        step = min(max(step, -16), 16)
        threshold = min(max(self._brisk_threshold + step, 10), 120)
        if threshold != self._brisk_threshold:
            self._brisk_threshold = threshold
            self._brisk.setThreshold(threshold)
