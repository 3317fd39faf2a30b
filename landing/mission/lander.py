"""The lander: the landing state machine behind ``landing.api.Lander``."""

from __future__ import annotations

from touchdown.controller.api import Setpoint
from touchdown.estimator.api import Estimate, MapView
from touchdown.landing.api import GroundClassifier, LanderView, LandingParams, Phase, SurveyParams
from touchdown.landing.classification.site_check import SiteClassCheck
from touchdown.landing.mission.health import HealthWatch, give_up
from touchdown.landing.mission.mission_state import Mission, Select, Steps
from touchdown.landing.mission.phases import run_phases
from touchdown.sim.api import Observation, SensorNeeds, SensorRig


class SiteLander:
    """Takes off, surveys, selects a site in the map, checks it again during the descent and lands.

    Implements ``landing.api.Lander``. The sequence is ``landing.mission.phases.run_phases``, a
    generator that is resumed once a control step."""

    needs = SensorNeeds(camera_hz=5, lidar=True)

    def __init__(
        self,
        rig: SensorRig,
        params: LandingParams,
        survey: SurveyParams,
        classifier: GroundClassifier | None = None,
        select: Select | None = None,
    ) -> None:
        class_check = None if classifier is None else SiteClassCheck(classifier, rig, params)
        self._mission = Mission(rig, params, survey, class_check, select)
        self._steps: Steps = run_phases(self._mission)
        self._health = HealthWatch()

    @property
    def phase(self) -> Phase:
        """Current phase of the mission."""
        return self._mission.phase

    def update(self, obs: Observation, estimate: Estimate, map_view: MapView) -> Setpoint:
        """Returns the setpoint of this control step; called once a step."""
        mission = self._mission
        mission.update(obs, estimate, map_view)
        held = self._health.hold(mission)
        if held is not None:
            return held
        if self._health.lost(mission):
            self._steps = give_up(mission)
        return next(self._steps)

    def view(self) -> LanderView:
        """As `landing.api.Lander.view`."""
        mission = self._mission
        site_class = mission.site_class
        return LanderView(
            phase=mission.phase,
            note=mission.note,
            candidates=mission.candidates,
            costmap=mission.costmap,
            site_world=mission.site_world,
            committed_site_world=mission.committed_site_world,
            reference_world=mission.reference_world,
            no_site=mission.no_site,
            aborted=mission.aborted,
            site_class=None if site_class is None else site_class.name,
            site_class_probability=float("nan") if site_class is None else site_class.probability,
            events=tuple(mission.events),
            slowed_s=mission.slowed_s,
            decisions=mission.decisions,
        )
