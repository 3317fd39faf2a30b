"""A site selector: the largest flat disc of the map, by a distance transform.

touchdown land crossroad --selector examples.flat_disc:build
"""

import numpy as np
from scipy.ndimage import distance_transform_edt, maximum_filter, minimum_filter, uniform_filter

from touchdown.landing import api


class FlatDisc:
    """Ranks sites by the radius of the flat disc around them, less a little for the way there."""

    def __init__(self, params: dict, rig: api.SelectorRig) -> None:
        self.window_m = params.get("window_m", 1.2)  # side of the square that must be flat
        self.max_m = params.get("max_m", 3.0)  # a larger disc is no better
        self.spacing_m, self.count = rig.landing.candidate_spacing_m, rig.landing.max_candidates
        slope = np.tan(np.radians(rig.landing.max_slope_deg))
        self.rise_m = rig.landing.max_step_m + slope * self.window_m

    def select(self, seen: api.SelectorInput) -> api.RankedSites:
        grid = seen.map_view.coarse
        known = grid.count >= 4.0
        if not known.any():
            return api.RankedSites(sites=())
        width = round(self.window_m / grid.cell_m) | 1
        high = maximum_filter(np.where(known, grid.max_height_m, np.inf), width)
        low = minimum_filter(np.where(known, grid.min_height_m, -np.inf), width)
        dry = uniform_filter(grid.missing, width) < 0.1 * uniform_filter(grid.count, width)
        flat = dry & (high - low < self.rise_m)
        disc = np.minimum(distance_transform_edt(flat) * grid.cell_m, self.max_m)
        x = grid.origin_xy_m[0] + (np.arange(flat.shape[1]) + 0.5) * grid.cell_m
        y = grid.origin_xy_m[1] + (np.arange(flat.shape[0])[:, None] + 0.5) * grid.cell_m
        here = seen.estimate.odom_from_body.translation
        way = np.hypot(x - here[0], y - here[1])
        layers = (
            api.TermLayer(name="disc", value=np.where(flat, disc, np.nan), quantity=disc, unit="m"),
            api.TermLayer(name="distance", value=-0.01 * way, quantity=way, unit="m"),
        )
        score = np.where(flat, disc - 0.01 * way, -np.inf)
        sites: list[api.Site] = []
        while len(sites) < self.count and np.isfinite(score).any():
            row, col = np.unravel_index(np.argmax(score), score.shape)
            place = np.array([x[col], y[row, 0]])
            at = [(a.name, float(a.value[row, col]), float(a.quantity[row, col])) for a in layers]
            terms = tuple(api.ScoreTerm(name=n, value=v, quantity=q, unit="m") for n, v, q in at)
            sites.append(api.Site(position_odom=place, terms=terms))
            score[np.hypot(x - place[0], y - place[1]) < self.spacing_m] = -np.inf
        return api.RankedSites(sites=tuple(sites), layers=layers)


def build(params: dict, rig: api.SelectorRig) -> FlatDisc:
    return FlatDisc(params, rig)
