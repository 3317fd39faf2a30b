"""Slope of ground that is safe: the term ``level``."""

from __future__ import annotations

import numpy as np

from touchdown.landing.api import TermLayer
from touchdown.landing.selection.terms.inputs import Inputs


def term(site: Inputs) -> TermLayer:
    """Returns the penalty of the slope, whole from ``max_slope_deg`` on."""
    slope = site.landable.slope_deg
    tilt = np.minimum(slope / np.float32(site.params.max_slope_deg), 1.0)
    value = -(np.float32(site.selector.weight_level) * tilt)
    return TermLayer(name="level", value=value, quantity=slope, unit="deg")
