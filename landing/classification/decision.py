"""Decision limits of a ground classifier, which a network's file carries.

An image counts as safe where the best class is safe, the probabilities of the safe classes add up
to at least a limit, and the image does not lie far from the training data. Scores before the
softmax are (N, 7), in the order of ``scenes.api.LAND_CLASSES``.
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
"""largest share of images of unsafe ground that may count as safe when limits are fitted. It is
lower than acceptable in flight: errors are more frequent in scenes that were never trained on than
in the validation images."""
LEAST = 0.5
"""lower bound of ``Limits.min_probability``"""
STRANGE = 0.005
"""share of validation images below ``Limits.min_energy``"""


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


def taken_for_safe(scores: Float32, limits: Limits) -> Mask:
    """Returns the mask (N,) of images that count as safe."""
    chance = probabilities(scores)
    safe = class_mask()
    sure = chance[:, safe].sum(axis=1) >= limits.min_probability
    return sure & safe[chance.argmax(axis=1)] & (energies(scores) >= limits.min_energy)


def fitted_limits(scores: Float32, labels: Labels) -> Limits:
    """Returns the limits at which at most ``LARGEST_MISTAKE`` of the unsafe images count as safe.

    ``labels`` (N,) of images that the network was not trained on."""
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
    """Returns the counts of unsafe images taken for safe and of safe images refused."""
    taken, safe = taken_for_safe(scores, limits), class_mask()[labels]
    return {
        "min_probability": limits.min_probability,
        "min_energy": limits.min_energy if np.isfinite(limits.min_energy) else None,
        "unsafe": int((~safe).sum()),
        "unsafe_taken_for_safe": int((~safe & taken).sum()),
        "safe": int(safe.sum()),
        "safe_refused": int((safe & ~taken).sum()),
    }
