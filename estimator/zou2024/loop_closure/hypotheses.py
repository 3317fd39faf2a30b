"""The Bayesian filter over loop hypotheses: which location of the working memory the present image
shows, or that it shows a new one (Labbé and Michaud 2013, section III-D, after Angeli et al. 2008).
"""

from __future__ import annotations

import numpy as np

from touchdown.estimator.typing import Array

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
