"""The dictionary: visual words of one kind, made from the images as they come (RTAB-Map)."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from touchdown.estimator.typing import Bytes, Float32, Indices

_NEW_WORD_RATIO = 0.8
"""of the distances to the nearest word and to the next (``Kp/NndrRatio`` of RTAB-Map)"""


@njit(cache=True)
def _two_least(products: Float32, squares: Float32) -> tuple[Indices, Float32]:
    """For each row of ``products`` (N, W) of descriptors and words: the word (N,) with the least
    ``square - 2 product``, and the two least values (N, 2)."""
    best = np.zeros(products.shape[0], np.int64)
    least = np.full((products.shape[0], 2), np.inf, np.float32)
    for i in range(products.shape[0]):
        for word in range(products.shape[1]):
            value = squares[word] - np.float32(2.0) * products[i, word]
            if value < least[i, 0]:
                best[i], least[i, 0], least[i, 1] = word, value, least[i, 0]
            elif value < least[i, 1]:
                least[i, 1] = value
    return best, least


@njit(cache=True)
def _two_fewest(own: NDArray[np.uint64], words: NDArray[np.uint64]) -> tuple[Indices, Float32]:
    """The word (N,) with the fewest different bits from each of (N, 8) strings, and the two least
    numbers of them (N, 2)."""
    best, least = np.zeros(own.shape[0], np.int64), np.full((own.shape[0], 2), np.inf, np.float32)
    for word in range(words.shape[0]):
        for i in range(own.shape[0]):
            count = np.int64(0)
            for c in range(own.shape[1]):
                # the form that compilers turn into one instruction
                x = own[i, c] ^ words[word, c]
                x -= (x >> np.uint64(1)) & np.uint64(0x5555555555555555)
                pairs = np.uint64(0x3333333333333333)
                x = (x & pairs) + ((x >> np.uint64(2)) & pairs)
                x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
                count += np.int64((x * np.uint64(0x0101010101010101)) >> np.uint64(56))
            if count < least[i, 0]:
                best[i], least[i, 0], least[i, 1] = word, count, least[i, 0]
            elif count < least[i, 1]:
                least[i, 1] = count
    return best, least


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
            best, near = _two_fewest(descriptors.view(np.uint64), words.view(np.uint64))
            return best, near[:, 0], near[:, 1]
        own, known = descriptors.astype(np.float32), words.astype(np.float32)
        # exact: the sums of integers stay below 2^24
        best, near = _two_least(own @ known.T, (known**2).sum(axis=1))
        near = np.sqrt(near + (own**2).sum(axis=1)[:, None])
        return best, near[:, 0], near[:, 1]

    def forget(self, words: Indices) -> None:
        """Removes ``words`` (N,) that no location shows any more."""
        self._used[words] = False
