"""One landing decision: candidate sites of the map, checked by ground classification."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from touchdown.landing.api import Candidate, CostmapView, Decision, Selection, SelectorInput
from touchdown.landing.classification.site_check import SiteClassCheck, least_bad
from touchdown.landing.mission.energy import reach_m
from touchdown.landing.mission.mission import Mission
from touchdown.landing.mission.site_recheck import ground_under
from touchdown.landing.selection.ranking import ranked, why_chosen
from touchdown.landing.selection.selector import check_site
from touchdown.sim.typing import Array


class Choice(NamedTuple):
    """Candidates, accepted ones first, best first, and the costmap that they are from."""

    candidates: tuple[Candidate, ...]
    costmap: CostmapView | None


def choose_sites(mission: Mission) -> Choice:
    """Returns the candidates of the map.

    With ground classification: where no candidate lies on safe ground, sites are selected again,
    preferably not on the refused surfaces, in at most ``classifier_rounds`` rounds. In an emergency
    there is one round, and the least bad of its refused sites is accepted."""
    selection = _select(mission, ())
    class_check = mission.class_check
    if class_check is None:
        return Choice(selection.candidates, selection.costmap)
    emergency, refused = mission.view.in_emergency, list[Candidate]()
    for left in reversed(range(1 if emergency else max(mission.params.classifier_rounds, 1))):
        checked = _checked(mission, class_check, selection)
        if any(site.accepted for site in checked):
            return Choice((*ranked(checked), *refused), selection.costmap)
        offered = [
            after
            for before, after in zip(selection.candidates, checked, strict=True)
            if before.accepted
        ]
        mission.state.refuse_ground(
            s.position_odom for s in offered if s.class_predicted is not None
        )
        refused += offered
        if not offered or left == 0:
            break
        selection = _select(mission, [site.position_odom for site in refused])
    others = [site for site in selection.candidates if not site.accepted]
    return Choice((*(least_bad(refused) if emergency else refused), *others), selection.costmap)


def choose_commanded(mission: Mission, wanted: Array) -> Choice:
    """Returns the commanded site ``wanted`` (2,), accepted in any case without ``check_site``."""
    view = mission.view
    site, costmap = check_site(view.map_view, view.estimate, mission.params, wanted)
    if mission.class_check is not None and site.accepted:
        (site,) = mission.class_check.judge((site,), view.map_view, allow_risky=view.takes_risky)
    if not (site.accepted or mission.params.check_site):
        height = ground_under(view.map_view, wanted)
        site = dataclasses.replace(
            site,
            position_odom=np.array([*wanted, height if np.isfinite(height) else view.ground_odom]),
            accepted=True,
            rule="commanded_unchecked",
            reason=f"accepted unchecked; by the map: {site.reason}",
        )
    return Choice((site,), costmap)


def decided(mission: Mission, candidates: tuple[Candidate, ...]) -> Decision:
    """Returns the decision for the first of ``candidates``, with the reasons."""
    view = mission.view
    # A site on ground that was not seen has no height.
    known = (np.nan_to_num(site.position_odom, nan=view.ground_odom) for site in candidates)
    positions = [view.world(position) for position in known]
    return Decision(
        time_s=view.obs.time_s,
        selector=mission.params.selector,
        candidates=candidates,
        positions_world=np.array(positions, np.float64).reshape(-1, 3),
        why=why_chosen(candidates),
    )


def _checked(
    mission: Mission, class_check: SiteClassCheck, selection: Selection
) -> list[Candidate]:
    view = mission.view
    return class_check.judge(
        selection.candidates, view.map_view, selection=selection, allow_risky=view.takes_risky
    )


def _select(mission: Mission, avoid_odom: Sequence[Array]) -> Selection:
    view, state, check = mission.view, mission.state, mission.class_check
    return mission.select(
        SelectorInput(
            map_view=view.map_view,
            estimate=view.estimate,
            reach_m=reach_m(view, state),
            avoid_odom=np.reshape([*state.refused_odom, *avoid_odom], (-1, 3)),
            unsafe_ground_odom=np.reshape(state.unsafe_ground_odom, (-1, 3)),
            wind_mps=view.wind_mps,
            semantics=None if check is None else check.semantic_view(),
            emergency=view.in_emergency,
        )
    )
