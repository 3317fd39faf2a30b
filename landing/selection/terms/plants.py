"""The term plants: sites among low plants, whose ground is inferred from few returns."""

from __future__ import annotations

import numpy as np

from touchdown.landing.api import TermLayer
from touchdown.landing.selection.ground.elevation_raster import dilated
from touchdown.landing.selection.terms.inputs import Inputs


def term(site: Inputs) -> TermLayer:
    """Returns the penalty of footprints with low plants."""
    radius = site.params.ground.footprint_m / site.raster.cell_m
    among = dilated(site.plants, radius).astype(np.float32)
    value = -np.float32(site.selector.weight_plants) * among
    return TermLayer(name="plants", value=value, quantity=among)
