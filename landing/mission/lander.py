"""The landing state machine as the main loop sees it."""

from __future__ import annotations

from touchdown.controller.api import Setpoint
from touchdown.estimator.api import Estimate, MapView
from touchdown.landing.api import GroundClassifier, LanderView, LandingParams, Phase, SurveyParams
from touchdown.landing.classification.site_check import SiteClassCheck
from touchdown.landing.mission.health import HealthWatch, give_up
from touchdown.landing.mission.mission_state import Flight, Steps
from touchdown.landing.mission.phases import fly
from touchdown.sim.api import Observation, SensorNeeds, SensorRig


class SiteLander:
    """Takes off, surveys, chooses a site from the map, looks again on the way down and lands.

    Implements ``landing.api.Lander``. The sequence itself is ``landing.mission.phases.fly``, a
    generator that is resumed once a control step."""

    needs = SensorNeeds(camera_hz=10, lidar=True)

    def __init__(
        self,
        rig: SensorRig,
        params: LandingParams,
        survey: SurveyParams,
        places: GroundClassifier | None = None,
    ) -> None:
        check = None if places is None else SiteClassCheck(places, rig, params)
        self._flight = Flight(rig, params, survey, check)
        self._steps: Steps = fly(self._flight)
        self._health = HealthWatch()

    @property
    def phase(self) -> Phase:
        return self._flight.phase

    def update(self, obs: Observation, estimate: Estimate, map_view: MapView) -> Setpoint:
        """The setpoint of this control step; call once a step."""
        flight = self._flight
        flight.take_in(obs, estimate, map_view)
        held = self._health.hold(flight)
        if held is not None:
            return held
        if self._health.lost(flight):
            self._steps = give_up(flight)
        return next(self._steps)

    def view(self) -> LanderView:
        flight = self._flight
        place = flight.site_place
        return LanderView(
            phase=flight.phase,
            note=flight.note,
            candidates=flight.candidates,
            costmap=flight.costmap,
            site_world=flight.site_world,
            committed_site_world=flight.committed_site_world,
            reference_world=flight.reference_world,
            no_site=flight.no_site,
            aborted=flight.aborted,
            site_class=None if place is None else place.name,
            site_class_probability=float("nan") if place is None else place.probability,
        )
