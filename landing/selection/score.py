"""The score of every cell as a site: a sum of named terms, each a layer of the map.

The terms rank the sites, and the terms of a site explain its rank: there is no second computation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from touchdown.landing.api import LandingParams, ScoreTerm, TermLayer, TermName
from touchdown.landing.selection.terms import (
    clearance,
    distance,
    flatness,
    ground,
    plants,
    probability,
    slope,
    smoothness,
    traffic,
)
from touchdown.landing.selection.terms.inputs import Inputs

Float32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

TERMS: Mapping[TermName, Callable[[Inputs], TermLayer]] = {
    "probability": probability.term,
    "flatness": flatness.term,
    "smoothness": smoothness.term,
    "distance": distance.term,
    "room": clearance.term,
    "level": slope.term,
    "traffic": traffic.term,
    "plants": plants.term,
    "ground": ground.term,
}


def layers_of(site: Inputs) -> tuple[TermLayer, ...]:
    """Returns the terms of the selector, in its order."""
    return tuple(TERMS[name](site) for name in site.selector.terms)


def score_of(layers: tuple[TermLayer, ...], shape: tuple[int, ...]) -> Float32:
    """Returns the sum of the terms; NaN where one is."""
    if not layers:
        return np.zeros(shape, np.float32)
    total = layers[0].value.copy()
    for layer in layers[1:]:
        total += layer.value
    return total


def terms_at(layers: tuple[TermLayer, ...], spot: tuple[int, int]) -> tuple[ScoreTerm, ...]:
    """Returns the terms of the cell ``spot``."""
    return tuple(
        ScoreTerm(
            name=layer.name,
            value=float(layer.value[spot]) + 0.0,  # not -0
            quantity=float(layer.quantity[spot]),
            unit=layer.unit,
        )
        for layer in layers
    )


def c_sum(smooth: Float32, flat: Float32, near: Float32, params: LandingParams) -> Float32:
    """Eq. 13 with the weights of ``landing.zou2024``; NaN where any term is NaN."""
    weights = params.zou2024
    total: Float32 = (
        weights.weight_smoothness * smooth
        + weights.weight_flatness * flat
        + weights.weight_distance * near
    )
    return total
