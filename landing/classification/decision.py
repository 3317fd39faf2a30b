"""Decision limits of a ground classifier, which a network's file carries.

An image counts as safe where the best class is safe, the probabilities of the safe classes add up
to at least a limit, and the image does not lie far from the training data. Scores before the
softmax are (N, 7), in the order of ``scenes.api.LAND_CLASSES``.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.landing.classification.scores import probabilities
from touchdown.landing.parameters import LandingParams
from touchdown.scenes.api import LAND_CLASSES, RISKY_CLASSES, SAFE_CLASSES
from touchdown.sim.typing import Array, Float32, Mask

Labels = NDArray[np.int64]

FALSE_SAFE, CONFIDENCE = 0.01, 0.95
"""fraction of images of unsafe ground that may count as safe, and the confidence with which limits
are fitted to stay below it"""
MIN = 0.5
"""lower bound of ``Limits.min_probability``"""
ENERGY_QUANTILE = 0.005
"""fraction of validation images below ``Limits.min_energy``"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Limits:
    """Limits that a prediction must reach to count as safe."""

    min_probability: float = 0.9
    """of the safe classes together"""
    min_energy: float = -np.inf
    """logarithm of the sum of the exponentials of the scores; lower is farther from the training
    data (Liu et al., NeurIPS 2020, Eq. 4 at temperature 1, sign turned)"""


def class_mask(*, allow_risky: bool = False) -> Mask:
    """Returns the mask (7,) of classes that a vehicle may land on."""
    wanted = SAFE_CLASSES | RISKY_CLASSES if allow_risky else SAFE_CLASSES
    return np.array([name in wanted for name in LAND_CLASSES])


def energies(scores: Float32) -> Array:
    """Returns the energies (N,) of the scores, as ``Limits.min_energy`` defines them."""
    wide = scores.astype(np.float64)
    top = wide.max(axis=1, keepdims=True)
    return np.asarray((top + np.log(np.exp(wide - top).sum(axis=1, keepdims=True)))[:, 0])


def accepted(scores: Float32, limits: Limits) -> Mask:
    """Returns the mask (N,) of images that count as safe."""
    chance = probabilities(scores)
    safe = class_mask()
    sure = chance[:, safe].sum(axis=1) >= limits.min_probability
    return sure & safe[chance.argmax(axis=1)] & (energies(scores) >= limits.min_energy)


def not_known_unsafe(scores: Float32, unknown_unsafe: float) -> Mask:
    """Returns the mask (N,) of images of which all but the safe classes together have less than
    ``unknown_unsafe``: what ``landing.unknown_ground`` of ``geometry`` lets pass."""
    return np.asarray(probabilities(scores)[:, class_mask()].sum(axis=1) > 1.0 - unknown_unsafe)


def upper_bound(count: int, of: int, confidence: float = CONFIDENCE) -> float:
    """Returns the upper bound of a fraction of which ``count`` of ``of`` were seen (Clopper and
    Pearson, Biometrika 26, 1934; one-sided); 1 of none."""
    from scipy.special import betaincinv

    if count >= of:
        return 1.0
    return float(betaincinv(count + 1.0, float(of - count), confidence))


def allowed_mistakes(unsafe: int, false_safe: float, confidence: float) -> int:
    """Returns how many of ``unsafe`` images may count as safe for the fraction to be below
    ``false_safe`` with ``confidence``; -1 where they are too few to show that."""
    count = -1
    while count + 1 < unsafe and upper_bound(count + 1, unsafe, confidence) <= false_safe:
        count += 1
    return count


def fitted_limits(
    scores: Float32,
    labels: Labels,
    false_safe: float = FALSE_SAFE,
    confidence: float = CONFIDENCE,
) -> Limits:
    """Returns the lowest limits at which the fraction of unsafe images that count as safe is at
    most ``false_safe`` with ``confidence``; where there are too few to show that, those at which
    none does.

    ``labels`` (N,) of images that the network was not trained on; negative ones, of what is no
    class, are unsafe."""
    energy = energies(scores)
    safe = class_mask()
    unsafe = is_unsafe(labels)
    min_energy = float(np.quantile(energy[labels >= 0], ENERGY_QUANTILE, method="lower"))
    chance = probabilities(scores)
    passing = safe[chance.argmax(axis=1)] & (energy >= min_energy)
    tempting = chance[unsafe & passing][:, safe].sum(axis=1)
    allowed = max(0, allowed_mistakes(int(unsafe.sum()), false_safe, confidence))
    minimum = MIN
    if tempting.size > allowed:
        # just above the first one that is not allowed
        minimum = max(MIN, float(np.nextafter(np.sort(tempting)[::-1][allowed], 2.0)))
    return Limits(min_probability=min(minimum, 1.0), min_energy=min_energy)


def is_unsafe(labels: Labels) -> Mask:
    """Returns the mask (N,) of images of no safe class."""
    return np.asarray((labels < 0) | ~class_mask()[labels])


def decision_summary(
    scores: Float32,
    labels: Labels,
    limits: Limits,
    unknown_unsafe: float = LandingParams().unknown_unsafe_probability,
) -> dict[str, Any]:
    """Returns the counts of unsafe images taken for safe and of safe images refused, and those that
    unknown ground adds where it is landed on (`not_known_unsafe`)."""
    taken, safe = accepted(scores, limits), ~is_unsafe(labels)
    mistakes, unsafe = int((~safe & taken).sum()), int((~safe).sum())
    unknown = not_known_unsafe(scores, unknown_unsafe) & ~taken
    return {
        "min_probability": limits.min_probability,
        "min_energy": limits.min_energy if np.isfinite(limits.min_energy) else None,
        "unsafe": unsafe,
        "unsafe_taken_for_safe": mistakes,
        "unsafe_share_at_most": upper_bound(mistakes, unsafe),
        "safe": int(safe.sum()),
        "safe_refused": int((safe & ~taken).sum()),
        "unsafe_unknown": int((~safe & unknown).sum()),
        "safe_unknown": int((safe & unknown).sum()),
    }
