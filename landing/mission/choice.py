"""One landing decision: candidate sites of the map, checked by ground classification."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from touchdown.landing.api import Candidate, Decision, Selection, SelectorInput
from touchdown.landing.classification.site_check import SiteClassCheck, least_bad
from touchdown.landing.mission.mission_state import Mission
from touchdown.landing.selection.ranking import ranked, why_chosen
from touchdown.landing.selection.selector import check_site

Array = NDArray[np.float64]


def choose_sites(mission: Mission) -> tuple[Candidate, ...]:
    """Returns candidates, accepted ones first, best first; sets ``mission.costmap``.

    With ground classification: where no candidate lies on safe ground, sites are selected again,
    preferably not on the refused surfaces, in at most ``classifier_rounds`` rounds. In an emergency
    there is one round, and the least bad of its refused sites is accepted."""
    selection = _select(mission, ())
    class_check = mission.class_check
    if class_check is None:
        return selection.candidates
    emergency, refused = mission.in_emergency, list[Candidate]()
    for left in reversed(range(1 if emergency else max(mission.params.classifier_rounds, 1))):
        checked = _checked(mission, class_check, selection)
        if any(site.accepted for site in checked):
            return (*ranked(checked), *refused)
        offered = [
            after
            for before, after in zip(selection.candidates, checked, strict=True)
            if before.accepted
        ]
        mission.unsafe_ground_odom += [
            s.position_odom for s in offered if s.class_predicted is not None
        ]
        refused += offered
        if not offered or left == 0:
            break
        selection = _select(mission, [site.position_odom for site in refused])
    others = [site for site in selection.candidates if not site.accepted]
    return (*(least_bad(refused) if emergency else refused), *others)


def choose_commanded(mission: Mission, wanted: Array) -> Candidate:
    """Returns the commanded site ``wanted`` (2,), accepted or refused with the reason."""
    candidate, mission.costmap = check_site(
        mission.map_view, mission.estimate, mission.params, wanted
    )
    if mission.class_check is None or not candidate.accepted:
        return candidate
    (checked,) = mission.class_check.judge(
        (candidate,), mission.map_view, allow_risky=mission.takes_risky
    )
    return checked


def decided(mission: Mission, candidates: tuple[Candidate, ...]) -> Decision:
    """Returns the decision for the first of ``candidates``, with the reasons."""
    positions = [mission.world(site.position_odom) for site in candidates]
    return Decision(
        time_s=mission.obs.time_s,
        selector=mission.params.selector,
        candidates=candidates,
        positions_world=np.array(positions, np.float64).reshape(-1, 3),
        why=why_chosen(candidates),
    )


def _checked(
    mission: Mission, class_check: SiteClassCheck, selection: Selection
) -> list[Candidate]:
    return class_check.judge(
        selection.candidates, mission.map_view, selection=selection, allow_risky=mission.takes_risky
    )


def _select(mission: Mission, avoid_odom: Sequence[Array]) -> Selection:
    seen = SelectorInput(
        map_view=mission.map_view,
        estimate=mission.estimate,
        reach_m=mission.reach_m(),
        avoid_odom=np.reshape([*mission.refused_odom, *avoid_odom], (-1, 3)),
        unsafe_ground_odom=np.reshape(mission.unsafe_ground_odom, (-1, 3)),
        wind_mps=mission.wind.speed_mps,
        semantics=None if mission.class_check is None else mission.class_check.semantic_view(),
        emergency=mission.in_emergency,
    )
    selection = mission.select(seen)
    mission.costmap = selection.costmap
    return selection
