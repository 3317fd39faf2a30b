"""Our own scorer beside the paper's: the probability that a touchdown is safe.

A logistic model of ``landing.risk_features``, fitted to true maps by
``touchdown bench selector --fit``. Every coefficient but the constant is negative: nothing
that speaks against a place can make it better.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from landing.api import LandingParams
from landing.landable import LandableMap
from landing.risk_features import NAMES, RiskFeatures, risk_features
from landing.terrain import Terrain

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]

TERMS = ("constant", *NAMES, "worst", "near the limit")
"""of the logistic model, in the order of ``LandingParams.risk_weights``"""
_RULED = (NAMES.index("slope"), NAMES.index("step"), NAMES.index("neighbour"))
_KNEE = np.float32(0.8)
"""share of a limit beyond which the map's own error decides"""
_LEAST = -0.2
"""a coefficient is at most this, also where the fitted data has no say: true maps stand still, so
they cannot show what an old map costs"""
_RIDGE = 1e-4


def terms(values: Float32) -> Float32:
    """(..., 10) the model's terms without the constant, from (..., 8) features: the features, the
    worst of those that the geometric rule limits, and what that has beyond 0.8 of the limit."""
    worst = values[..., _RULED[0]]
    for index in _RULED[1:]:
        worst = np.maximum(worst, values[..., index])
    knee = np.maximum(worst - _KNEE, np.float32(0.0))
    return np.concatenate([values, worst[..., None], knee[..., None]], axis=-1)


def probability(features: RiskFeatures, weights: tuple[float, ...]) -> Float32:
    """(rows, cols) float32 of a touchdown that is safe by geometry; 0 where ``open`` is not.
    ``weights``: (11,) as ``TERMS``. ValueError: another number of them."""
    if len(weights) != len(TERMS):
        raise ValueError(f"landing.risk_weights needs {len(TERMS)} numbers, not {len(weights)}")
    result = np.zeros(features.open.shape, np.float32)
    chosen = terms(features.values[features.open])
    odds = chosen @ np.asarray(weights[1:], np.float32) + np.float32(weights[0])
    result[features.open] = 1.0 / (1.0 + np.exp(-odds))
    return result


def safe_probability(
    terrain: Terrain, landable: LandableMap, params: LandingParams, *, now_s: float, drift_m: float
) -> Float32:
    """(rows, cols) of every cell as a touchdown point; see ``risk_features``."""
    features = risk_features(terrain, landable, params, now_s=now_s, drift_m=drift_m)
    return probability(features, params.risk_weights)


def fit_weights(values: Float32, safe: NDArray[np.bool_]) -> tuple[float, ...]:
    """(11,) maximum likelihood of ``safe`` (N,) given features (N, 8), with a slight ridge, each
    coefficient at most -0.2."""
    design = np.column_stack([np.ones(len(values)), terms(values)]).astype(np.float64)
    truth = safe.astype(np.float64)

    def loss(weights: Array) -> tuple[float, Array]:
        odds = design @ weights
        penalty = _RIDGE * float(weights[1:] @ weights[1:])
        value = float((np.logaddexp(0.0, odds) - truth * odds).mean()) + penalty
        slope = design.T @ (1.0 / (1.0 + np.exp(-odds)) - truth) / len(truth)
        return value, slope + 2.0 * _RIDGE * np.concatenate([[0.0], weights[1:]])

    start = np.concatenate([[5.0], np.full(len(TERMS) - 1, -1.0)])
    bounds = [(None, None)] + [(None, _LEAST)] * (len(TERMS) - 1)
    found = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds,
                     options={"maxiter": 2000})  # fmt: skip
    return tuple(float(weight) for weight in found.x)


def calibration(
    believed: Float32, safe: NDArray[np.bool_], bins: int = 10
) -> tuple[float, list[tuple[float, float, int]]]:
    """Expected calibration error of probabilities (N,), and the reliability diagram: mean belief,
    share that is safe and number of every bin of equal width that holds any."""
    index = np.minimum((believed * bins).astype(int), bins - 1)
    rows, error = [], 0.0
    for number in range(bins):
        inside = index == number
        if inside.any():
            mean, share = float(believed[inside].mean()), float(safe[inside].mean())
            rows.append((mean, share, int(inside.sum())))
            error += abs(mean - share) * float(inside.mean())
    return error, rows
