"""The examinations of parts of every kind beside the estimator: what each is asked in the synthetic
world, and the checks of what it answered."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchdown.controller.api import Setpoint
from touchdown.estimator.api import Estimate, MapView
from touchdown.experiments.external.conformance import CHECKS as ESTIMATOR_CHECKS
from touchdown.experiments.external.examination import Findings, Kind, Session, examine_as
from touchdown.experiments.external.loading import Build
from touchdown.experiments.external.synthetic_stream import (
    SyntheticStream,
    ground_height,
    minimum_jerk,
)
from touchdown.experiments.external.synthetic_world import (
    DISC_M,
    DISC_XY,
    FollowedSetpoints,
    SyntheticAirframe,
    estimate_at,
    hovering,
    synthetic_map,
)
from touchdown.landing.api import Candidate, Phase, RankedSites, SelectorInput
from touchdown.landing.selection.offered import selection_of
from touchdown.sim.api import GRAVITY_MPS2, Observation, SensorNeeds

Array = NDArray[np.float64]

# --------------------------------------------------------------------------------------- selector


class _Selected(NamedTuple):
    """Sites of a map, as candidates, of its mirror image, and of a map of nothing."""

    sites: RankedSites
    candidates: tuple[Candidate, ...]
    mirrored: RankedSites
    of_nothing: RankedSites


def _ask_selector(session: Session) -> _Selected:
    whole = SelectorInput(map_view=synthetic_map(), estimate=hovering(), reach_m=60.0)

    def sites(when: str, rule: str = "answers", **changes: Any) -> RankedSites:
        seen = dataclasses.replace(whole, **changes)
        found: RankedSites = session.ask("select", seen, when=when, rule=rule)
        return found

    found = sites("of a map")
    candidates = tuple(selection_of(found, whole, session.rig.landing).candidates)
    accepted = sum(site.accepted for site in candidates)
    session.figures["sites"] = f"{len(found.sites)}, {accepted} accepted and mapped"
    for site in candidates[:1]:
        x, y = site.position_odom[:2]
        session.figures["first site"] = (
            f"({x:.1f}, {y:.1f}), slope {site.slope_deg:.1f} deg, "
            f"{np.hypot(x - DISC_XY[0], y - DISC_XY[1]):.1f} m from the middle of a flat disc of "
            f"{DISC_M:g} m"
        )
    first = np.array([[*site.position_odom[:2], 0.0] for site in found.sites[:1]]).reshape(-1, 3)
    sites("after a refusal", avoid_odom=first, unsafe_ground_odom=first, wind_mps=5.0)
    sites("in an emergency", reach_m=2.0, emergency=True)
    return _Selected(
        found,
        candidates,
        sites("of a mirrored map", map_view=synthetic_map(mirrored=True)),
        sites("of an empty map", "missing data", map_view=synthetic_map(empty=True)),
    )


def order(seen: _Selected) -> str:
    """Sites are ranked by the sum of their terms, accepted ones of the highest first."""
    values = [sum(term.value for term in s.terms) for s in seen.sites.sites if s.accepted]
    for number, (before, value) in enumerate(itertools.pairwise(values), start=2):
        if value > before + 1e-9:
            return f"accepted site {number} has the value {value:.4g}, above {before:.4g} before it"
    return ""


def ground(seen: _Selected) -> str:
    """Accepted sites lie on mapped ground, and follow it when the map is mirrored."""
    if not seen.sites.sites:
        return "no site on a map with a flat disc of 5 m radius"
    for number, candidate in enumerate(seen.candidates, start=1):
        if candidate.rule == "not_seen":
            return f"site {number} lies where nothing is mapped"
    first, other = (
        next((site.position_odom[:2] for site in offered.sites if site.accepted), None)
        for offered in (seen.sites, seen.mirrored)
    )
    if first is not None and other is not None and np.linalg.norm(first - other) < 1e-6:
        return "the first site stays where it is when the map is mirrored"
    return ""


def no_site_of_nothing(seen: _Selected) -> str:
    """No site is accepted where nothing is mapped."""
    accepted = any(site.accepted for site in seen.of_nothing.sites)
    return "a site is accepted where nothing is mapped" if accepted else ""


# ----------------------------------------------------------------------------------------- mapper

_OFF_M, _MIN_M2, _SCANS_S = 0.1, 3.0, 3.0
"""largest median error of the heights, and least area mapped, after so many seconds"""


def true_estimate(stream: SyntheticStream, obs: Observation, tick_hz: int) -> Estimate:
    """The true pose of a synthetic flight as an estimate."""
    before, now = (stream.true_pose(max(tick, 0)) for tick in (obs.tick - 3, obs.tick))
    velocity = (now.translation - before.translation) * tick_hz / 3.0
    return estimate_at({"tick": obs.tick, "time_s": obs.time_s}, now, velocity)


class _Mapped(NamedTuple):
    """Versions after each scan, and the median error and area of the last map."""

    versions: list[int]
    off_m: float
    area_m2: float


def _ask_mapper(session: Session) -> _Mapped:
    sensors = session.rig.sensors
    stream = SyntheticStream(sensors, session.part.needs | SensorNeeds(lidar=True), _SCANS_S)
    versions = [-1]
    for obs in stream:
        rule = "answers" if versions[-1] > 0 else "missing data"
        estimate = true_estimate(stream, obs, sensors.tick_hz)
        view: MapView = session.ask(
            "update", obs, estimate, rule=rule,
            compared=lambda view: (view.version, view.coarse.height_m, view.coarse.count),
        )  # fmt: skip
        versions.append(view.version)
    grid = view.coarse
    rows, cols = np.nonzero((grid.count > 0.0) & np.isfinite(grid.height_m))
    centres = grid.origin_xy_m + (np.column_stack([cols, rows]) + 0.5) * grid.cell_m
    errors = grid.height_m[rows, cols] - ground_height(centres)
    area_m2 = len(rows) * grid.cell_m**2
    off_m = float(np.median(abs(errors))) if len(rows) else 0.0
    session.figures["heights"] = f"{off_m:.3f} m off (median) over {area_m2:.0f} square metres"
    return _Mapped(versions, off_m, area_m2)


def heights(seen: _Mapped) -> str:
    """The median height of the map's cells is within 0.1 m of the ground, over 3 square metres or
    more."""
    if seen.area_m2 < _MIN_M2:
        return f"{seen.area_m2:.1f} square metres are mapped after {_SCANS_S:g} s"
    return f"heights are {seen.off_m:.2f} m off (median)" if seen.off_m > _OFF_M else ""


def version(seen: _Mapped) -> str:
    """Version does not fall, and rises with the scans."""
    for before, now in itertools.pairwise(seen.versions):
        if now < before:
            return f"version fell from {before} to {now}"
    last = seen.versions[-1]
    return "" if last > 0 else f"version is {last} after {_SCANS_S:g} s of scans"


# ------------------------------------------------------------------------------------- classifier

_COLOURS = ((100, 130, 70), (170, 130, 95), (95, 95, 100), (60, 85, 110), (40, 60, 30))
_SAME, _ROUNDING = 1e-6, 1e-3


def textures(size: int) -> NDArray[np.uint8]:
    """(5, S, S, 3) RGB: a lawn, a field, a road, water and trees by their colours, with noise."""
    rng = np.random.default_rng(3)
    plain = np.array(_COLOURS, float)[:, None, None, :]
    noise = rng.normal(0.0, 12.0, (len(_COLOURS), size, size, 1))
    return np.clip(plain + noise, 0, 255).astype(np.uint8)


class _Classified(NamedTuple):
    """Probabilities (5, N) of textures together, and of each alone."""

    together: Array
    alone: Array


def _ask_classifier(session: Session) -> _Classified:
    names, shown = session.rig.classes, textures(session.part.image_size)
    together: Array = session.ask("classify", shown, when="of five images").probabilities
    best = [(names[int(row.argmax())], row.max()) for row in together]
    session.figures["textures"] = ", ".join(f"{name} {p:.2f}" for name, p in best)
    alone = [
        session.ask("classify", image[None], when=f"of image {number} alone").probabilities[0]
        for number, image in enumerate(shown, start=1)
    ]
    black = np.zeros_like(shown[:1])
    session.ask("classify", black, when="of a black image", rule="missing data")
    return _Classified(together, np.array(alone))


def batch(seen: _Classified) -> str:
    """An image is classified the same alone as among others."""
    off = abs(seen.alone - seen.together).max(axis=1)
    worst = int(off.argmax())
    if off[worst] <= _ROUNDING:
        return ""
    return f"image {worst + 1} alone has probabilities {off[worst]:.2g} off"


def images(seen: _Classified) -> str:
    """Images of other colours have other probabilities."""
    same = np.ptp(seen.together, axis=0).max() < _SAME
    return "five textures of other colours have the same probabilities" if same else ""


# ------------------------------------------------------------------------------------- controller

_START, _WAY = np.array([0.0, 0.0, 10.0]), np.array([2.0, -1.0, 1.0])
_HOVER_S, _WAY_S, _WAY_END_S = 0.5, 3.0, 5.0
_TURN_RAD = 0.3
_FARTHEST_M, _LAST_M = 1.0, 0.3
"""largest distance to the setpoint on the way, and at its end"""
_THRUST_LIMIT, _SLACK = 0.5, 1.05


def setpoint_at(time_s: float) -> Setpoint:
    """The way: half a second of hovering, three seconds of minimum jerk with a turn, hovering."""
    place, speed, change = minimum_jerk(np.array((time_s - _HOVER_S) / _WAY_S)).tolist()
    return Setpoint(
        position_odom=_START + place * _WAY,
        velocity_odom=speed / _WAY_S * _WAY,
        acceleration_odom=change / _WAY_S**2 * _WAY,
        yaw_odom=place * _TURN_RAD,
        yaw_rate=speed / _WAY_S * _TURN_RAD,
    )


class _Steered(NamedTuple):
    """Distances to the setpoint at each control step, up to the one that is too far."""

    off_m: list[float]
    weights: float = 0.0
    """thrust over the weight under `_THRUST_LIMIT`"""
    turning: bool = False
    """whether a rotor turned with motors off"""


def _ask_controller(session: Session) -> _Steered:
    vehicle, hz = session.rig.vehicle, session.rig.control_hz
    frame = SyntheticAirframe(vehicle, _START, 1.0 / hz)

    def speeds(setpoint: Setpoint, when: str = "", rule: str = "answers", **more: Any) -> Array:
        estimate = dataclasses.replace(frame.estimate(), **more)
        command = session.ask("update", estimate, setpoint, when=when, rule=rule)
        found: Array = command.rotor_speed_radps
        return found

    off = dataclasses.replace(setpoint_at(0.0), motors_on=False)
    stopped = speeds(off, "at first", "missing data", healthy=False).copy()
    off_m: list[float] = []
    for number in range(round(_WAY_END_S * hz)):
        setpoint = setpoint_at(number / hz)
        frame.step(speeds(setpoint))
        off_m.append(float(np.linalg.norm(frame.position - setpoint.position_odom)))
        if off_m[-1] > _FARTHEST_M:
            return _Steered(off_m)
    session.figures["way"] = f"{max(off_m):.2f} m off at most, {off_m[-1]:.2f} m at its end"
    end = setpoint_at(_WAY_END_S)
    limited = speeds(dataclasses.replace(end, thrust_limit=_THRUST_LIMIT), "with a thrust_limit")
    thrust = vehicle.thrust_coefficient * float(np.sum(limited**2))
    again = speeds(dataclasses.replace(end, motors_on=False), "with motors_on = False")
    turning = bool(np.any([stopped, again]))
    return _Steered(off_m, thrust / (vehicle.mass_kg * GRAVITY_MPS2), turning)


def steers(seen: _Steered) -> str:
    """A synthetic airframe stays within 1 m of the setpoint and ends within 0.3 m."""
    last = seen.off_m[-1]
    if last > _FARTHEST_M:
        return f"the airframe is {last:.1f} m from the setpoint on its way"
    return f"the airframe ends {last:.2f} m from the setpoint" if last > _LAST_M else ""


def limit(seen: _Steered) -> str:
    """The thrust keeps to the setpoint's thrust_limit."""
    if seen.weights <= _SLACK * _THRUST_LIMIT:
        return ""
    return f"thrust_limit = {_THRUST_LIMIT:g} gave {seen.weights:.2f} of the weight"


def stop(seen: _Steered) -> str:
    """All rotor speeds are 0 where the setpoint has motors_on = False."""
    return "motors_on = False left rotors turning" if seen.turning else ""


# ----------------------------------------------------------------------------------------- lander

_JUMP_M, _CONTACT_MPS, _MISSION_S = 0.5, 0.5, 300.0
_FLOWN_M = 2.0
"""height from which on the vehicle has flown"""


class _Landed(NamedTuple):
    """A mission of a vehicle that follows its setpoints exactly, over flat ground. ``jumps`` are
    times and distances between two setpoints with motors on, ``contacts`` times and speeds
    downwards after the take-off."""

    phases: str
    surveyed: bool
    done: bool
    jumps: list[tuple[float, float]]
    contacts: list[tuple[float, float]]


def _ask_lander(session: Session) -> _Landed:
    vehicle = FollowedSetpoints(session.rig.sensors)
    phases: dict[Phase, float] = {}
    jumps: list[tuple[float, float]] = []
    contacts: list[tuple[float, float]] = []
    last: Setpoint | None = None
    flew = done = False
    while not done and (given := vehicle.seen())[0].time_s < _MISSION_S:
        time_s = given[0].time_s
        setpoint: Setpoint = session.ask("update", *given)
        phase: Phase = session.ask("view", compared=lambda view: view.phase).phase
        phases.setdefault(phase, time_s)
        if last is not None and last.motors_on and setpoint.motors_on:
            jump = float(np.linalg.norm(setpoint.position_odom - last.position_odom))
            jumps += [(time_s, jump)] if jump > _JUMP_M else []
        last, before, falling = setpoint, vehicle.on_ground, -float(vehicle.velocity[2])
        vehicle.follow(setpoint)
        flew = flew or vehicle.position[2] > _FLOWN_M
        if flew and vehicle.on_ground and not before:
            contacts.append((time_s, falling))
            session.figures["touchdown"] = f"at {time_s:.1f} s with {falling:.2f} m/s"
        done = phase is Phase.DONE and not setpoint.motors_on
    told = ", ".join(f"{phase} {time_s:.1f}" for phase, time_s in phases.items()) + " s"
    session.figures["phases"] = told
    landed = done and flew and vehicle.on_ground
    return _Landed(told, Phase.SURVEY in phases, landed, jumps, contacts)


def continuity(seen: _Landed) -> str:
    """The setpoint does not jump by more than 0.5 m while motors are on."""
    told = (f"at {time_s:.3f} s the setpoint jumped by {jump:.2f} m" for time_s, jump in seen.jumps)
    return next(told, "")


def touchdown(seen: _Landed) -> str:
    """The first contact is at 0.5 m/s or less."""
    for time_s, falling in seen.contacts:
        if falling > _CONTACT_MPS:
            return f"at {time_s:.3f} s the ground is touched with {falling:.2f} m/s"
    return ""


def mission(seen: _Landed) -> str:
    """The phase is SURVEY once, and DONE, with motors off on the ground, within 300 s."""
    if seen.surveyed and seen.done:
        return ""
    lacks = "has landed with motors off" if seen.surveyed else "has surveyed"
    return f"within {_MISSION_S:g} s it never {lacks}: phases {seen.phases}"


# ------------------------------------------------------------------------------------------ table

KINDS: Mapping[str, Kind] = {
    "selector": Kind(
        _ask_selector, {"order": order, "ground": ground, "missing data": no_site_of_nothing}
    ),
    "controller": Kind(_ask_controller, {"steers": steers, "limit": limit, "stop": stop}),
    "classifier": Kind(_ask_classifier, {"batch": batch, "images": images}),
    "mapper": Kind(_ask_mapper, {"heights": heights, "version": version}),
    "lander": Kind(
        _ask_lander, {"continuity": continuity, "mission": mission, "touchdown": touchdown}
    ),
}

_COMMON = (
    "builds", "answers", "shapes", "finite", "inputs", "deterministic", "missing data", "latency",
)  # fmt: skip
_OF_ANSWERS = {"selector": {"terms"}, "classifier": {"probabilities"}}
RULES: Mapping[str, frozenset[str]] = {
    "estimator": frozenset({*_COMMON, *ESTIMATOR_CHECKS}),
    **{
        name: frozenset({*_COMMON, *kind.checks, *_OF_ANSWERS.get(name, ())})
        for name, kind in KINDS.items()
    },
}
"""Names of the checked rules of each kind."""


def examine(name: str, build: Build, rig: Any, params: Mapping[str, Any]) -> Findings:
    """The broken rules of a part of a kind beside the estimator, its latency and other figures."""
    return examine_as(KINDS[name], functools.partial(Session, name, build, rig, params))
