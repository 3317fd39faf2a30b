"""The probability of a safe touchdown: a logistic model of twelve features of the ground.

A feature is 0 for perfect ground and about 1 at the limit of the geometric check. What a slope near
the limit says depends on how well the map knows it: the feature ``steepness`` counts the excess in
units of an uncertainty that grows with the roughness of the footprint. The model is fitted to
ground-truth maps by ``touchdown bench selector --fit``. Every coefficient except the constant is
negative: a higher feature never raises the probability.
"""

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
    fit_planes,
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

NAMES = (
    "slope", "step", "object", "spread", "neighbour", "confinement", "sparsity", "age",
    "slope around", "tilt", "steepness", "plants",
)  # fmt: skip
TERMS = ("constant", *NAMES, "beyond the limit")
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
_BEYOND = [NAMES.index(name) for name in ("step", "object", "neighbour")]
_SURELY = 1.2
"""multiple of a limit that the error of the map does not reach on level ground"""
_SURE_RATIO, _ROUGH_M = 0.1, 0.05
"""uncertainty of a slope over its limit on smooth ground; roughness at which it is 1 more"""
_MAX_COEFFICIENTS = (*[-2.0 if name == "confinement" else -0.2 for name in NAMES], -3.0)
"""Upper bounds of the fitted coefficients. They decide where the data has little information: maps
are static, so that neither an old map nor a vehicle beside its site can be fitted, and posts are
rare."""
_RIDGE = 1e-4


@dataclass(frozen=True, kw_only=True, slots=True)
class RiskFeatures:
    """Features of every cell.

    ``values``: (rows, cols, 12) float32, last axis as ``NAMES``, finite everywhere;
    ``open``: (rows, cols), cells whose footprint lies within the map and contains no unknown
    ground, motion or water."""

    values: Float32
    open: Mask


def risk_features(
    raster: ElevationRaster,
    landable: LandableMap,
    params: LandingParams,
    plants: Mask,
    *,
    now_s: float,
    drift_m: float = 0.0,
) -> RiskFeatures:
    """Returns the features of every cell as a touchdown point.

    ``plants``: cells (rows, cols) whose ground is inferred; ``now_s``: current time, for the age of
    cells; ``drift_m``: drift of the vehicle in gusts, subtracted from the clearance around the
    footprint.
    """
    cell = raster.cell_m
    footprint = params.ground.footprint_m
    pad = footprint / cell
    hard = _IS_HARD[landable.defect]
    flawed = hard | (landable.defect >= Defect.ROUGH)
    clearance = distance_to(flawed, cell)
    side = 2 * int(np.ceil(pad)) + 1
    uneven = np.nan_to_num(raster.height - raster.high + landable.peak_m)
    thin, rough2, planted = (
        np.asarray(cv2.blur(layer, (side, side), borderType=cv2.BORDER_REPLICATE), np.float32)
        for layer in (1.0 / (1.0 + raster.count), uneven**2, plants.astype(np.float32))
    )
    slope, around = (
        _scaled(disc_maximum(landable.slope_deg, reach), 0.0, 1.0 / params.max_slope_deg)
        for reach in (_SLOPE_DISC_M / cell, pad)
    )
    pad_plane = fit_planes(raster.height, cell, footprint)
    tilt = _scaled(np.rad2deg(pad_plane.angle_rad), 0.0, 1.0 / params.max_slope_deg)
    unsure = _SURE_RATIO + np.sqrt(np.maximum(rough2, 0.0)) / _ROUGH_M
    excess = ((np.maximum(slope, tilt) - 1.0) / unsure).astype(np.float32)
    step, peak, spread = (
        disc_maximum(layer, pad) for layer in (landable.step_m, landable.peak_m, raster.std)
    )
    layers = (
        slope,
        _scaled(step, 0.0, 1.0 / params.max_step_m),
        _scaled(peak, 0.0, 1.0 / params.max_step_m),
        _scaled(spread, 0.0, 1.0 / _SPREAD_LIMIT_M),
        _scaled(landable.tall_m, 0.0, 1.0 / _NEIGHBOUR_LIMIT_M),
        _scaled(clearance, _CLEARANCE_M + footprint + drift_m, -1.0 / _CLEARANCE_M),
        _scaled(thin, 0.0, 1.0),
        _scaled(raster.last_seen, now_s, -1.0 / _AGE_S),
        around,
        tilt,
        _scaled(excess, -_MAX, 0.5),
        planted,
    )
    inside = inner_cells(raster.shape, pad)
    return RiskFeatures(values=np.stack(layers, axis=-1), open=inside & ~dilated(hard, pad))


def _scaled(layer: Float32, zero: float, gain: float) -> Float32:
    """Returns (layer - zero) * gain clipped to [0, 2]; 2 where the layer is NaN."""
    value = np.subtract(layer, zero, dtype=np.float64) * gain
    return np.nan_to_num(np.clip(value, 0.0, _MAX), nan=_MAX).astype(np.float32)


def model_terms(values: Float32) -> Array:
    """Returns the model's terms (..., 13) without the constant, from features (..., 12): the
    features, and the excess of the worst of step, object and neighbour over 1.2 of the limit."""
    features = values.astype(np.float64)
    worst = features[..., _BEYOND].max(axis=-1, keepdims=True)
    return np.concatenate([features, np.maximum(worst - _SURELY, 0.0)], axis=-1)


def predict(values: Float32, weights: tuple[float, ...]) -> Float32:
    """Returns the probabilities (...) float32 of a touchdown that is safe by geometry from features
    (..., 12).

    ``weights`` (14,): as ``TERMS``. Raises ValueError for another number of them."""
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
    plants = standing_plants(mapped, limits)
    raster = without_plants(mapped, plants, limits)
    planes = ground_planes(raster, params)
    landable = assess(
        raster, planes, params, margin_m=params.map_margin_m, min_returns=params.min_returns
    )
    return risk_features(raster, landable, params, plants, now_s=estimate.time_s)


def fit_weights(values: Float32, safe: NDArray[np.bool_]) -> tuple[float, ...]:
    """Returns the weights (14,) of maximum likelihood for ``safe`` (N,) given features (N, 12),
    with a slight ridge penalty, each coefficient at most -0.2, that beyond the limit at most -3."""
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
    bounds = [(None, bound) for bound in (None, *_MAX_COEFFICIENTS)]
    found = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds,
                     options={"maxiter": 2000})  # fmt: skip
    return tuple(float(weight) for weight in found.x)
