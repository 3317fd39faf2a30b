"""The term probability: that of a safe touchdown.

A logistic model of ``landing.selection.terms.risk_features``, fitted to ground-truth maps by
``touchdown bench selector --fit``. Every coefficient except the constant is negative: a higher
feature never raises the probability.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import Estimate, MapView
from touchdown.landing.api import LandingParams, TermLayer
from touchdown.landing.selection.ground.elevation_raster import ElevationRaster, observed_raster
from touchdown.landing.selection.ground.landable import LandableMap, assess, ground_planes
from touchdown.landing.selection.ground.plants import standing_plants, without_plants
from touchdown.landing.selection.terms.inputs import Inputs
from touchdown.landing.selection.terms.risk_features import NAMES, RiskFeatures, risk_features

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

TERMS = ("constant", *NAMES, "worst", "near the limit")
"""terms of the logistic model, in the order of ``LandingParams.risk_weights``"""
_SLOPE, _STEP, _NEIGHBOUR = (NAMES.index(name) for name in ("slope", "step", "neighbour"))
_KNEE = 0.8
"""share of a limit beyond which the error of the map dominates"""
_MAX_COEFFICIENT = -0.2
"""upper bound of the fitted coefficients. It decides where the data has no information: the maps
are static, so that the effect of an old map cannot be fitted."""
_RIDGE = 1e-4


def term(site: Inputs) -> TermLayer:
    """Returns the probability of a safe touchdown."""
    chance = site.probability
    value = np.float32(site.selector.weight_probability) * chance
    return TermLayer(name="probability", value=value, quantity=chance)


def model_terms(values: Float32) -> Float32:
    """Returns the model's terms (..., 10) without the constant, from features (..., 8): the
    features, the worst of slope, step and neighbour, and its excess over 0.8 of the limit."""
    worst = values[..., [_SLOPE, _STEP, _NEIGHBOUR]].max(axis=-1)
    knee = np.maximum(worst - np.float32(_KNEE), np.float32(0.0))
    return np.concatenate([values, worst[..., None], knee[..., None]], axis=-1)


def probability(features: RiskFeatures, weights: tuple[float, ...]) -> Float32:
    """Returns the probability (rows, cols) float32 of a touchdown that is safe by geometry; 0
    outside ``open``.

    ``weights`` (11,): as ``TERMS``. Raises ValueError for another number of them."""
    result = np.zeros(features.open.shape, np.float32)
    flat = features.values.reshape(-1, len(NAMES))
    _apply_model(flat, features.open.ravel(), _checked(weights), result.ravel())
    return result


@numba.njit(cache=True)
def _apply_model(values: Float32, chosen: Mask, weights: Array, result: Float32) -> None:
    """The logistic model of ``terms`` on the chosen rows of (N, 8) features, into ``result``."""
    count = values.shape[1]
    for i in range(values.shape[0]):
        if not chosen[i]:
            continue
        odds = weights[0]
        for k in range(count):
            odds += weights[1 + k] * values[i, k]
        worst = max(values[i, _SLOPE], values[i, _STEP], values[i, _NEIGHBOUR])
        odds += weights[1 + count] * worst + weights[2 + count] * max(worst - _KNEE, 0.0)
        result[i] = 1.0 / (1.0 + np.exp(-odds))


def _checked(weights: tuple[float, ...]) -> Array:
    if len(weights) != len(TERMS):
        raise ValueError(f"landing.risk_weights needs {len(TERMS)} numbers, not {len(weights)}")
    return np.asarray(weights, np.float64)


def predict(values: Float32, weights: tuple[float, ...]) -> Float32:
    """Returns probabilities (N,) float32 from features (N, 8). Raises ValueError for a wrong number
    of weights."""
    result = np.zeros(len(values), np.float32)
    every = np.ones(len(values), np.bool_)
    _apply_model(np.ascontiguousarray(values), every, _checked(weights), result)
    return result


def safe_probability(
    raster: ElevationRaster,
    landable: LandableMap,
    params: LandingParams,
    *,
    now_s: float,
    drift_m: float,
) -> Float32:
    """Returns the probability (rows, cols) of every cell as a touchdown point; see
    ``risk_features``."""
    features = risk_features(raster, landable, params, now_s=now_s, drift_m=drift_m)
    return probability(features, params.risk_weights)


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


def calibration(
    predicted: Float32, safe: NDArray[np.bool_], bins: int = 10
) -> tuple[float, list[tuple[float, float, int]]]:
    """Returns the expected calibration error of probabilities (N,), and the reliability diagram:
    mean probability, share of safe ones and number of each bin of equal width that is not empty."""
    index = np.minimum((predicted * bins).astype(int), bins - 1)
    rows, error = [], 0.0
    for number in range(bins):
        inside = index == number
        if inside.any():
            mean, share = float(predicted[inside].mean()), float(safe[inside].mean())
            rows.append((mean, share, int(inside.sum())))
            error += abs(mean - share) * float(inside.mean())
    return error, rows
