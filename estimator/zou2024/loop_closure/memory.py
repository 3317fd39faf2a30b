"""Memory management of RTAB-Map (Labbé and Michaud 2013, section III; 2018, section 3).

A location is a keyframe that the dictionary was asked about. The newest ones make the short-term
memory: they look like the present image because they are near. Those of the working memory may
close a loop. The rest is in long-term memory, without words, until retrieved.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from touchdown.estimator.typing import Array, Bytes, Indices
from touchdown.estimator.zou2024.loop_closure.dictionary import Vocabulary
from touchdown.estimator.zou2024.loop_closure.hypotheses import REACH

_MAX_RETRIEVED = 2
"""number of locations retrieved at a time, ``Rtabmap/MaxRetrieved`` of RTAB-Map"""


class MemoryLimits(NamedTuple):
    """What is kept where."""

    short_term: int  # locations
    words: int  # of each kind, beyond which locations are transferred to long-term memory
    features: int  # of each kind in an image
    similarity: float  # beyond which a location is the last one, again


@dataclass(slots=True)
class Location:
    """A place; ``words`` (N,) are unknown in long-term memory."""

    descriptors: tuple[Bytes, ...]
    words: Indices | None = None
    weight: int = 0
    """how often it was seen again"""
    neighbours: set[int] = field(default_factory=set)


class Memory:
    """Locations by number, oldest first, in three kinds of memory.

    RTAB-Map transfers locations where an update took too long. Wall time would make a flight differ
    from its repetition. The time goes with the number of words, which is bounded in its stead.
    """

    def __init__(self, limits: MemoryLimits, kinds: tuple[tuple[int, bool], ...]) -> None:
        """``kinds`` of descriptors: bytes of each, and whether these are bits."""
        self._limits = limits
        # with room for the words of an image and of the locations retrieved for it
        capacity = limits.words + (1 + _MAX_RETRIEVED) * limits.features
        self.vocabularies = [Vocabulary(width, bits, capacity) for width, bits in kinds]
        self.locations: dict[int, Location] = {}
        self._short: list[int] = []
        self._shown: dict[int, dict[int, float]] = {}
        """by word the fraction that it has of the words of each location that shows it"""

    @property
    def working(self) -> list[int]:
        """The candidates."""
        young = set(self._short)
        known = self.locations.items()
        return [n for n, place in known if place.words is not None and n not in young]

    # ------------------------------------------------------------------------ words

    def _recall(self, number: int) -> Indices:
        """Gives a location its words (N,); those of different kinds differ."""
        place = self.locations[number]
        kinds = len(self.vocabularies)
        found = [
            kinds * vocabulary.assign(place.descriptors[kind]) + kind
            for kind, vocabulary in enumerate(self.vocabularies)
        ]
        place.words = words = np.concatenate(found)
        unique, counts = np.unique(words, return_counts=True)
        for word, share in zip(unique.tolist(), (counts / len(words)).tolist(), strict=True):
            self._shown.setdefault(word, {})[number] = share
        return words

    def _drop_words(self, number: int) -> None:
        """Transfers a location to long-term memory."""
        place = self.locations[number]
        kinds = len(self.vocabularies)
        unused: list[list[int]] = [[] for _ in range(kinds)]
        for word in np.unique(place.words if place.words is not None else []).tolist():
            del self._shown[word][number]
            if not self._shown[word]:
                del self._shown[word]
                unused[word % kinds].append(word // kinds)
        for vocabulary, words in zip(self.vocabularies, unused, strict=True):
            vocabulary.forget(np.array(words, dtype=np.int64))
        place.words = None

    def scores(self, words: Indices) -> Array:
        """(N,) similarity of every candidate to an image that shows ``words`` (M,): the sum of term
        frequency times inverse document frequency (Sivic and Zisserman 2003) over common words."""
        result = dict.fromkeys(self.working, 0.0)
        total = sum(place.words is not None for place in self.locations.values())
        for word in np.unique(words).tolist():
            shown = self._shown[word]
            rarity = float(np.log10(total / len(shown)))
            for number, share in shown.items():
                if number in result:
                    result[number] += share * rarity
        return np.array(list(result.values()))

    # ------------------------------------------------------------------------ locations

    def add(self, number: int, descriptors: tuple[Bytes, ...]) -> tuple[int, Indices]:
        """Takes a new location whose image has ``descriptors`` (N, D) of each kind. Returns the
        number that it is known by and its words (N,).

        Rehearsal: one that shows the same words as the last location is that one again, whose
        weight it raises.
        """
        self.locations[number] = place = Location(descriptors)
        words = self._recall(number)
        if self._short:
            last = self._short[-1]
            if self._similarity(words, self.locations[last].words) > self._limits.similarity:
                self.locations[last].weight += 1
                self._drop_words(number)
                del self.locations[number]
                return last, words[np.isin(words, list(self._shown))]
            place.neighbours.add(last)
            self.locations[last].neighbours.add(number)
        self._short.append(number)
        del self._short[: -self._limits.short_term]
        return number, words

    @staticmethod
    def _similarity(own: Indices, other: Indices | None) -> float:
        """Share of common words (2013, Eq. 1)."""
        if other is None or min(len(own), len(other)) == 0:
            return 0.0
        return len(np.intersect1d(own, other)) / max(len(own), len(other))

    def links(self) -> Array:
        """(N, N) number of links between candidates, over locations of all memories, infinite
        beyond the reach of the filter."""
        at = {number: row for row, number in enumerate(self.locations)}
        pairs = [(at[n], at[m]) for n, place in self.locations.items() for m in place.neighbours]
        rows, columns = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
        graph = csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(len(at), len(at)))
        mine = [at[number] for number in self.working]
        if not mine:
            return np.zeros((0, 0))
        found: Array = dijkstra(graph, indices=mine, unweighted=True, limit=REACH)[:, mine]
        return found

    def connect(self, old: int, new: int) -> None:
        """Links a location with one that it is a revisit of; the weight goes to the new one."""
        source, target = self.locations[old], self.locations[new]
        source.neighbours.add(new)
        target.neighbours.add(old)
        target.weight, source.weight = target.weight + source.weight, 0

    def manage(self, best: int | None) -> None:
        """After an image whose best hypothesis is ``best``: brings its neighbours back to the
        working memory, and transfers others, the oldest of the smallest weight first, until the
        words are few enough again."""
        near = set() if best is None else {best, *self.locations[best].neighbours}
        missing = [n for n in sorted(near) if self.locations[n].words is None]
        for number in missing[:_MAX_RETRIEVED]:
            self._recall(number)
        spare = sorted((self.locations[n].weight, n) for n in self.working if n not in near)
        for _, number in spare:
            if max(map(len, self.vocabularies)) <= self._limits.words:
                break
            self._drop_words(number)

    def remove(self, number: int) -> None:
        """Forgets a location, if it is one, and joins its neighbours in their order."""
        if number not in self.locations:
            return
        self._drop_words(number)
        around = sorted(self.locations.pop(number).neighbours)
        for one in around:
            self.locations[one].neighbours.discard(number)
        for one, other in pairwise(around):
            self.locations[one].neighbours.add(other)
            self.locations[other].neighbours.add(one)
        if number in self._short:
            self._short.remove(number)
