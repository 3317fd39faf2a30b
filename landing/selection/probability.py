"""The probability of a safe touchdown: a logistic model of eight features of the ground.

A feature is 0 for perfect ground and about 1 at the limit of the geometric check. The model is
fitted to ground-truth maps by ``touchdown bench selector --fit``. Every coefficient except the
constant is negative: a higher feature never raises the probability.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import Estimate, MapView
from touchdown.landing.api import LandingParams
from touchdown.landing.selection.ground.elevation_raster import (
    ElevationRaster,
    dilated,
    disc_maximum,
    distance_to,
    observed_raster,
)
from touchdown.landing.selection.ground.landable import (
    Defect,
    LandableMap,
    assess,
    ground_planes,
    inner_cells,
)
from touchdown.landing.selection.ground.plants import standing_plants, without_plants
from touchdown.sim.typing import Array, Float32, Mask

NAMES = ("slope", "step", "object", "spread", "neighbour", "confinement", "sparsity", "age")
TERMS = ("constant", *NAMES, "worst", "near the limit")
"""terms of the logistic model, in the order of ``LandingParams.risk_weights``"""

_SLOPE_DISC_M = 0.5
_SPREAD_LIMIT_M = 0.05
_NEIGHBOUR_LIMIT_M = 0.25
_CLEARANCE_M = 2.0
"""clearance beyond the footprint from which confinement is 0"""
_MAX = 2.0
"""features are clipped at twice the limit"""
_AGE_S = 60.0
_IS_HARD = np.isin(np.arange(len(Defect)), (Defect.UNKNOWN, Defect.MOVING, Defect.WATER))
"""defects that exclude a cell whatever the coefficients"""
_WORST_OF = [NAMES.index(name) for name in ("slope", "step", "neighbour")]
_KNEE = 0.8
"""fraction of a limit beyond which the error of the map dominates"""
_MAX_COEFFICIENT = -0.2
"""upper bound of the fitted coefficients. It decides where the data has no information: the maps
are static, so that the effect of an old map cannot be fitted."""
_RIDGE = 1e-4


@dataclass(frozen=True, kw_only=True, slots=True)
class RiskFeatures:
    """Features of every cell.

    ``values``: (rows, cols, 8) float32, last axis as ``NAMES``, finite everywhere; ``open``: (rows,
    cols), cells whose footprint lies within the map and contains no unknown ground, motion or
    water."""

    values: Float32
    open: Mask


def risk_features(
    raster: ElevationRaster,
    landable: LandableMap,
    params: LandingParams,
    *,
    now_s: float,
    drift_m: float = 0.0,
) -> RiskFeatures:
    """Returns the features of every cell as a touchdown point.

    ``now_s``: current time, for the age of cells; ``drift_m``: drift of the vehicle in gusts,
    subtracted from the clearance around the footprint.
    """
    cell = raster.cell_m
    footprint = params.ground.footprint_m
    pad = footprint / cell
    hard = _IS_HARD[landable.defect]
    flawed = hard | (landable.defect >= Defect.ROUGH)
    clearance = distance_to(flawed, cell)
    side = 2 * int(np.ceil(pad)) + 1
    few = np.reciprocal(1.0 + raster.count).astype(np.float32)
    thin = np.asarray(cv2.blur(few, (side, side), borderType=cv2.BORDER_REPLICATE), np.float32)
    slope = disc_maximum(landable.slope_deg, _SLOPE_DISC_M / cell)
    step, peak, spread = (
        disc_maximum(layer, pad) for layer in (landable.step_m, landable.peak_m, raster.std)
    )
    layers = (
        _scaled(slope, 0.0, 1.0 / params.max_slope_deg),
        _scaled(step, 0.0, 1.0 / params.max_step_m),
        _scaled(peak, 0.0, 1.0 / params.max_step_m),
        _scaled(spread, 0.0, 1.0 / _SPREAD_LIMIT_M),
        _scaled(landable.tall_m, 0.0, 1.0 / _NEIGHBOUR_LIMIT_M),
        _scaled(clearance, _CLEARANCE_M + footprint + drift_m, -1.0 / _CLEARANCE_M),
        _scaled(thin, 0.0, 1.0),
        _scaled(raster.last_seen, now_s, -1.0 / _AGE_S),
    )
    inside = inner_cells(raster.shape, pad)
    return RiskFeatures(values=np.stack(layers, axis=-1), open=inside & ~dilated(hard, pad))


def _scaled(layer: Float32, zero: float, gain: float) -> Float32:
    """Returns (layer - zero) * gain clipped to [0, 2]; 2 where the layer is NaN."""
    value = np.subtract(layer, zero, dtype=np.float64) * gain
    return np.nan_to_num(np.clip(value, 0.0, _MAX), nan=_MAX).astype(np.float32)


def model_terms(values: Float32) -> Array:
    """Returns the model's terms (..., 10) without the constant, from features (..., 8): the
    features, the worst of slope, step and neighbour, and its excess over 0.8 of the limit."""
    features = values.astype(np.float64)
    worst = features[..., _WORST_OF].max(axis=-1, keepdims=True)
    return np.concatenate([features, worst, np.maximum(worst - _KNEE, 0.0)], axis=-1)


def predict(values: Float32, weights: tuple[float, ...]) -> Float32:
    """Returns the probabilities (...) float32 of a touchdown that is safe by geometry from features
    (..., 8).

    ``weights`` (11,): as ``TERMS``. Raises ValueError for another number of them."""
    if len(weights) != len(TERMS):
        raise ValueError(f"landing.risk_weights needs {len(TERMS)} numbers, not {len(weights)}")
    constant, *coefficients = weights
    terms = np.moveaxis(model_terms(values), -1, 0)
    odds = sum((c * term for c, term in zip(coefficients, terms, strict=True)), constant)
    return np.asarray(1.0 / (1.0 + np.exp(-odds)), np.float32)


def probability(features: RiskFeatures, weights: tuple[float, ...]) -> Float32:
    """Returns `predict` of every cell (rows, cols); 0 outside ``open``."""
    result = np.zeros(features.open.shape, np.float32)
    result[features.open] = predict(features.values[features.open], weights)
    return result


def features_of(map_view: MapView, estimate: Estimate, params: LandingParams) -> RiskFeatures:
    """Returns the features that ``landing.selection.selector.select_sites`` uses. Raises ValueError
    for an empty map."""
    mapped = observed_raster(map_view.coarse)
    if mapped is None:
        raise ValueError("the map is empty: it has no features")
    limits = params.ground
    raster = without_plants(mapped, standing_plants(mapped, limits), limits)
    planes = ground_planes(raster, params)
    landable = assess(
        raster, planes, params, margin_m=params.map_margin_m, min_returns=params.min_returns
    )
    return risk_features(raster, landable, params, now_s=estimate.time_s)


def fit_weights(values: Float32, safe: NDArray[np.bool_]) -> tuple[float, ...]:
    """Returns the weights (11,) of maximum likelihood for ``safe`` (N,) given features (N, 8), with
    a slight ridge penalty, each coefficient at most -0.2."""
    from scipy.optimize import minimize  # takes a while to load, and no flight fits weights

    design = np.column_stack([np.ones(len(values)), model_terms(values)]).astype(np.float64)
    truth = safe.astype(np.float64)

    def loss(weights: Array) -> tuple[float, Array]:
        odds = design @ weights
        penalty = _RIDGE * float(weights[1:] @ weights[1:])
        value = float((np.logaddexp(0.0, odds) - truth * odds).mean()) + penalty
        slope = design.T @ (1.0 / (1.0 + np.exp(-odds)) - truth) / len(truth)
        return value, slope + 2.0 * _RIDGE * np.concatenate([[0.0], weights[1:]])

    start = np.concatenate([[5.0], np.full(len(TERMS) - 1, -1.0)])
    bounds = [(None, None)] + [(None, _MAX_COEFFICIENT)] * (len(TERMS) - 1)
    found = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds,
                     options={"maxiter": 2000})  # fmt: skip
    return tuple(float(weight) for weight in found.x)
