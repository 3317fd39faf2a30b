"""What a flight depends on of an external part: its methods, and the checks of their answers.

The checks of answers that come once a control step cost microseconds.
"""

import math
from collections.abc import Callable, Mapping
from operator import attrgetter
from typing import Any

import numpy as np

from touchdown.controller.api import Setpoint
from touchdown.estimator.api import HEIGHT_BINS, Estimate, GridMap, MapView, PoseTrack
from touchdown.experiments.errors import nearest
from touchdown.experiments.external.loading import describe_error
from touchdown.landing.api import (
    Finding,
    GroundPrediction,
    LanderView,
    Phase,
    RankedSites,
    ScoreTerm,
    Site,
    TermLayer,
    Verdict,
    WatchReport,
)
from touchdown.sim.api import Command, SensorNeeds

_SUM_OFF = 1e-3
"""limit of the deviation of a sum of probabilities from 1: above rounding to 16 bits"""
_ROTATION_OFF = 1e-2
"""limit of the deviation from orthonormal: above rounding, below a mistake"""
_IDENTITY = np.eye(3)

_ROTORS = (-1,)
"""one number for each rotor of the rig"""
_SHAPES: Mapping[type, Mapping[str, tuple[int, ...]]] = {
    Estimate: {
        "time_s": (),
        "odom_from_body.rotation": (3, 3),
        "odom_from_body.translation": (3,),
        "world_from_odom.rotation": (3, 3),
        "world_from_odom.translation": (3,),
        "velocity_odom": (3,),
        "angular_velocity_body": (3,),
        "acceleration_odom": (3,),
        "position_covariance": (3, 3),
        "rotation_covariance": (3, 3),
    },
    Command: {"rotor_speed_radps": _ROTORS},
    Setpoint: {
        "position_odom": (3,),
        "velocity_odom": (3,),
        "acceleration_odom": (3,),
        "yaw_odom": (),
        "yaw_rate": (),
        "thrust_limit": (),
    },
    LanderView: {"reference_world": (3,), "site_world": (3,), "committed_site_world": (3,)},
}
"""Fields of numbers, () for a single one."""
_OPTIONAL = {"thrust_limit", "site_world", "committed_site_world"}
_LAYERS = (
    "count", "height_m", "height_std_m", "min_height_m", "max_height_m", "rgb", "intensity",
    "missing", "last_seen_s",
)  # fmt: skip


class DefectError(Exception):
    """A rule that an external part broke, and how."""

    def __init__(self, rule: str, reason: str) -> None:
        super().__init__(rule, reason)
        self.rule, self.reason = rule, reason


def wrong_part(kind: str, part: Any, rig: Any) -> str:
    """What is wrong with a built object before its first call; "" where nothing is."""
    methods = [method for of, method in _ANSWERS if of == kind]
    reason = (
        "" if kind not in ("estimator", "mapper", "lander", "watch") else _wrong_needs(part, rig)
    )
    if kind == "classifier":
        reason = _wrong_limits(part)
    return _lacks(part, methods) or reason


def _lacks(part: Any, methods: list[str]) -> str:
    name = type(part).__name__
    for method in methods:
        if not callable(_get(part, method)):
            known = (name for name in dir(part) if not name.startswith("_"))
            return f"build returned a {name}, which has no method {method}{nearest(method, known)}"
    return ""


def _get(part: Any, attribute: str) -> Any:
    try:
        return getattr(part, attribute, None)
    except (Exception, SystemExit) as error:  # a property may raise anything
        return describe_error(error)


def _wrong_needs(part: Any, rig: Any) -> str:
    needs, sensors = _get(part, "needs"), getattr(rig, "sensors", rig)
    if not isinstance(needs, SensorNeeds):
        return f"the attribute 'needs' is no SensorNeeds but {str(needs)[:80]!r}"
    try:
        needs.check_camera_rate(sensors.tick_hz // sensors.camera_ticks)
    except ValueError as error:
        return str(error)
    return ""


def _wrong_limits(part: Any) -> str:
    size, minimum = _get(part, "image_size"), _get(part, "min_probability")
    if not isinstance(size, int) or not 1 <= size <= 1024:
        return f"image_size is {size!r}, not a number of pixels from 1 to 1024"
    if not isinstance(minimum, int | float) or not 0.0 <= minimum <= 1.0:
        return f"min_probability is {minimum!r}, not a probability from 0 to 1"
    return ""


def check_answer(kind: str, method: str, answer: Any, rig: Any, arguments: tuple[Any, ...]) -> None:
    """Raises DefectError for what is wrong with the answer of a method to these arguments."""
    wanted, check = _ANSWERS[kind, method]
    if not isinstance(answer, wanted):
        raise DefectError("answers", f"{type(answer).__name__}, not {wanted.__name__}")
    who = f"{'an' if wanted is Estimate else 'a'} {wanted.__name__} whose "
    for path, shape in _SHAPES.get(wanted, {}).items():
        try:
            value = attrgetter(path)(answer)
        except AttributeError:
            raise DefectError("shapes", f"{who}{path} is missing") from None
        if value is not None or path not in _OPTIONAL:
            _check_array(
                who + path, value, rig.vehicle.rotor_spin.shape if shape is _ROTORS else shape
            )
    check(answer, rig, arguments)


def _check_array(name: str, value: Any, shape: tuple[int, ...]) -> None:
    """An array of finite numbers of a shape, or with () a single number."""
    if not shape:
        value = np.asarray(value)
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
        raise DefectError(
            "shapes", f"{name} is a {type(value).__name__}, no NumPy array of numbers"
        )
    if value.shape != shape:
        raise DefectError("shapes", f"{name} has shape {value.shape}, not {shape}")
    if not np.isfinite(value).all():
        raise DefectError("finite", f"{name} is not finite")


def _check_estimate(estimate: Estimate, _rig: Any, _arguments: Any) -> None:
    for name in ("odom_from_body", "world_from_odom"):
        rotation = getattr(estimate, name).rotation
        off = abs(rotation @ rotation.T - _IDENTITY).max()
        if off > _ROTATION_OFF or np.linalg.det(rotation) < 0.0:
            raise DefectError("shapes", f"an Estimate whose {name}.rotation is no rotation matrix")
    try:
        for value in estimate.diagnostics.values():
            float(value)
    except (TypeError, ValueError, AttributeError):
        raise DefectError("shapes", "diagnostics that hold a value that is no number") from None
    if not isinstance(estimate.events, tuple | list):
        kind = type(estimate.events).__name__
        raise DefectError("shapes", f"an Estimate whose events is {kind}, not a tuple of texts")
    if (track := estimate.scan_track) is not None:
        if not isinstance(track, PoseTrack):
            raise DefectError("shapes", "an Estimate whose scan_track is no PoseTrack")
        count = len(track.times_s)
        for name, shape in (("times_s", ()), ("positions_odom", (3,)), ("quats_wxyz", (4,))):
            _check_array(f"scan_track.{name}", getattr(track, name), (count, *shape))


def _check_sites(offered: RankedSites, _rig: Any, arguments: Any) -> None:
    for name, items, item in (
        ("sites", offered.sites, Site),
        ("layers", offered.layers, TermLayer),
    ):
        if not isinstance(items, tuple) or not all(isinstance(one, item) for one in items):
            raise DefectError("answers", f"{name} that are no tuple of {item.__name__}")
    names = [tuple(layer.name for layer in offered.layers)] if offered.layers else []
    for number, site in enumerate(offered.sites, start=1):
        _check_site(site, f"site {number}, whose ")
        names.append(tuple(term.name for term in site.terms))
        if names[-1] != names[0]:
            text = f"site {number} with the terms {names[-1]}, unlike {names[0]} before it"
            raise DefectError("terms", text)
    shape = arguments[0].map_view.coarse.height_m.shape
    for layer in offered.layers:
        for part in ("value", "quantity"):
            if np.shape(getattr(layer, part)) != shape:
                text = f"the layer '{layer.name}', whose {part} has not the map's shape {shape}"
                raise DefectError("shapes", text)


def _check_site(site: Site, who: str) -> None:
    place = site.position_odom
    if isinstance(place, np.ndarray) and place.shape == (3,):
        place = place[:2]  # the height is taken from the map
    _check_array(f"{who}position_odom", place, (2,))
    if not site.terms or any(not isinstance(term, ScoreTerm) for term in site.terms):
        raise DefectError("terms", f"{who}terms are no tuple of one or more ScoreTerm")
    for term in site.terms:
        try:
            finite = math.isfinite(term.value)
            float(term.quantity)
        except TypeError:
            text = f"{who}term '{term.name}' holds a value that is no number"
            raise DefectError("terms", text) from None
        if not finite:
            raise DefectError("finite", f"{who}term '{term.name}' is not finite")


def _check_command(command: Command, _rig: Any, _arguments: Any) -> None:
    if (command.rotor_speed_radps < 0.0).any():
        raise DefectError("finite", "a Command whose rotor_speed_radps is negative")


def _check_prediction(found: GroundPrediction, rig: Any, arguments: Any) -> None:
    count, table = len(arguments[0]), found.probabilities
    _check_array("predictions whose probabilities", table, (count, len(rig.classes)))
    if (table < 0.0).any() or (abs(table.sum(axis=1) - 1.0) > _SUM_OFF).any():
        raise DefectError("probabilities", "predictions that are negative or do not add up to 1")
    known = found.in_distribution
    if not isinstance(known, np.ndarray) or known.dtype != np.bool_ or known.shape != (count,):
        text = f"predictions whose in_distribution is no bool array of ({count},)"
        raise DefectError("shapes", text)


def _check_map(view: MapView, _rig: Any, _arguments: Any) -> None:
    if not isinstance(view.version, int | np.integer):
        raise DefectError(
            "shapes", f"a map whose version is a {type(view.version).__name__}, no int"
        )
    for name, grid in (("coarse", view.coarse), ("fine", view.fine)):
        if grid is None and name == "fine":
            continue
        if not isinstance(grid, GridMap):
            raise DefectError(
                "answers", f"a map whose {name} is a {type(grid).__name__}, no GridMap"
            )
        _check_grid(grid, f"a map whose {name}")


def _check_grid(grid: GridMap, who: str) -> None:
    _check_array(f"{who}.origin_xy_m", grid.origin_xy_m, (2,))
    if not (isinstance(grid.cell_m, int | float) and 0.0 < grid.cell_m < math.inf):
        raise DefectError("shapes", f"{who}.cell_m is {grid.cell_m!r}, no length")
    shape = np.shape(grid.height_m)
    for name in _LAYERS:
        layer = getattr(grid, name)
        wanted = (*shape, 3) if name == "rgb" else shape
        if not isinstance(layer, np.ndarray) or layer.dtype != np.float32:
            raise DefectError("shapes", f"{who}.{name} is no float32 array")
        if layer.shape != wanted or len(shape) != 2:
            raise DefectError("shapes", f"{who}.{name} has shape {layer.shape}, not (rows, cols)")
    seen = {"count": grid.count, "missing": grid.missing}
    seen["height_m where count is above 0"] = grid.height_m[grid.count > 0.0]
    for name, numbers in seen.items():
        if not np.isfinite(numbers).all():
            raise DefectError("finite", f"{who}.{name} is not finite")
    bins = grid.histogram
    if bins is not None and (bins.dtype != np.uint8 or bins.shape != (*shape, HEIGHT_BINS)):
        text = f"{who}.histogram is no uint8 array of (rows, cols, {HEIGHT_BINS})"
        raise DefectError("shapes", text)


def _check_view(view: LanderView, _rig: Any, _arguments: Any) -> None:
    if not isinstance(view.phase, Phase):
        raise DefectError("answers", f"a view whose phase is {view.phase!r}, no Phase")


def _check_report(report: WatchReport, _rig: Any, _arguments: Any) -> None:
    who = "a WatchReport whose "
    if not isinstance(report.verdict, Verdict):
        raise DefectError("answers", f"{who}verdict is {report.verdict!r}, no Verdict")
    silent = not (isinstance(report.reason, str) and report.reason)
    if silent and report.verdict is not Verdict.GO:
        raise DefectError("answers", f"{who}verdict '{report.verdict}' has no reason")
    if report.verdict is Verdict.MOVE or report.aside_odom is not None:
        _check_array(f"{who}aside_odom", report.aside_odom, (2,))
    for finding in report.findings:
        if not isinstance(finding, Finding):
            raise DefectError("answers", f"{who}findings are no tuple of Finding")
        _check_array(f"{who}findings' position_odom", finding.position_odom, (3,))
        _check_array(f"{who}findings' velocity_odom", finding.velocity_odom, (2,))


_Check = Callable[[Any, Any, Any], None]
_ANSWERS: Mapping[tuple[str, str], tuple[type, _Check]] = {
    ("estimator", "update"): (Estimate, _check_estimate),
    ("selector", "select"): (RankedSites, _check_sites),
    ("lander", "update"): (Setpoint, lambda *_: None),
    ("lander", "view"): (LanderView, _check_view),
    ("controller", "update"): (Command, _check_command),
    ("mapper", "update"): (MapView, _check_map),
    ("watch", "look"): (WatchReport, _check_report),
    ("classifier", "classify"): (GroundPrediction, _check_prediction),
}
"""By kind of part and method: the type of the answer, and what else is checked of it."""
