"""When a classifier's answer is sure enough to land on: the limits that a network's file carries.

A picture counts as safe where the probabilities of the safe classes add up to enough, and where it
is not far from all that the network was trained on. Scores before the softmax are (N, 7), in the
order of ``scenes.api.LAND_CLASSES``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.landing.classification.scores import probabilities
from touchdown.scenes.api import LAND_CLASSES, RISKY_CLASSES, SAFE_CLASSES

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]
Labels = NDArray[np.int64]
Mask = NDArray[np.bool_]

LARGEST_MISTAKE = 0.0025
"""share of pictures of unsafe ground that may pass for safe where limits are fitted: less than is
bearable, since ground of scenes never trained on misleads more often than validation pictures do"""
LEAST = 0.5
"""no limit of probability is lower"""
STRANGE = 0.005
"""share of known pictures that the limit of familiarity turns away"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Limits:
    """What an answer must reach."""

    min_probability: float = 0.9
    """of the safe classes together"""
    min_energy: float = -np.inf
    """logarithm of the sum of the exponentials of the scores; lower is farther from the training
    data (Liu et al., NeurIPS 2020, Eq. 4 at temperature 1, sign turned)"""


def class_mask(*, allow_risky: bool = False) -> Mask:
    """(7,) classes that may be landed on."""
    wanted = SAFE_CLASSES | RISKY_CLASSES if allow_risky else SAFE_CLASSES
    return np.array([name in wanted for name in LAND_CLASSES])


def energies(scores: Float32) -> Array:
    """(N,) as ``Limits.min_energy``."""
    wide = scores.astype(np.float64)
    top = wide.max(axis=1, keepdims=True)
    return np.asarray((top + np.log(np.exp(wide - top).sum(axis=1, keepdims=True)))[:, 0])


def taken_for_safe(scores: Float32, limits: Limits) -> Mask:
    """(N,) pictures that would be landed on."""
    chance = probabilities(scores)
    safe = class_mask()
    sure = chance[:, safe].sum(axis=1) >= limits.min_probability
    return sure & safe[chance.argmax(axis=1)] & (energies(scores) >= limits.min_energy)


def fitted_limits(scores: Float32, labels: Labels) -> Limits:
    """Limits for which at most ``LARGEST_MISTAKE`` of the unsafe pictures, as labelled (N,), pass
    for safe: pictures that the network was not trained on."""
    energy = energies(scores)
    safe = class_mask()
    min_energy = float(np.quantile(energy, STRANGE, method="lower"))
    chance = probabilities(scores)
    passing = safe[chance.argmax(axis=1)] & (energy >= min_energy)
    tempting = chance[~safe[labels] & passing][:, safe].sum(axis=1)
    allowed = int(LARGEST_MISTAKE * (~safe[labels]).sum())
    least = LEAST
    if tempting.size > allowed:
        # just above the first one that is not allowed
        least = max(LEAST, float(np.nextafter(np.sort(tempting)[::-1][allowed], 2.0)))
    return Limits(min_probability=min(least, 1.0), min_energy=min_energy)


def decision_summary(scores: Float32, labels: Labels, limits: Limits) -> dict[str, Any]:
    """Counts of unsafe pictures taken for safe, and of safe ones that were refused."""
    taken, safe = taken_for_safe(scores, limits), class_mask()[labels]
    return {
        "min_probability": limits.min_probability,
        "min_energy": limits.min_energy if np.isfinite(limits.min_energy) else None,
        "unsafe": int((~safe).sum()),
        "unsafe_taken_for_safe": int((~safe & taken).sum()),
        "safe": int(safe.sum()),
        "safe_refused": int((safe & ~taken).sum()),
    }
