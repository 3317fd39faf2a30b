"""One decision: the sites that the map offers, and what ground classification leaves of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from touchdown.landing.api import Candidate, Selection
from touchdown.landing.classification.site_check import SiteClassCheck, least_bad
from touchdown.landing.mission.mission_state import Flight
from touchdown.landing.selection.selector import check_site, select_sites

Array = NDArray[np.float64]


def choose_sites(flight: Flight) -> tuple[Candidate, ...]:
    """Candidates, accepted ones first, best first; ``flight.costmap`` becomes the decision's.

    With ground classification: where no candidate's ground is safe, others are looked for, rather
    not on the surfaces that were refused, ``place_rounds`` times in all. In an emergency there is
    one round, and the least bad of what it refused is accepted."""
    selection = _select(flight, ())
    places = flight.places
    if places is None:
        return selection.candidates
    emergency, refused = flight.in_emergency, list[Candidate]()
    for left in reversed(range(1 if emergency else max(flight.params.place_rounds, 1))):
        judged = _judged(flight, places, selection)
        if any(site.accepted for site in judged):
            ranked = sorted(judged, key=lambda site: not site.accepted)
            return (*ranked, *refused)
        offered = [
            after
            for before, after in zip(selection.candidates, judged, strict=True)
            if before.accepted
        ]
        flight.alike_odom += [s.position_odom for s in offered if s.class_predicted is not None]
        refused += offered
        if not offered or left == 0:
            break
        selection = _select(flight, [site.position_odom for site in refused])
    others = [site for site in selection.candidates if not site.accepted]
    return (*(least_bad(refused) if emergency else refused), *others)


def choose_commanded(flight: Flight, wanted: Array) -> Candidate:
    """The commanded site ``wanted`` (2,): accepted or refused with the reason."""
    candidate, flight.costmap = check_site(flight.map_view, flight.estimate, flight.params, wanted)
    if flight.places is None or not candidate.accepted:
        return candidate
    (judged,) = flight.places.judge((candidate,), flight.map_view, allow_risky=flight.takes_risky)
    return judged


def _judged(flight: Flight, places: SiteClassCheck, selection: Selection) -> list[Candidate]:
    return places.judge(
        selection.candidates,
        flight.map_view,
        selection=selection,
        allow_risky=flight.takes_risky,
    )


def _select(flight: Flight, avoid_odom: Sequence[Array]) -> Selection:
    selection = select_sites(
        flight.map_view,
        flight.estimate,
        flight.params,
        footprint_radius_m=flight.rig.vehicle.footprint_radius_m,
        reach_m=flight.reach_m(),
        avoid_odom=(*flight.refused_odom, *avoid_odom),
        alike_odom=flight.alike_odom,
        wind_mps=flight.wind.speed_mps,
        least_bad=flight.in_emergency,
    )
    flight.costmap = selection.costmap
    return selection
