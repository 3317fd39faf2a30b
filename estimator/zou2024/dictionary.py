"""The dictionary map: visual words of both kinds, and where each was seen (an inverted index).

Words grow with the flight as in RTAB-Map (Labbe and Michaud 2019), up to a fixed capacity: a
descriptor far from every word becomes a new one; once the dictionary is full the nearest word is
used.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.zou2024.landmarks import BRISK_BYTES, SIFT, SIFT_BYTES

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]
Indices = NDArray[np.int64]

_SIFT_NEW_WORD = 250.0
_BRISK_NEW_WORD = 90.0
"""descriptor distances beyond which a descriptor is a word of its own"""


class Vocabulary:
    """Words of one kind; ``capacity`` bounds the memory."""

    def __init__(self, kind: int, capacity: int) -> None:
        self.kind = kind
        self._words = np.zeros((capacity, SIFT_BYTES if kind == SIFT else BRISK_BYTES), np.uint8)
        self._limit = _SIFT_NEW_WORD if kind == SIFT else _BRISK_NEW_WORD
        self.count = 0

    def nearest(self, descriptors: Bytes) -> tuple[Indices, Array]:
        """Nearest word of (N, D) descriptors and its distance, (N,) each; words must exist."""
        words = self._words[: self.count]
        if self.kind == SIFT:
            own, known = descriptors.astype(np.float32), words.astype(np.float32)
            cross = own @ known.T
            square = (own**2).sum(axis=1)[:, None] + (known**2).sum(axis=1)[None] - 2.0 * cross
            best = np.argmin(square, axis=1)
            distance = np.sqrt(np.maximum(square[np.arange(len(best)), best], 0.0))
            return best.astype(np.int64), distance.astype(np.float64)
        distance, best = cv2.batchDistance(
            descriptors, words, cv2.CV_32S, normType=cv2.NORM_HAMMING, K=1
        )
        return best[:, 0].astype(np.int64), distance[:, 0].astype(np.float64)

    def assign(self, descriptors: Bytes) -> Indices:
        """The words (N,) of (N, D) descriptors; makes new ones while there is room."""
        if len(descriptors) == 0:
            return np.zeros(0, dtype=np.int64)
        if self.count == 0:
            words, far = np.zeros(len(descriptors), np.int64), np.full(len(descriptors), True)
        else:
            words, distance = self.nearest(descriptors)
            far = distance > self._limit
        fresh = np.flatnonzero(far)[: len(self._words) - self.count]
        self._words[self.count : self.count + len(fresh)] = descriptors[fresh]
        words[fresh] = self.count + np.arange(len(fresh))
        self.count += len(fresh)
        return words


class InvertedIndex:
    """Keyframes by the words seen in them."""

    def __init__(self) -> None:
        self._seen: dict[int, dict[int, int]] = {}
        self._words: dict[int, Indices] = {}

    def __len__(self) -> int:
        return len(self._words)

    def add(self, keyframe: int, words: Indices) -> None:
        """Adds ``keyframe`` with its ``words`` (N,), repetitions counted."""
        unique, counts = np.unique(words, return_counts=True)
        self._words[keyframe] = unique
        for word, count in zip(unique.tolist(), counts.tolist(), strict=True):
            self._seen.setdefault(word, {})[keyframe] = count

    def remove(self, keyframe: int) -> None:
        """Removes a keyframe."""
        for word in self._words.pop(keyframe).tolist():
            del self._seen[word][keyframe]
            if not self._seen[word]:
                del self._seen[word]

    def scores(self, words: Indices) -> dict[int, float]:
        """Returns the similarity of every keyframe to an image that shows ``words`` (N,): the sum
        over common words of the inverse document frequency (Sivic and Zisserman 2003), relative to
        the largest possible sum for these words, so that 1 is a full match."""
        total = len(self._words)
        result: dict[int, float] = {}
        best = 0.0
        for word in np.unique(words).tolist():
            places = self._seen.get(word, {})
            rarity = float(np.log((1.0 + total) / (1.0 + len(places)))) + 1e-9
            best += rarity
            for keyframe in places:
                result[keyframe] = result.get(keyframe, 0.0) + rarity
        return {keyframe: score / best for keyframe, score in result.items()}
