"""Where a vehicle would have landed: the map of a recording, and the site that is chosen on it."""

from pathlib import Path

import numpy as np

from touchdown.estimator.api import Estimate, MapperParams, MapView
from touchdown.estimator.mapping.mapper import GridMapper
from touchdown.landing.api import (
    LanderView,
    LandingParams,
    Phase,
    SelectorInput,
    SelectorRig,
)
from touchdown.sim.api import Observation, SensorRig
from touchdown.sim.typing import Array

_DOWN = 0.4
"""fraction of a scan's returns that lie steeply below the LIDAR, from which on it looks down"""
_STEEP = 0.7
"""cosine between a beam and the vertical"""
_ROWS = 4096
"""positions of the way that are drawn"""


class LandingSite:
    """Maps while a recording is replayed, and chooses a site on the map in the end."""

    def __init__(self, rig: SensorRig, mapper: MapperParams, landing: LandingParams) -> None:
        self._rig, self._landing = rig, landing
        self._mapper = GridMapper(rig, mapper)
        self._last: tuple[Estimate, MapView] | None = None
        self._way: list[Array] = []
        self._steep: list[float] = []

    def take(self, obs: Observation, estimate: Estimate) -> None:
        """Takes an observation and the estimate after it."""
        self._last = estimate, self._mapper.update(obs, estimate)
        for scan in obs.scans:
            mount = estimate.odom_from_body.rotation @ self._rig.body_from_lidar.rotation
            beams = scan.directions[scan.ranges > 0.0]
            self._steep.append(float(np.mean(beams @ -mount[2] > _STEEP)) if len(beams) else 0.0)
            if len(self._way) < _ROWS:
                self._way.append(estimate.world_from_body.translation[:2])

    def write(self, folder: Path) -> str:
        """Writes ``map.ply`` and, where the LIDAR looked down, ``costmap.png``; returns in a
        sentence where it would have landed, or why nothing is said."""
        from touchdown.experiments.drawing.costmap_image import write_costmap
        from touchdown.experiments.drawing.map_images import (
            Marks,
            map_points,
            transform_points,
            write_ply,
        )
        from touchdown.landing.selection.selector import select_sites

        if self._last is None or not self._steep:
            return "no scan reached the map: no landing site is chosen"
        estimate, view = self._last
        world_from_odom = estimate.world_from_odom
        points, colours = map_points(view.coarse)
        if len(points):
            write_ply(folder / "map.ply", transform_points(world_from_odom, points), colours)
        if np.median(self._steep) < _DOWN:
            return "the LIDAR does not look down: no landing site is chosen"
        chosen = select_sites(
            SelectorInput(map_view=view, estimate=estimate),
            SelectorRig(vehicle=self._rig.vehicle, landing=self._landing),
        )
        if chosen.costmap is None:
            return "too little ground is mapped to choose a landing site"
        site = next((one for one in chosen.candidates if one.accepted), None)
        at = None if site is None else world_from_odom.apply(site.position_odom)
        shown = LanderView(
            phase=Phase.SELECT, reference_world=estimate.world_from_body.translation,
            candidates=chosen.candidates, costmap=chosen.costmap, site_world=at,
        )  # fmt: skip
        marks = Marks(takeoff_xy_m=self._way[0], yaw=0.0, path_xy_m=np.array(self._way))
        position = None if site is None else site.position_odom
        write_costmap(folder / "costmap.png", shown, position, world_from_odom, marks)
        if at is None:
            return "no ground on the map is safe to land on (costmap.png)"
        return f"it would have landed at x {at[0]:.1f} m, y {at[1]:.1f} m (costmap.png)"
