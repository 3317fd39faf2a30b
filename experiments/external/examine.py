"""The examinations of parts of every kind beside the estimator: what each is asked in the synthetic
world, and the checks of what it answered."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import Estimate, MapView
from touchdown.experiments.external.conformance import RULES as ESTIMATOR_RULES
from touchdown.experiments.external.examination import (
    COMMON_RULES,
    Check,
    Examination,
    Findings,
    checks_of,
)
from touchdown.experiments.external.examine_flight import (
    ControllerSession,
    LanderSession,
    continuity,
    limit,
    mission,
    steers,
    stop,
    touchdown,
)
from touchdown.experiments.external.loading import Build
from touchdown.experiments.external.part_checks import (
    ANSWER_RULES,
    lacks,
    wrong_classifier,
    wrong_lander,
    wrong_map,
    wrong_mapper,
    wrong_prediction,
    wrong_sites,
)
from touchdown.experiments.external.synthetic_stream import SyntheticStream, ground_height
from touchdown.experiments.external.synthetic_world import (
    DISC_M,
    DISC_XY,
    estimate_at,
    hovering,
    synthetic_map,
)
from touchdown.landing.api import RankedSites, SelectorInput
from touchdown.landing.selection.offered import selection_of
from touchdown.sim.api import Observation, SensorNeeds

Array = NDArray[np.float64]

# --------------------------------------------------------------------------------------- selector


@dataclass(slots=True)
class SelectorSession:
    """A map, the same after a refusal, in an emergency, mirrored, and one of nothing."""

    map: RankedSites | None = None
    taken: tuple[Any, ...] = ()
    mirrored: RankedSites | None = None
    empty: RankedSites | None = None

    def run(self, asked: Examination, part: Any) -> None:
        """Asks a selector for the sites of each."""

        def sites(seen: SelectorInput, when: str, rule: str = "answers") -> RankedSites:
            found: RankedSites = asked.ask(
                part, "select", seen, when=when, rule=rule,
                wrong=lambda offered: wrong_sites(offered, seen.map_view),
            )  # fmt: skip
            return found

        whole = SelectorInput(map_view=synthetic_map(), estimate=hovering(), reach_m=60.0)
        self.map = sites(whole, "of a map")
        self.taken = tuple(selection_of(self.map, whole, asked.rig.landing).candidates)
        accepted = sum(site.accepted for site in self.taken)
        figures = asked.findings.figures
        figures["sites"] = f"{len(self.map.sites)}, {accepted} accepted and mapped"
        for site in self.taken[:1]:
            x, y = site.position_odom[:2]
            away = float(np.hypot(x - DISC_XY[0], y - DISC_XY[1]))
            figures["first site"] = (
                f"({x:.1f}, {y:.1f}), slope {site.slope_deg:.1f} deg, {away:.1f} m from the middle "
                f"of a flat disc of {DISC_M:g} m"
            )
        first = [[*site.position_odom[:2], 0.0] for site in self.map.sites[:1]]
        places = np.array(first).reshape(-1, 3)
        sites(
            dataclasses.replace(
                whole, avoid_odom=places, unsafe_ground_odom=places, wind_mps=5.0
            ),
            "after a refusal",
        )  # fmt: skip
        sites(dataclasses.replace(whole, reach_m=2.0, emergency=True), "in an emergency")
        mirror = dataclasses.replace(whole, map_view=synthetic_map(mirrored=True))
        self.mirrored = sites(mirror, "of a mirrored map")
        nothing = dataclasses.replace(whole, map_view=synthetic_map(empty=True))
        self.empty = sites(nothing, "of an empty map", "missing data")


def order(seen: SelectorSession) -> str:
    """Sites are ranked by the sum of their terms, accepted ones of the highest first."""
    sites = () if seen.map is None else seen.map.sites
    values = [sum(term.value for term in site.terms) for site in sites if site.accepted]
    for number, (before, value) in enumerate(itertools.pairwise(values), start=2):
        if value > before + 1e-9:
            return f"accepted site {number} has the value {value:.4g}, above {before:.4g} before it"
    return ""


def ground(seen: SelectorSession) -> str:
    """Accepted sites lie on mapped ground, and follow it when the map is mirrored."""
    if seen.map is None:
        return ""
    if not seen.map.sites:
        return "no site on a map with a flat disc of 5 m radius"
    for number, site in enumerate(seen.taken, start=1):
        if site.rule == "not_seen":
            return f"site {number} lies where nothing is mapped"
    first, other = _first_accepted(seen.map), _first_accepted(seen.mirrored)
    if first is not None and other is not None and np.linalg.norm(first - other) < 1e-6:
        return "the first site stays where it is when the map is mirrored"
    return ""


def no_site_of_nothing(seen: SelectorSession) -> str:
    """No site is accepted where nothing is mapped."""
    accepted = seen.empty is not None and any(site.accepted for site in seen.empty.sites)
    return "a site is accepted where nothing is mapped" if accepted else ""


def _first_accepted(offered: RankedSites | None) -> Array | None:
    sites = () if offered is None else offered.sites
    return next((site.position_odom[:2] for site in sites if site.accepted), None)


# ----------------------------------------------------------------------------------------- mapper

OFF_M, LEAST_M2, _SCANS_S = 0.1, 3.0, 3.0
"""Largest median error of the heights, and least area mapped, after so many seconds."""


def true_estimate(stream: SyntheticStream, obs: Observation, tick_hz: int) -> Estimate:
    """The true pose of a synthetic flight as an estimate."""
    before, now = (stream.true_pose(max(tick, 0)) for tick in (obs.tick - 3, obs.tick))
    velocity = (now.translation - before.translation) * tick_hz / 3.0
    return estimate_at({"tick": obs.tick, "time_s": obs.time_s}, now, velocity)


@dataclass(slots=True)
class MapperSession:
    """Synthetic scans of rolling ground from true poses."""

    view: MapView | None = None
    versions: list[int] = field(default_factory=lambda: [-1])
    over: bool = False
    off_m: float = 0.0
    area_m2: float = 0.0

    def run(self, asked: Examination, part: Any) -> None:
        """Asks a mapper for its map after each scan."""
        sensors = asked.rig.sensors
        stream = SyntheticStream(sensors, part.needs | SensorNeeds(lidar=True), _SCANS_S)
        for obs in stream:
            rule = "answers" if self.versions[-1] > 0 else "missing data"
            estimate = true_estimate(stream, obs, sensors.tick_hz)
            self.view = asked.ask(
                part, "update", obs, estimate, when=f"at {obs.time_s:.3f} s", rule=rule,
                wrong=wrong_map, known=self.view,
                compared=lambda view: (view.version, view.coarse.height_m, view.coarse.count),
            )  # fmt: skip
            self.versions.append(self.view.version)
        self.over = True
        assert self.view is not None
        grid = self.view.coarse
        rows, cols = np.nonzero((grid.count > 0.0) & np.isfinite(grid.height_m))
        centres = grid.origin_xy_m + (np.column_stack([cols, rows]) + 0.5) * grid.cell_m
        errors = grid.height_m[rows, cols] - ground_height(centres)
        self.area_m2 = len(rows) * grid.cell_m**2
        self.off_m = float(np.median(abs(errors))) if len(rows) else 0.0
        text = f"{self.off_m:.3f} m off (median) over {self.area_m2:.0f} square metres"
        asked.findings.figures["heights"] = text


def heights(seen: MapperSession) -> str:
    """The median height of the map's cells is within 0.1 m of the ground, over 3 square metres or
    more."""
    if seen.over and seen.area_m2 < LEAST_M2:
        return f"{seen.area_m2:.1f} square metres are mapped after {_SCANS_S:g} s"
    return f"heights are {seen.off_m:.2f} m off (median)" if seen.off_m > OFF_M else ""


def version(seen: MapperSession) -> str:
    """Version does not fall, and rises with the scans."""
    for before, now in itertools.pairwise(seen.versions):
        if now < before:
            return f"version fell from {before} to {now}"
    risen = not seen.over or seen.versions[-1] > 0
    return "" if risen else f"version is {seen.versions[-1]} after {_SCANS_S:g} s of scans"


# ------------------------------------------------------------------------------------- classifier

_COLOURS = ((100, 130, 70), (170, 130, 95), (95, 95, 100), (60, 85, 110), (40, 60, 30))
_SAME, _ROUNDING = 1e-6, 1e-3


def textures(size: int) -> NDArray[np.uint8]:
    """(5, S, S, 3) RGB: a lawn, a field, a road, water and trees by their colours, with noise."""
    rng = np.random.default_rng(3)
    plain = np.array(_COLOURS, float)[:, None, None, :]
    noise = rng.normal(0.0, 12.0, (len(_COLOURS), size, size, 1))
    return np.clip(plain + noise, 0, 255).astype(np.uint8)


@dataclass(slots=True)
class ClassifierSession:
    """Textures of plain colours together, each alone, and a black image."""

    together: Array | None = None
    alone: list[Array] = field(default_factory=list)

    def run(self, asked: Examination, part: Any) -> None:
        """Asks a classifier for probabilities."""
        names = asked.rig.classes

        def table(images: NDArray[np.uint8], when: str, rule: str = "answers") -> Array:
            found = asked.ask(
                part, "classify", images, when=when, rule=rule,
                wrong=lambda answer: wrong_prediction(answer, len(images), len(names)),
            )  # fmt: skip
            probabilities: Array = found.probabilities
            return probabilities

        images = textures(part.image_size)
        self.together = table(images, "of five images")
        best = [(names[int(row.argmax())], row.max()) for row in self.together]
        asked.findings.figures["textures"] = ", ".join(f"{name} {p:.2f}" for name, p in best)
        for number, image in enumerate(images, start=1):
            self.alone.append(table(image[None], f"of image {number} alone")[0])
        table(np.zeros_like(images[:1]), "of a black image", "missing data")


def batch(seen: ClassifierSession) -> str:
    """An image is classified the same alone as among others."""
    for number, row in enumerate(seen.alone):
        assert seen.together is not None
        off = float(abs(row - seen.together[number]).max())
        if off > _ROUNDING:
            return f"image {number + 1} alone has probabilities {off:.2g} off"
    return ""


def images(seen: ClassifierSession) -> str:
    """Images of other colours have other probabilities."""
    if seen.together is None or np.ptp(seen.together, axis=0).max() >= _SAME:
        return ""
    return "five textures of other colours have the same probabilities"


# ------------------------------------------------------------------------------------------ table


class Kind(NamedTuple):
    """How parts of a kind are examined. ``wrong`` gives the defect of an object with its rig."""

    wrong: Callable[[Any, Any], str]
    session: Callable[[], Any]
    checks: tuple[Check, ...]


KINDS: Mapping[str, Kind] = {
    "selector": Kind(
        lambda part, _rig: lacks(part, "select"), SelectorSession,
        (*checks_of(order, ground), Check("missing data", no_site_of_nothing)),
    ),
    "controller": Kind(
        lambda part, _rig: lacks(part, "update"), ControllerSession, checks_of(steers, limit, stop)
    ),
    "classifier": Kind(
        lambda part, _rig: wrong_classifier(part), ClassifierSession,
        checks_of(batch, images),
    ),
    "mapper": Kind(
        lambda part, rig: wrong_mapper(part, rig.sensors), MapperSession,
        checks_of(heights, version),
    ),
    "lander": Kind(
        lambda part, rig: wrong_lander(part, rig.sensors), LanderSession,
        checks_of(continuity, mission, touchdown),
    ),
}  # fmt: skip


def _rules(name: str) -> Mapping[str, str]:
    own = {check.rule: check.sentence for check in KINDS[name].checks}
    return {**own, **COMMON_RULES, **ANSWER_RULES.get(name, {})}


RULES: Mapping[str, Mapping[str, str]] = {
    "estimator": ESTIMATOR_RULES, **{name: _rules(name) for name in KINDS}
}  # fmt: skip
"""Checked rules of each kind, by name."""


def examine(name: str, build: Build, rig: Any, params: Mapping[str, Any]) -> Findings:
    """The broken rules of a part of a kind, its latency and other figures."""
    kind = KINDS[name]
    asked = Examination(name, build, params, rig, lambda part: kind.wrong(part, rig))
    sessions: list[Any] = []

    def session(part: Any) -> None:
        sessions.append(kind.session())
        sessions[-1].run(asked, part)

    asked.twice(session)
    if sessions:
        asked.judge(kind.checks, sessions[0])
    return asked.findings
