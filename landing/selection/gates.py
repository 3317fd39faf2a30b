"""The gates of a selector: what every site must pass, whatever its score.

The gate ``class`` is that of `landing.classification.site_check`, which sees images.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from touchdown.landing.api import GateName, SelectorParams
from touchdown.landing.selection.ground.landable import Refusal, explain
from touchdown.landing.selection.terms.inputs import Inputs

Mask = NDArray[np.bool_]

GATES: Mapping[GateName, Callable[[Inputs], Mask]] = {
    "geometry": lambda site: site.landable.mask,
    "probability": lambda site: site.probability >= site.params.min_safe_probability,
    "reach": lambda site: np.isfinite(site.distance),
}


def passing(site: Inputs) -> Mask:
    """Returns the mask of cells that pass the gates and whose score is known."""
    passed = np.ones(site.raster.shape, np.bool_)
    for gate in site.selector.gates:
        if gate in GATES:
            passed &= GATES[gate](site)
    for name in _unknown_terms(site):
        passed &= np.isfinite(_measured(site, name))
    return passed


def checks_ground(selector: SelectorParams) -> bool:
    """True for a selector that refuses ground; then the plane of the footprint is checked too."""
    return "geometry" in selector.gates or "probability" in selector.gates


def predicts(selector: SelectorParams) -> bool:
    """True for a selector that needs the probability of a safe touchdown."""
    return "probability" in (*selector.terms, *selector.gates, selector.clusters)


def refusal_of(site: Inputs, spot: tuple[int, int], margin_m: float) -> Refusal:
    """Returns why the cell ``spot`` does not pass: what the map shows there, for a selector with
    the gate ``probability`` with the probability that follows from it."""
    params, gates = site.params, site.selector.gates
    predicted, least = float(site.probability[spot]), params.min_safe_probability
    unlikely = "probability" in gates and predicted < least
    chance = f"safe with probability {predicted:.2f} (at least {least:.2f})"
    if checks_ground(site.selector) and not site.landable.mask[spot]:
        found = explain(site.raster, site.landable, *spot, params, margin_m)
        return found._replace(text=f"{found.text}; {chance}") if unlikely else found
    if unlikely:
        return Refusal("low_probability", chance)
    unknown = [n for n in _unknown_terms(site) if not np.isfinite(_measured(site, n)[spot])]
    if unknown and unknown != ["distance"]:
        return Refusal("not_seen", f"unknown {' and '.join(unknown)}")
    return Refusal("out_of_reach", "out of reach of the remaining energy")


def _unknown_terms(site: Inputs) -> list[str]:
    """Terms that are not known everywhere."""
    names = ("smoothness", "flatness", "distance", "level")
    return [name for name in site.selector.terms if name in names]


def _measured(site: Inputs, name: str) -> NDArray[np.float32]:
    layer: NDArray[np.float32] = site.landable.slope_deg if name == "level" else getattr(site, name)
    return layer
