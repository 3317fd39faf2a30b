"""The terms of a site's score and the gates that a site must pass.

The score of a cell is a sum of named terms, each a layer of the map. The terms rank the sites, and
the terms of a site explain its rank: there is no second computation. The gate ``class`` is that of
`landing.classification.site_check`, which sees images.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.landing.api import (
    GateName,
    LandingParams,
    ScoreTerm,
    SelectorParams,
    SemanticView,
    TermLayer,
    TermName,
)
from touchdown.landing.selection.ground.elevation_raster import ElevationRaster, dilated
from touchdown.landing.selection.ground.landable import LandableMap, Refusal, explain
from touchdown.scenes.api import LAND_CLASSES
from touchdown.sim.typing import Array, Float32, Mask


@dataclass(frozen=True, kw_only=True, slots=True)
class Inputs:
    """One map and what is known of it, (rows, cols); NaN unknown."""

    params: LandingParams
    selector: SelectorParams
    raster: ElevationRaster
    landable: LandableMap
    vehicle_odom: Array
    """(3,)"""
    smoothness: Float32
    """Eq. 14, 0 to 1"""
    flatness: Float32
    """Eqs. 15 to 17, 0 to 1"""
    distance: Float32
    """Eq. 18, 1 near to 0 far"""
    probability: Float32
    """probability of a touchdown that is safe by geometry"""
    traffic: Mask
    """near a surface with traffic, or on one whose class was refused"""
    plants: Mask
    """stands of low plants"""
    ground: Float32
    """probability of ground of an allowed class, by the semantic map"""
    clearance_m: Float32
    """distance to the nearest cell that does not pass the gates"""


def _probability(site: Inputs) -> tuple[Float32, Float32]:
    """The reward of a safe touchdown."""
    chance = site.probability
    return np.float32(site.selector.weight_probability) * chance, chance


def _flatness(site: Inputs) -> tuple[Float32, Float32]:
    """The reward of flat ground."""
    return site.selector.weight_flatness * site.flatness, site.flatness


def _smoothness(site: Inputs) -> tuple[Float32, Float32]:
    """The reward of ground without edges in its colour."""
    return site.selector.weight_smoothness * site.smoothness, site.smoothness


def _distance(site: Inputs) -> tuple[Float32, Float32]:
    """The reward of near sites, or the penalty of far ones, by ``distance_zero``; metres."""
    x, y = site.raster.offsets_from(site.vehicle_odom)
    weight, near = np.float32(site.selector.weight_distance), site.distance
    value = weight * near if site.selector.distance_zero == "farthest" else -(weight * (1.0 - near))
    return value, np.sqrt((x**2)[None, :] + (y**2)[:, None]).astype(np.float32)


def _clearance(site: Inputs) -> tuple[Float32, Float32]:
    """The reward of clearance, which ends at ``clearance_full_m``; metres."""
    full, clearance = site.params.clearance_full_m, site.clearance_m
    gain = np.float32(site.selector.weight_clearance / full)
    return np.minimum(clearance, np.float32(full)) * gain, clearance


def _slope(site: Inputs) -> tuple[Float32, Float32]:
    """The penalty of the slope, whole from ``max_slope_deg`` on; degrees."""
    slope = site.landable.slope_deg
    tilt = np.minimum(slope / np.float32(site.params.max_slope_deg), 1.0)
    return -(np.float32(site.selector.weight_slope) * tilt), slope


def _traffic(site: Inputs) -> tuple[Float32, Float32]:
    """The penalty of cells near traffic or on ground that classification refused."""
    close = site.traffic.astype(np.float32)
    return -np.float32(site.selector.weight_traffic) * close, close


def _plants(site: Inputs) -> tuple[Float32, Float32]:
    """The penalty of footprints with low plants, whose ground is inferred from few returns."""
    radius = site.params.ground.footprint_m / site.raster.cell_m
    among = dilated(site.plants, radius).astype(np.float32)
    return -np.float32(site.selector.weight_plants) * among, among


def _ground(site: Inputs) -> tuple[Float32, Float32]:
    """The penalty of ground that may be of no allowed class."""
    return np.float32(site.selector.weight_ground) * (site.ground - np.float32(1.0)), site.ground


TERMS: Mapping[TermName, Callable[[Inputs], tuple[Float32, Float32]]] = {
    "probability": _probability,
    "flatness": _flatness,
    "smoothness": _smoothness,
    "distance": _distance,
    "clearance": _clearance,
    "slope": _slope,
    "traffic": _traffic,
    "plants": _plants,
    "ground": _ground,
}
"""functions that return a term's weighted value and what it weights, (rows, cols) each"""
_UNITS: Mapping[TermName, str] = {"distance": "m", "clearance": "m", "slope": "deg"}


def layers_of(site: Inputs) -> tuple[TermLayer, ...]:
    """Returns the terms of the selector, in its order."""
    found = ((name, *TERMS[name](site)) for name in site.selector.terms)
    return tuple(
        TermLayer(name=name, value=value, quantity=quantity, unit=_UNITS.get(name, ""))
        for name, value, quantity in found
    )


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


def cluster_bonus(site: Inputs) -> Float32:
    """Returns what is added to the score where cells of one cluster are compared: the weight of
    clearance for the first ``clearance_enough_m``, nothing for a selector without that term."""
    if "clearance" not in site.selector.terms:
        return np.zeros(site.raster.shape, np.float32)
    enough = site.params.clearance_enough_m
    fraction = np.minimum(site.clearance_m, enough) / enough
    return (site.selector.weight_clearance * fraction).astype(np.float32)


def allowed_ground(
    semantics: SemanticView | None, raster: ElevationRaster, params: LandingParams
) -> Float32:
    """Returns the probability (rows, cols) of the allowed classes in every cell, between the nodes
    of the map linearly; where nothing was seen, that of a class drawn at random; 1 without a
    map."""
    if semantics is None:
        return np.ones(raster.shape, np.float32)
    wanted = np.array([name in params.allowed_classes for name in LAND_CLASSES])
    nodes = semantics.probabilities[..., wanted].sum(axis=-1, dtype=np.float32)
    at = []
    for axis in (0, 1):
        centres = np.arange(raster.shape[1 - axis]) + 0.5
        centre = raster.origin_xy_m[axis] + centres * raster.cell_m
        offset = (centre - semantics.origin_xy_m[axis]) / semantics.spacing_m
        at.append(offset.astype(np.float32))
    cols, rows = np.meshgrid(*at)
    blind = float(np.float32(wanted.mean()))
    found = cv2.remap(
        nodes, cols, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=blind
    )
    return np.asarray(found, np.float32)


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


def refusal_of(site: Inputs, spot: tuple[int, int], margin_m: float) -> Refusal:
    """Returns why the cell ``spot`` does not pass: what the map shows there, for a selector with
    the gate ``probability`` with the probability that follows from it."""
    params, gates = site.params, site.selector.gates
    predicted, minimum = float(site.probability[spot]), params.min_safe_probability
    unlikely = "probability" in gates and predicted < minimum
    chance = f"safe with probability {predicted:.2f} (at least {minimum:.2f})"
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
    names = ("smoothness", "flatness", "distance", "slope")
    return [name for name in site.selector.terms if name in names]


def _measured(site: Inputs, name: str) -> NDArray[np.float32]:
    return site.landable.slope_deg if name == "slope" else getattr(site, name)
