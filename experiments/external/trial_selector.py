"""The examination of a selector on a synthetic map: rolling ground, a flat disc, a pond, a gap."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Generator, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import Estimate, GridMap, MapView
from touchdown.experiments.external.conformance_report import Findings
from touchdown.experiments.external.loading import Build
from touchdown.experiments.external.part_checks import lacks, wrong_sites
from touchdown.experiments.external.trial import COMMON_RULES, Trial
from touchdown.landing.api import RankedSites, SelectorInput, SelectorRig, Site
from touchdown.landing.selection.offered import selection_of
from touchdown.sim.frames import Pose

Array = NDArray[np.float64]

RULES: Mapping[str, str] = {
    **COMMON_RULES,
    "terms": "every site has the same named terms, one or more, and the layers are of these",
    "order": "sites are ranked by the sum of their terms, accepted ones of the highest first",
    "ground": "accepted sites lie on mapped ground, and follow it when the map is mirrored",
}

_CELLS, _CELL_M, _TAKE_OFF = 240, 0.25, (0.0, 0.0)
_DISC_XY, _DISC_M = (12.0, -9.0), 5.0
_POND_XY, _POND_M = (-11.0, 8.0), 6.0
_BUMPS_M = 0.35


def synthetic_map(*, mirrored: bool = False, empty: bool = False) -> MapView:
    """A map of 60 m by 60 m about the take-off point: bumps of 0.35 m, a flat disc of 5 m radius at
    (12, -9), a pond of 6 m at (-11, 8) with missing pulses, nothing seen at the rim of 6 m.
    ``mirrored``: x and -x changed; ``empty``: nothing seen at all."""
    rng = np.random.default_rng(7)
    origin = np.full(2, -0.5 * _CELLS * _CELL_M)
    at = origin[0] + (np.arange(_CELLS) + 0.5) * _CELL_M
    x, y = np.meshgrid(-at if mirrored else at, at)
    bumps = _BUMPS_M * np.sin(1.7 * x + 0.4) * np.sin(1.3 * y)
    disc = np.hypot(x - _DISC_XY[0], y - _DISC_XY[1]) < _DISC_M
    pond = np.hypot(x - _POND_XY[0], y - _POND_XY[1]) < _POND_M
    height = np.where(disc | pond, 0.0, bumps)
    seen = (np.maximum(abs(x), abs(y)) < -origin[0] - 6.0) & ~pond & (not empty)
    noise = rng.normal(0.0, 0.01, height.shape)
    shape = np.where(seen, 1.0, np.nan)

    def layer(values: Any) -> NDArray[np.float32]:
        return np.asarray(values * shape, np.float32)

    grid = GridMap(
        origin_xy_m=origin,
        cell_m=_CELL_M,
        count=np.where(seen, 12.0, 0.0).astype(np.float32),
        height_m=layer(height + noise),
        height_std_m=layer(0.02),
        min_height_m=layer(height + noise - 0.03),
        max_height_m=layer(height + noise + 0.03),
        rgb=np.stack([layer(90.0 + 20.0 * np.sin(x + y))] * 3, axis=-1),
        intensity=layer(60.0),
        missing=np.where(pond & (not empty), 9.0, 0.0).astype(np.float32),
        last_seen_s=np.where(seen, np.float32(20.0), np.float32(-np.inf)),
    )
    return MapView(version=0 if empty else 200, coarse=grid, fine=None)


def hovering() -> Estimate:
    """An estimate 15 m above the middle of the map, at rest."""
    return Estimate(
        tick=18000,
        time_s=30.0,
        odom_from_body=Pose(np.eye(3), np.array([1.0, 2.0, 15.0])),
        world_from_odom=Pose.identity(),
        velocity_odom=np.zeros(3),
        angular_velocity_body=np.zeros(3),
        acceleration_odom=np.zeros(3),
        position_covariance=1e-3 * np.eye(3),
        rotation_covariance=1e-5 * np.eye(3),
    )


def examine_selector(build: Build, rig: SelectorRig, params: Mapping[str, Any]) -> Findings:
    """The broken rules of a selector and its latency."""
    trial = Trial("selector", build, params, rig, lambda part: lacks(part, "select"))
    trial.sessions(lambda part: _session(trial, part))
    return trial.findings


def _session(trial: Trial, part: Any) -> Iterator[Any]:
    whole = SelectorInput(map_view=synthetic_map(), estimate=hovering(), reach_m=60.0)
    first = yield from _asked(trial, part, whole, "of a map")
    if first is None:
        return
    _judge_order(trial, first)
    _judge_ground(trial, first, whole)
    places = np.array([[*site.position_odom[:2], 0.0] for site in first.sites[:1]]).reshape(-1, 3)
    refused = dataclasses.replace(whole, avoid_odom=places, unsafe_ground_odom=places, wind_mps=5.0)
    yield from _asked(trial, part, refused, "after a refusal")
    hurry = dataclasses.replace(whole, reach_m=2.0, emergency=True)
    yield from _asked(trial, part, hurry, "in an emergency")
    mirror = dataclasses.replace(whole, map_view=synthetic_map(mirrored=True))
    other = yield from _asked(trial, part, mirror, "of a mirrored map")
    if other is not None and _same_place(first, other):
        trial.note("ground", "the first site stays where it is when the map is mirrored")
    nothing = dataclasses.replace(whole, map_view=synthetic_map(empty=True))
    blind = yield from _asked(trial, part, nothing, "of an empty map", "missing data")
    if blind is not None and any(site.accepted for site in blind.sites):
        trial.note("missing data", "a site is accepted where nothing is mapped")


def _asked(
    trial: Trial, part: Any, seen: SelectorInput, what: str, rule: str = "answers"
) -> Generator[Any, None, RankedSites | None]:
    """Yields an answer for comparison; returns it, None where it is wrong."""
    answer = trial.ask(part, "select", seen, when=what, rule=rule)
    if answer is None and trial.broke(rule):
        return None
    yield answer
    wrong = wrong_sites(answer, seen.map_view)
    trial.judge(wrong, f"{what} select returned")
    return answer if wrong is None else None


def _judge_order(trial: Trial, offered: RankedSites) -> None:
    values = [sum(term.value for term in site.terms) for site in offered.sites if site.accepted]
    for number, (before, value) in enumerate(itertools.pairwise(values), start=2):
        if value > before + 1e-9:
            text = f"accepted site {number} has the value {value:.4g}, above {before:.4g} before it"
            trial.note("order", text)


def _judge_ground(trial: Trial, offered: RankedSites, seen: SelectorInput) -> None:
    if not offered.sites:
        trial.note("ground", "no site on a map with a flat disc of 5 m radius")
        return
    taken = selection_of(offered, seen, trial.rig.landing).candidates
    count = sum(site.accepted for site in taken)
    trial.findings.figures["sites"] = f"{len(offered.sites)}, {count} accepted and mapped"
    first = taken[0]
    x, y = first.position_odom[:2]
    away = float(np.hypot(x - _DISC_XY[0], y - _DISC_XY[1]))
    trial.findings.figures["first site"] = (
        f"({x:.1f}, {y:.1f}), slope {first.slope_deg:.1f} deg, {away:.1f} m from the middle of a "
        f"flat disc of {_DISC_M:g} m"
    )
    for number, site in enumerate(taken, start=1):
        if site.rule == "not_seen":
            trial.note("ground", f"site {number} lies where nothing is mapped")


def _same_place(one: RankedSites, other: RankedSites) -> bool:
    def first(offered: RankedSites) -> Site | None:
        return next((site for site in offered.sites if site.accepted), None)

    a, b = first(one), first(other)
    if a is None or b is None:
        return False
    return bool(np.linalg.norm(a.position_odom[:2] - b.position_odom[:2]) < 1e-6)
