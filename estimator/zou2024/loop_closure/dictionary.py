"""The dictionary: visual words of one kind, made from the images as they come (RTAB-Map)."""

from __future__ import annotations

import cv2
import numpy as np

from touchdown.estimator.typing import Bytes, Float32, Indices

_NEW_WORD_RATIO = 0.8
"""ratio of the distances to the nearest word and to the next (``Kp/NndrRatio`` of RTAB-Map)"""


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
        if self._binary:
            lengths, nearest = cv2.batchDistance(
                descriptors, words, cv2.CV_32S, normType=cv2.NORM_HAMMING, K=2
            )
            near, next_near = lengths.T.astype(np.float32)
            return nearest[:, 0].astype(np.int64), near, next_near
        own, known = descriptors.astype(np.float32), words.astype(np.float32)
        # exact: the sums of integers stay below 2^24
        squares = own @ (-2.0 * known).T
        squares += (known**2).sum(axis=1)
        every, best = np.arange(len(own)), squares.argmin(axis=1)
        near = squares[every, best]
        squares[every, best] = np.inf
        near, next_near = np.sqrt([near, squares.min(axis=1)] + (own**2).sum(axis=1))
        return best, near, next_near

    def forget(self, words: Indices) -> None:
        """Removes ``words`` (N,) that no location shows any more."""
        self._used[words] = False
