"""The dictionary: visual words of one kind, made from the images as they come (RTAB-Map)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Indices = NDArray[np.int64]

_NEW_WORD_RATIO = 0.8
"""of the distances to the nearest word and to the next (``Kp/NndrRatio`` of RTAB-Map)"""


class Vocabulary:
    """Words of one kind; ``capacity`` bounds the memory."""

    def __init__(self, width: int, binary: bool, capacity: int) -> None:
        """``width`` of a descriptor in bytes; ``binary``: a string of bits, not numbers."""
        self._binary = binary
        self._words = np.zeros((capacity, width), np.uint8)
        self._used = np.zeros(capacity, dtype=bool)

    def __len__(self) -> int:
        return int(self._used.sum())

    def assign(self, descriptors: Bytes) -> Indices:
        """The words (N,) of (N, D) descriptors. One that is not much nearer to its word than to the
        next becomes a new word; without room it gets the nearest."""
        known = np.flatnonzero(self._used)
        words, fresh = np.zeros(len(descriptors), np.int64), np.arange(len(descriptors))
        if len(known) > 1 and len(fresh):
            best, near, next_near = self._two_nearest(descriptors, self._words[known])
            words, fresh = known[best], np.flatnonzero(near > _NEW_WORD_RATIO * next_near)
        room = np.flatnonzero(~self._used)[: len(fresh)]
        fresh = fresh[: len(room)]
        words[fresh] = room
        self._words[room] = descriptors[fresh]
        self._used[room] = True
        return words

    def _two_nearest(self, descriptors: Bytes, words: Bytes) -> tuple[Indices, Float32, Float32]:
        """The nearest words (N,), the distances to them (N,) and to the next (N,)."""
        if not self._binary:
            own, known = descriptors.astype(np.float32), words.astype(np.float32)
            # exact: the sums of integers stay below 2^24
            distance = (known**2).sum(axis=1)[None] - 2.0 * (own @ known.T)
            distance += (own**2).sum(axis=1)[:, None]
            rows, best = np.arange(len(own)), distance.argmin(axis=1)
            near = distance[rows, best]
            distance[rows, best] = np.inf
            return best, np.sqrt(near), np.sqrt(distance.min(axis=1))
        found, which = cv2.batchDistance(
            descriptors, words, cv2.CV_32S, normType=cv2.NORM_HAMMING, K=2
        )
        near, next_near = found.astype(np.float32).T
        return which[:, 0].astype(np.int64), near, next_near

    def forget(self, words: Indices) -> None:
        """Removes ``words`` (N,) that no location shows any more."""
        self._used[words] = False
