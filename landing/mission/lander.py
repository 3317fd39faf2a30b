"""The lander: the landing state machine behind ``landing.api.Lander``."""

from touchdown.controller.api import Setpoint
from touchdown.estimator.api import Estimate, MapView
from touchdown.landing.api import (
    GroundClassifier,
    LanderView,
    LandingParams,
    Phase,
    SurveyParams,
    Watch,
)
from touchdown.landing.classification.site_check import SiteClassCheck
from touchdown.landing.mission.mission import (
    Mission,
    Select,
    SiteGivenUpError,
    SiteMovedError,
    Steps,
)
from touchdown.landing.mission.phases import abort, run_phases
from touchdown.landing.mission.rules import Action, Moment
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
        watch: Watch | None = None,
    ) -> None:
        class_check = None if classifier is None else SiteClassCheck(classifier, rig, params)
        self._mission = Mission(rig, params, survey, class_check, select, watch)
        self._steps: Steps = run_phases(self._mission)

    @property
    def phase(self) -> Phase:
        """Current phase of the mission."""
        return self._mission.state.phase

    def update(self, obs: Observation, estimate: Estimate, map_view: MapView) -> Setpoint:
        """Returns the setpoint of this control step; called once a step."""
        mission = self._mission
        mission.update(obs, estimate, map_view)
        ruling = mission.ask(Moment.STEP)
        if ruling is not None and ruling.action is Action.HOLD:
            return mission.hold()
        if ruling is not None and ruling.action is Action.GIVE_WAY:
            try:
                return mission.give_way()
            except (SiteGivenUpError, SiteMovedError) as change:
                return self._steps.throw(change)
        if ruling is not None and ruling.action is Action.LAND_BLIND:
            mission.end_lift()
            self._steps = abort(mission)
        return next(self._steps)

    def view(self) -> LanderView:
        """As `landing.api.Lander.view`."""
        mission, state = self._mission, self._mission.state
        site, site_class = state.committed_site_world, state.site_class
        if site is None and state.site_odom is not None:
            site = mission.view.world(state.site_odom)
        return LanderView(
            phase=state.phase,
            note=state.note,
            candidates=state.candidates,
            costmap=state.costmap,
            site_world=site,
            committed_site_world=state.committed_site_world,
            reference_world=mission.reference_world,
            no_site=state.no_site,
            aborted=state.aborted,
            site_class=None if site_class is None else site_class.name,
            site_class_probability=float("nan") if site_class is None else site_class.probability,
            events=state.events,
            slowed_s=state.slowed_s,
            decisions=state.decisions,
            watch=mission.view.watch,
        )
