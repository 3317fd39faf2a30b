"""Which places look alike, as in RTAB-Map (Labbé and Michaud 2013 and 2018): visual words, memory
of the locations, and the Bayesian filter over loop hypotheses.

**Words** of one kind are made from the images as they come.

**Hypotheses**: which location of the working memory the present image shows, or that it shows a new
one (2013, section III-D, after Angeli et al. 2008).

**Memory** (2013, section III; 2018, section 3). A location is a keyframe that the dictionary was
asked about. The newest ones make the short-term memory: they look like the present image because
they are near. Those of the working memory may close a loop. The rest is in long-term memory,
without words, until retrieved.
"""

from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from touchdown.sim.typing import Array, Bytes, Float32, Indices

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


NEW_TO_NEW = 0.9
"""``Bayes/VirtualPlacePriorThr`` of RTAB-Map"""
LOOP_TO_NEW = 0.1
"""first number of ``Bayes/PredictionLC`` of RTAB-Map"""
NEIGHBOUR_SIGMA = 1.6
"""links of the graph, of the numbers that follow in ``Bayes/PredictionLC``"""
REACH = 16
"""links, as many as ``Bayes/PredictionLC`` has numbers for"""


def likelihood(scores: Array) -> Array:
    """Returns the likelihood (1 + N,) of a new location and of those with similarities ``scores``
    (N,). Those beyond mean and standard deviation of the scores that are not zero stand out.
    Where they do not scatter, nothing stands out, and a new location is twice as likely (RTAB-Map,
    ``Rtabmap::adjustLikelihood``)."""
    seen = scores[scores > 0.0]
    mean = float(seen.mean()) if len(seen) else 0.0
    spread = float(seen.std(ddof=1)) if len(seen) > 1 else 0.0
    if spread < 1e-12:
        return np.concatenate([[2.0], np.ones(len(scores))])
    adjusted = np.where(scores >= mean + spread, (scores - spread) / mean, 1.0)
    return np.concatenate([[mean / spread + 1.0], adjusted])


def transition(links: Array) -> Array:
    """Returns p(now | before), (1 + N, 1 + N), the new location first, from the number of ``links``
    (N, N) between locations, infinite where there is no way. Columns sum to 1."""
    count = len(links)
    matrix = np.zeros((1 + count, 1 + count))
    matrix[0, 0] = NEW_TO_NEW if count else 1.0
    if count:
        near = np.where(links <= REACH, np.exp(-0.5 * (links / NEIGHBOUR_SIGMA) ** 2), 0.0)
        matrix[1:, 0] = (1.0 - NEW_TO_NEW) / count
        matrix[0, 1:] = LOOP_TO_NEW
        matrix[1:, 1:] = (1.0 - LOOP_TO_NEW) * near / near.sum(axis=0)
    return matrix


class LoopFilter:
    """p(S_t | images so far) over the locations of the working memory, which come and go."""

    def __init__(self) -> None:
        self._known: dict[int, float] = {}
        self.new = 1.0
        """probability that the last image shows a new location"""

    def update(self, locations: list[int], links: Array, scores: Array) -> int | None:
        """Takes an image with similarities ``scores`` (N,) to ``locations``, between which there
        are ``links`` (N, N). Returns the most probable location, the oldest of equals; None without
        any."""
        before = np.array([self.new, *(self._known.get(number, 0.0) for number in locations)])
        after = likelihood(scores) * (transition(links) @ before)
        after /= after.sum()
        self.new = float(after[0])
        self._known = dict(zip(locations, after[1:].tolist(), strict=True))
        return locations[int(np.argmax(after[1:]))] if locations else None


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
        for word, fraction in zip(unique.tolist(), (counts / len(words)).tolist(), strict=True):
            self._shown.setdefault(word, {})[number] = fraction
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
            for number, fraction in shown.items():
                if number in result:
                    result[number] += fraction * rarity
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
        """Fraction of common words (2013, Eq. 1)."""
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
        return dijkstra(graph, indices=mine, unweighted=True, limit=REACH)[:, mine]

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
