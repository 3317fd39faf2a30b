"""A mapper without a map, for flights that need positions only."""

from __future__ import annotations

import dataclasses

from touchdown.estimator.api import Estimate, Mapper, MapView
from touchdown.sim.api import Observation, SensorNeeds


class NoMap:
    """Implements ``estimator.api.Mapper``: returns the view of ``mapper`` before its first scan."""

    needs = SensorNeeds()

    def __init__(self, mapper: Mapper) -> None:
        self._mapper = mapper
        self._view: MapView | None = None

    def update(self, obs: Observation, estimate: Estimate) -> MapView:
        """Returns the same empty view every time."""
        if self._view is None:
            blind = dataclasses.replace(obs, scans=(), images=())
            self._view = self._mapper.update(blind, estimate)
        return self._view
