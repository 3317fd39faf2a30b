"""When the watch is asked, and what it is told."""

import dataclasses
from typing import Any

import numpy as np

from touchdown.estimator.api import Estimate, GridMap, MapView
from touchdown.landing.api import LandingParams, Phase, Watch, WatchInput, WatchReport
from touchdown.landing.mission.state import MissionState
from touchdown.sim.api import Observation
from touchdown.sim.typing import Array

HIGHEST_M = 15.0
"""height of the legs above the ground below which the watch looks"""
_WATCHED = frozenset({Phase.APPROACH, Phase.DESCEND, Phase.RETURN})
_KNOWN_M = 8.0
"""half the side of the map that is remembered around a site"""
_SAME_SITE_M = 3.0
_SLOW_M = 0.2
"""height from which the vehicle sinks at touchdown speed"""


class Lookout:
    """Asks the watch, and remembers the map around sites as it was when they were chosen: around
    the take-off spot at the end of the climb, around any other place when it becomes the site."""

    def __init__(self, watch: Watch, params: LandingParams, leg_height_m: float) -> None:
        self._watch, self._params, self._leg_height = watch, params, leg_height_m
        self._home: GridMap | None = None
        self._site: GridMap | None = None
        self._decisions = 0
        self._report: WatchReport | None = None

    def look(
        self,
        state: MissionState,
        start_odom: Array,
        obs: Observation,
        estimate: Estimate,
        map_view: MapView,
    ) -> WatchReport | None:
        """Returns what the watch says; None where it does not look. ``start_odom`` (3,): the
        take-off spot."""
        if self._home is None and state.phase in (Phase.SURVEY, Phase.RETURN):
            self._home = window(map_view.coarse, start_odom)
        site, before = state.site_odom, self._report
        self._report = None
        if site is None:
            return None
        known = self._known(site, len(state.decisions), map_view.coarse)
        height = float(estimate.odom_from_body.translation[2] - site[2])
        if before is not None and np.isfinite(before.height_m):
            height = before.height_m
        legs = max(height - self._leg_height, 0.0)
        if state.phase not in _WATCHED or legs >= HIGHEST_M:
            return None
        seen = WatchInput(
            obs=obs, estimate=estimate, map_view=map_view, site_odom=site,
            touchdown_s=self._left_s(legs), known=known,
        )  # fmt: skip
        self._report = self._watch.look(seen)
        return self._report

    def _left_s(self, legs_m: float) -> float:
        """Time until the touchdown, by the speeds that are set."""
        params, low = self._params, min(legs_m, self._params.commit_height_m)
        slow = min(low, _SLOW_M) / params.touchdown_speed_mps
        return (legs_m - low) / params.descent_speed_mps + low / params.final_speed_mps + slow

    def _known(self, site: Array, decisions: int, grid: GridMap) -> GridMap | None:
        if decisions != self._decisions:
            self._decisions, self._site = decisions, window(grid, site)
        for known in (self._site, self._home):
            if known is not None and _off_m(known, site) < _SAME_SITE_M:
                return known
        self._site = window(grid, site)
        return self._site


def window(grid: GridMap, middle: Array) -> GridMap | None:
    """Returns a copy of the map within 8 m of a point (2,) or (3,); None off the map."""
    rows, cols = grid.height_m.shape
    reach = round(_KNOWN_M / grid.cell_m)
    col, row = np.floor((middle[:2] - grid.origin_xy_m) / grid.cell_m).astype(int).tolist()
    if not (0 <= row < rows and 0 <= col < cols):
        return None
    first, last = (max(row - reach, 0), max(col - reach, 0)), (row + reach + 1, col + reach + 1)
    box = np.s_[first[0] : last[0], first[1] : last[1]]
    layers: dict[str, Any] = {
        field.name: layer[box].copy()
        for field in dataclasses.fields(grid)
        if isinstance(layer := getattr(grid, field.name), np.ndarray) and layer.ndim > 1
    }
    corner = grid.origin_xy_m + grid.cell_m * np.array([first[1], first[0]])
    return dataclasses.replace(grid, origin_xy_m=corner, **layers)


def _off_m(known: GridMap, site: Array) -> float:
    rows, cols = known.height_m.shape
    middle = known.origin_xy_m + 0.5 * known.cell_m * np.array([cols, rows])
    return float(np.linalg.norm(middle - site[:2]))
