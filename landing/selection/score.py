"""The value of every cell as a site: a sum of named terms, each a layer of the map.

The terms rank the sites, and the terms of a site explain its rank: there is no second computation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from touchdown.landing.api import CostmapView, LandingParams, ScoreTerm, TermName
from touchdown.landing.selection.costmap import weighted_terms
from touchdown.landing.selection.elevation_raster import ElevationRaster, dilated
from touchdown.landing.selection.landable import FOOTPRINT_M, LandableMap
from touchdown.landing.selection.traffic import traffic_penalty

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True, slots=True)
class Assessed:
    """Intermediate results of one map, (rows, cols)."""

    raster: ElevationRaster
    costmap: CostmapView
    landable: LandableMap
    allowed: Mask
    avoided: Mask
    """cells near a site that was refused already"""
    probability: Float32
    clearance_m: Float32
    """distance to the nearest cell that is not allowed"""
    margin_m: float
    vehicle_odom: Array
    """(3,)"""


@dataclass(frozen=True, kw_only=True, slots=True)
class TermLayer:
    """One term of the value of every cell, (rows, cols)."""

    name: TermName
    value: Float32
    """weighted, as it is added"""
    quantity: Float32
    """what is weighted, in ``unit``"""
    unit: str = ""


@dataclass(frozen=True, kw_only=True, slots=True)
class Score:
    """The value of every cell as a site and its terms."""

    terms: tuple[TermLayer, ...]
    value: Float32
    """sum of the terms; NaN out of reach or unknown"""

    def terms_at(self, spot: tuple[int, int]) -> tuple[ScoreTerm, ...]:
        """Returns the terms of the cell ``spot``."""
        return tuple(
            ScoreTerm(
                name=term.name,
                value=float(term.value[spot]) + 0.0,  # not -0
                quantity=float(term.quantity[spot]),
                unit=term.unit,
            )
            for term in self.terms
        )


def score_sites(assessed: Assessed, close: Mask, plants: Mask, params: LandingParams) -> Score:
    """Returns the score of every cell by ``params.scorer``.

    ``close`` (rows, cols): near traffic, or the surface of a site refused for its kind of ground;
    ``plants``: stands of low plants."""
    terms = _paper_terms if params.scorer == "paper" else _risk_terms
    low_plants = dilated(plants, FOOTPRINT_M / assessed.raster.cell_m).astype(np.float32)
    layers = (
        *terms(assessed, params),
        TermLayer(
            name="traffic",
            value=-traffic_penalty(close, params),
            quantity=close.astype(np.float32),
        ),
        TermLayer(
            name="plants",
            value=np.float32(-params.plants_penalty) * low_plants,
            quantity=low_plants,
        ),
    )
    total = layers[0].value.copy()
    for layer in layers[1:]:
        total += layer.value
    return Score(terms=layers, value=total)


def _paper_terms(assessed: Assessed, params: LandingParams) -> tuple[TermLayer, ...]:
    """The terms of C_sum."""
    costmap = assessed.costmap
    smooth, flat, near = costmap.smoothness, costmap.flatness, costmap.distance
    weighted = weighted_terms(smooth, flat, near, params)
    return (
        TermLayer(name="smoothness", value=weighted[0], quantity=smooth),
        TermLayer(name="flatness", value=weighted[1], quantity=flat),
        TermLayer(name="distance", value=weighted[2], quantity=near),
    )


def _risk_terms(assessed: Assessed, params: LandingParams) -> tuple[TermLayer, ...]:
    """Probability of a safe touchdown, less what speaks against a site among safe ones."""
    near, clearance = assessed.costmap.distance, assessed.clearance_m
    slope = assessed.landable.slope_deg
    x, y = assessed.raster.offsets_from(assessed.vehicle_odom)
    away = np.hypot(x[None, :], y[:, None]).astype(np.float32)
    full = np.float32(params.clearance_weight / params.clearance_full_m)
    tilt = np.minimum(slope / np.float32(params.max_slope_deg), 1.0)
    return (
        TermLayer(
            name="safe_probability", value=assessed.probability, quantity=assessed.probability
        ),
        TermLayer(
            name="energy",
            value=-(np.float32(params.energy_weight) * (1.0 - near)),
            quantity=away,
            unit="m",
        ),
        TermLayer(
            name="clearance",
            value=np.minimum(clearance, np.float32(params.clearance_full_m)) * full,
            quantity=clearance,
            unit="m",
        ),
        TermLayer(
            name="level",
            value=-(np.float32(params.level_weight) * tilt),
            quantity=slope,
            unit="deg",
        ),
    )
