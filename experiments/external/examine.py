"""The examinations of parts of every kind beside the estimator: what each is asked in the synthetic
world, and the checks of what it answers, by rule."""

import dataclasses
import functools
import itertools
import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.controller.api import Setpoint
from touchdown.estimator.api import Estimate, MapView
from touchdown.experiments.external.examination import (
    Examined,
    Examiner,
    Findings,
    examine_as,
)
from touchdown.experiments.external.loading import Build
from touchdown.experiments.external.synthetic_descent import Box, Descent
from touchdown.experiments.external.synthetic_stream import (
    SyntheticStream,
    ground_height,
    minimum_jerk,
)
from touchdown.experiments.external.synthetic_world import (
    FollowedSetpoints,
    SyntheticAirframe,
    estimate_at,
    hovering,
    synthetic_map,
)
from touchdown.landing.api import Phase, RankedSites, SelectorInput, Verdict
from touchdown.landing.selection.offered import selection_of
from touchdown.sim.api import GRAVITY_MPS2, Observation, SensorNeeds
from touchdown.sim.typing import Array

Checked = Iterator[tuple[str, str]]


def selector(part: Examined) -> Checked:
    """Sites of a map, of its mirror image, and of a map of nothing.

    They are ranked by the sum of their terms; accepted ones lie on mapped ground, and follow it
    when the map is mirrored."""
    whole = SelectorInput(map_view=synthetic_map(), estimate=hovering(), reach_m=60.0)

    def sites(when: str, rule: str = "answers", **changes: Any) -> RankedSites:
        seen = dataclasses.replace(whole, **changes)
        return part.ask("select", seen, when=when, rule=rule)

    found = sites("of a map")
    candidates = selection_of(found, whole, part.rig.landing).candidates
    accepted = sum(site.accepted for site in candidates)
    part.figures["sites"] = f"{len(found.sites)}, {accepted} accepted and mapped"
    if not found.sites:
        yield "ground", "no site on a map with a flat disc of 5 m radius"
    for number, site in enumerate(candidates, start=1):
        if site.rule == "not_seen":
            yield "ground", f"site {number} lies where nothing is mapped"
    values = [sum(term.value for term in site.terms) for site in found.sites if site.accepted]
    for number, (before, value) in enumerate(itertools.pairwise(values), start=2):
        if value > before + 1e-9:
            text = f"accepted site {number} has the value {value:.4g}, above {before:.4g} before it"
            yield "order", text
    first = np.array([[*site.position_odom[:2], 0.0] for site in found.sites[:1]]).reshape(-1, 3)
    sites("after a refusal", avoid_odom=first, unsafe_ground_odom=first, wind_mps=5.0)
    sites("in an emergency", reach_m=2.0, emergency=True)
    mirrored = sites("of a mirrored map", map_view=synthetic_map(mirrored=True))
    best = [
        next((site.position_odom[:2] for site in offered.sites if site.accepted), None)
        for offered in (found, mirrored)
    ]
    if best[0] is not None and best[1] is not None and np.linalg.norm(best[0] - best[1]) < 1e-6:
        yield "ground", "the first site stays where it is when the map is mirrored"
    of_nothing = sites("of an empty map", "missing data", map_view=synthetic_map(empty=True))
    if any(site.accepted for site in of_nothing.sites):
        yield "missing data", "a site is accepted where nothing is mapped"


_OFF_M, _MIN_M2, _SCANS_S = 0.1, 3.0, 3.0
"""largest median error of the heights, and least area mapped, after so many seconds"""


def true_estimate(stream: SyntheticStream, obs: Observation, tick_hz: int) -> Estimate:
    """The true pose of a synthetic flight as an estimate."""
    before, now = (stream.true_pose(max(tick, 0)) for tick in (obs.tick - 3, obs.tick))
    velocity = (now.translation - before.translation) * tick_hz / 3.0
    return estimate_at({"tick": obs.tick, "time_s": obs.time_s}, now, velocity)


def mapper(part: Examined) -> Checked:
    """The map of a synthetic flight: its version rises with the scans and never falls, and the
    median height of its cells is that of the ground."""
    sensors = part.rig.sensors
    stream = SyntheticStream(sensors, part.inner.needs | SensorNeeds(lidar=True), _SCANS_S)
    version = -1
    for obs in stream:
        view: MapView = part.ask(
            "update", obs, true_estimate(stream, obs, sensors.tick_hz),
            rule="answers" if version > 0 else "missing data",
            compared=lambda view: (view.version, view.coarse.height_m, view.coarse.count),
        )  # fmt: skip
        if view.version < version:
            yield "version", f"version fell from {version} to {view.version}"
        version = view.version
    if version <= 0:
        yield "version", f"version is {version} after {_SCANS_S:g} s of scans"
    grid = view.coarse
    rows, cols = np.nonzero((grid.count > 0.0) & np.isfinite(grid.height_m))
    centres = grid.origin_xy_m + (np.column_stack([cols, rows]) + 0.5) * grid.cell_m
    errors = grid.height_m[rows, cols] - ground_height(centres)
    area_m2 = len(rows) * grid.cell_m**2
    off_m = float(np.median(abs(errors))) if len(rows) else 0.0
    part.figures["heights"] = f"{off_m:.3f} m off (median) over {area_m2:.0f} square metres"
    if area_m2 < _MIN_M2:
        yield "heights", f"{area_m2:.1f} square metres are mapped after {_SCANS_S:g} s"
    if off_m > _OFF_M:
        yield "heights", f"heights are {off_m:.2f} m off (median)"


_COLOURS = ((100, 130, 70), (170, 130, 95), (95, 95, 100), (60, 85, 110), (40, 60, 30))
_SAME, _ROUNDING = 1e-6, 1e-3


def textures(size: int) -> NDArray[np.uint8]:
    """(5, S, S, 3) RGB: a lawn, a field, a road, water and trees by their colours, with noise."""
    rng = np.random.default_rng(3)
    plain = np.array(_COLOURS, float)[:, None, None, :]
    noise = rng.normal(0.0, 12.0, (len(_COLOURS), size, size, 1))
    return np.clip(plain + noise, 0, 255).astype(np.uint8)


def classifier(part: Examined) -> Checked:
    """Textures of other colours have other probabilities, and an image the same alone as among
    others."""
    names, shown = part.rig.classes, textures(part.inner.image_size)
    together: Array = part.ask("classify", shown, when="of five images").probabilities
    best = [(names[int(row.argmax())], row.max()) for row in together]
    part.figures["textures"] = ", ".join(f"{name} {p:.2f}" for name, p in best)
    if np.ptp(together, axis=0).max() < _SAME:
        yield "images", "five textures of other colours have the same probabilities"
    for number, (image, row) in enumerate(zip(shown, together, strict=True), start=1):
        alone = part.ask("classify", image[None], when=f"of image {number} alone").probabilities[0]
        if (off := abs(alone - row).max()) > _ROUNDING:
            yield "batch", f"image {number} alone has probabilities {off:.2g} off"
    black = np.zeros_like(shown[:1])
    part.ask("classify", black, when="of a black image", rule="missing data")


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


def controller(part: Examined) -> Checked:
    """A synthetic airframe stays near the setpoint; the thrust keeps to its limit, and rotors stop
    where motors are off."""
    vehicle, hz = part.rig.vehicle, part.rig.control_hz
    frame = SyntheticAirframe(vehicle, _START, 1.0 / hz)

    def speeds(setpoint: Setpoint, when: str = "", rule: str = "answers", **more: Any) -> Array:
        estimate = dataclasses.replace(frame.estimate(), **more)
        command = part.ask("update", estimate, setpoint, when=when, rule=rule)
        return np.array(command.rotor_speed_radps)

    off = dataclasses.replace(setpoint_at(0.0), motors_on=False)
    stopped = speeds(off, "at first", "missing data", healthy=False)
    off_m: list[float] = []
    for number in range(round(_WAY_END_S * hz)):
        setpoint = setpoint_at(number / hz)
        frame.step(speeds(setpoint))
        off_m.append(float(np.linalg.norm(frame.position - setpoint.position_odom)))
        if off_m[-1] > _FARTHEST_M:
            yield "steers", f"the airframe is {off_m[-1]:.1f} m from the setpoint on its way"
            return
    part.figures["way"] = f"{max(off_m):.2f} m off at most, {off_m[-1]:.2f} m at its end"
    if off_m[-1] > _LAST_M:
        yield "steers", f"the airframe ends {off_m[-1]:.2f} m from the setpoint"
    end = setpoint_at(_WAY_END_S)
    limited = speeds(dataclasses.replace(end, thrust_limit=_THRUST_LIMIT), "with a thrust_limit")
    thrust = vehicle.thrust_coefficient * float(np.sum(limited**2))
    weights = thrust / (vehicle.mass_kg * GRAVITY_MPS2)
    if weights > _SLACK * _THRUST_LIMIT:
        yield "limit", f"thrust_limit = {_THRUST_LIMIT:g} gave {weights:.2f} of the weight"
    again = speeds(dataclasses.replace(end, motors_on=False), "with motors_on = False")
    if np.any([stopped, again]):
        yield "stop", "motors_on = False left rotors turning"


_JUMP_M, _CONTACT_MPS, _MISSION_S = 0.5, 0.5, 300.0
_FLOWN_M = 2.0
"""height from which on the vehicle has flown"""


def lander(part: Examined) -> Checked:
    """A mission of a vehicle that follows its setpoints exactly, over flat ground: it surveys and
    lands softly, with motors off at its end, and setpoints do not jump while they are on."""
    vehicle = FollowedSetpoints(part.rig.sensors)
    phases: dict[Phase, float] = {}
    last: Setpoint | None = None
    flew = done = False
    while not done and (given := vehicle.seen())[0].time_s < _MISSION_S:
        time_s = given[0].time_s
        setpoint: Setpoint = part.ask("update", *given)
        phase: Phase = part.ask("view", compared=lambda view: view.phase).phase
        phases.setdefault(phase, time_s)
        if last is not None and last.motors_on and setpoint.motors_on:
            jump = float(np.linalg.norm(setpoint.position_odom - last.position_odom))
            if jump > _JUMP_M:
                yield "continuity", f"at {time_s:.3f} s the setpoint jumped by {jump:.2f} m"
        last, before, falling = setpoint, vehicle.on_ground, -float(vehicle.velocity[2])
        vehicle.follow(setpoint)
        flew = flew or vehicle.position[2] > _FLOWN_M
        if flew and vehicle.on_ground and not before:
            part.figures["touchdown"] = f"at {time_s:.1f} s with {falling:.2f} m/s"
            if falling > _CONTACT_MPS:
                text = f"at {time_s:.3f} s the ground is touched with {falling:.2f} m/s"
                yield "touchdown", text
        done = phase is Phase.DONE and not setpoint.motors_on
    told = ", ".join(f"{phase} {time_s:.1f}" for phase, time_s in phases.items()) + " s"
    part.figures["phases"] = told
    if not (surveyed := Phase.SURVEY in phases) or not (done and flew and vehicle.on_ground):
        lacks = "has landed with motors off" if surveyed else "has surveyed"
        yield "mission", f"within {_MISSION_S:g} s it never {lacks}: phases {told}"


_APPEARS_S, _NOTICED_S = 1.5, 1.0
"""when a box appears on the site, and the longest time until a watch must have noticed it"""


def watch(part: Examined) -> Checked:
    """Three seconds over level ground, with nothing on it, with a box that appears on the site, and
    with few returns."""
    sensors = part.rig.sensors

    def first(descent: Descent, when: str, rule: str = "answers") -> float:
        """The time at which it first interrupts the descent; inf where it does not."""
        noticed = math.inf
        for seen in descent.seen(sensors):
            time_s = seen.obs.time_s
            report = part.ask("look", seen, when=f"{when}, at {time_s:.3f} s,", rule=rule)
            if report.verdict is not Verdict.GO:
                noticed = min(noticed, time_s)
        return noticed

    if (at_s := first(Descent(), "over level ground")) < math.inf:
        yield "calm", f"at {at_s:.2f} s it interrupts a descent to level ground with nothing on it"
    box = Box(middle=(0.0, 0.0), from_s=_APPEARS_S)
    late_s = first(Descent(boxes=(box,)), "with a box") - _APPEARS_S
    part.figures["box"] = f"noticed after {late_s:.2f} s"
    if not 0.0 <= late_s <= _NOTICED_S:
        yield (
            "warns",
            f"a box of 0.5 m on the site is not noticed for {late_s:.1f} s",
        )
    first(Descent(returned=0.0), "without returns", "missing data")


_EXAMINERS: Mapping[str, Examiner] = {
    examiner.__name__: examiner
    for examiner in (selector, mapper, classifier, controller, lander, watch)
}


def examine(kind: str, build: Build, rig: Any, params: Mapping[str, Any]) -> Findings:
    """The broken rules of a part of a kind beside the estimator, its latency and other figures."""
    return examine_as(_EXAMINERS[kind], functools.partial(Examined, kind, build, rig, params))
