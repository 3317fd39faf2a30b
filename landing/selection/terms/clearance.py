"""Clearance around a site: the term ``room``."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchdown.landing.api import TermLayer
from touchdown.landing.selection.terms.inputs import Inputs


def term(site: Inputs) -> TermLayer:
    """Returns the reward of clearance, which ends at ``clearance_full_m``."""
    full, clearance = site.params.clearance_full_m, site.clearance_m
    gain = np.float32(site.selector.weight_room / full)
    value = np.minimum(clearance, np.float32(full)) * gain
    return TermLayer(name="room", value=value, quantity=clearance, unit="m")


def cluster_bonus(site: Inputs) -> NDArray[np.float32]:
    """Returns what is added to the score where cells of one cluster are compared: the same weight
    for the first ``clearance_enough_m``, nothing for a selector without the term."""
    if "room" not in site.selector.terms:
        return np.zeros(site.raster.shape, np.float32)
    enough = site.params.clearance_enough_m
    share = np.minimum(site.clearance_m, enough) / enough
    return (site.selector.weight_room * share).astype(np.float32)
