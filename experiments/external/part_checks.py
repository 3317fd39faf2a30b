"""Checks of the answers of external parts that a flight depends on. Each returns the broken rule
and how, or None."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from touchdown.controller.api import Setpoint
from touchdown.estimator.api import HEIGHT_BINS, GridMap, MapView
from touchdown.experiments.errors import nearest
from touchdown.experiments.external.estimate_checks import describe_error
from touchdown.experiments.external.wrapper import Defect
from touchdown.landing.api import (
    GroundPrediction,
    LanderView,
    Phase,
    RankedSites,
    ScoreTerm,
    Site,
    TermLayer,
)
from touchdown.sim.api import Command, SensorNeeds, SensorRig

ANSWER_RULES: Mapping[str, Mapping[str, str]] = {
    "selector": {
        "terms": "every site has the same named terms, one or more, and the layers are of these"
    },
    "classifier": {"probabilities": "those of an image are 0 or more and add up to 1"},
}
"""Rules of answers of a kind that go beyond shapes and finite numbers."""


def lacks(part: Any, *methods: str) -> str:
    """Defect of an object without one of these methods; "" if it has all."""
    kind = type(part).__name__
    for method in methods:
        try:
            found = getattr(part, method, None)
        except (Exception, SystemExit) as error:  # a property may raise anything
            return f"'{method}' of the {kind} raised {describe_error(error)}"
        if not callable(found):
            known = (name for name in dir(part) if not name.startswith("_"))
            return f"build returned a {kind}, which has no method {method}{nearest(method, known)}"
    return ""


def wrong_array(name: str, value: Any, shape: tuple[int, ...]) -> Defect | None:
    """Defect of an array of numbers of a shape."""
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
        return Defect("shapes", f"{name} is a {type(value).__name__}, no NumPy array of numbers")
    if value.shape != shape:
        return Defect("shapes", f"{name} has shape {value.shape}, not {shape}")
    if not np.isfinite(value).all():
        return Defect("finite", f"{name} is not finite")
    return None


# --------------------------------------------------------------------------------------- selector


def wrong_sites(offered: Any, view: MapView) -> Defect | None:
    """Defect of what a selector returned for a map."""
    if not isinstance(offered, RankedSites):
        return Defect("answers", f"{type(offered).__name__}, not RankedSites")
    for name, items, kind in (
        ("sites", offered.sites, Site),
        ("layers", offered.layers, TermLayer),
    ):
        if not isinstance(items, tuple | list) or any(not isinstance(i, kind) for i in items):
            return Defect("answers", f"{name} that are no tuple of {kind.__name__}")
    names: tuple[str, ...] | None = None
    for number, site in enumerate(offered.sites, start=1):
        if found := _wrong_site(site, f"site {number}, whose "):
            return found
        own = tuple(term.name for term in site.terms)
        if names is not None and own != names:
            return Defect("terms", f"site {number} with the terms {own}, unlike {names} of site 1")
        names = own
    shape = view.coarse.height_m.shape
    for layer in offered.layers:
        for part in ("value", "quantity"):
            raster = getattr(layer, part)
            if not isinstance(raster, np.ndarray) or raster.shape != shape:
                text = (
                    f"the layer '{layer.name}', whose {part} has not the shape {shape} of the map"
                )
                return Defect("shapes", text)
    if names is not None and offered.layers and names != tuple(x.name for x in offered.layers):
        return Defect("terms", f"layers that are not of the terms {names} of the sites")
    return None


def _wrong_site(site: Site, who: str) -> Defect | None:
    shape = np.shape(site.position_odom)
    wanted = shape if shape in ((2,), (3,)) else (3,)
    place = site.position_odom
    if isinstance(place, np.ndarray) and place.shape == (3,):  # the height is taken from the map
        place = place[:2]
        wanted = (2,)
    if found := wrong_array(f"{who}position_odom", place, wanted):
        return found
    if not site.terms or any(not isinstance(term, ScoreTerm) for term in site.terms):
        return Defect("terms", f"{who}terms are no tuple of one or more ScoreTerm")
    for term in site.terms:
        try:
            finite = math.isfinite(term.value)
            float(term.quantity)
        except TypeError:
            return Defect("terms", f"{who}term '{term.name}' holds a value that is no number")
        if not finite:
            return Defect("finite", f"{who}term '{term.name}' is not finite")
    return None


# ------------------------------------------------------------------------------------- controller


def wrong_command(command: Any) -> Defect | None:
    """Defect of what a controller returned."""
    if not isinstance(command, Command):
        return Defect("answers", f"{type(command).__name__}, not Command")
    speeds = command.rotor_speed_radps
    if found := wrong_array("a command whose rotor_speed_radps", speeds, (4,)):
        return found
    if (speeds < 0.0).any():
        return Defect("finite", "a command whose rotor_speed_radps is negative")
    return None


# ------------------------------------------------------------------------------------- classifier


def wrong_classifier(part: Any) -> str:
    """Defect of a ground classifier that can be found before its first image."""
    if reason := lacks(part, "classify"):
        return reason
    size = getattr(part, "image_size", None)
    if not isinstance(size, int) or not 1 <= size <= 1024:
        return f"image_size is {size!r}, not a number of pixels from 1 to 1024"
    least = getattr(part, "min_probability", None)
    if not isinstance(least, int | float) or not 0.0 <= least <= 1.0:
        return f"min_probability is {least!r}, not a probability from 0 to 1"
    return ""


def wrong_prediction(found: Any, count: int, classes: int) -> Defect | None:
    """Defect of what a ground classifier returned for ``count`` images."""
    if not isinstance(found, GroundPrediction):
        return Defect("answers", f"{type(found).__name__}, not GroundPrediction")
    table = found.probabilities
    if wrong := wrong_array("predictions whose probabilities", table, (count, classes)):
        return wrong
    if (table < 0.0).any() or (abs(table.sum(axis=1) - 1.0) > _SUM_OFF).any():
        return Defect("probabilities", "predictions that are negative or do not add up to 1")
    known = found.in_distribution
    if not isinstance(known, np.ndarray) or known.dtype != np.bool_ or known.shape != (count,):
        return Defect("shapes", f"predictions whose in_distribution is no bool array of ({count},)")
    return None


_SUM_OFF = 1e-3
"""limit of the deviation of a sum of probabilities from 1: above rounding to 16 bits"""


# ----------------------------------------------------------------------------------------- mapper


def wrong_needs(part: Any, rig: SensorRig) -> str:
    """Defect of the sensors that a part asks for."""
    needs = getattr(part, "needs", None)
    if not isinstance(needs, SensorNeeds):
        return f"the attribute 'needs' is a {type(needs).__name__}, no SensorNeeds"
    try:
        needs.check_camera_rate(rig.tick_hz // rig.camera_ticks)
    except ValueError as error:
        return str(error)
    return ""


def wrong_mapper(part: Any, rig: SensorRig) -> str:
    """Defect of a mapper that can be found before its first scan."""
    return lacks(part, "update") or wrong_needs(part, rig)


def wrong_map(view: Any) -> Defect | None:
    """Defect of what a mapper returned."""
    if not isinstance(view, MapView):
        return Defect("answers", f"{type(view).__name__}, not MapView")
    if not isinstance(view.version, int | np.integer):
        return Defect("shapes", f"a map whose version is a {type(view.version).__name__}, no int")
    for name, grid in (("coarse", view.coarse), ("fine", view.fine)):
        if grid is None and name == "fine":
            continue
        if not isinstance(grid, GridMap):
            return Defect("answers", f"a map whose {name} is a {type(grid).__name__}, no GridMap")
        if wrong := _wrong_grid(grid, f"a map whose {name}"):
            return wrong
    return None


def _wrong_grid(grid: GridMap, who: str) -> Defect | None:
    if wrong := wrong_array(f"{who}.origin_xy_m", grid.origin_xy_m, (2,)):
        return wrong
    if not (isinstance(grid.cell_m, int | float) and 0.0 < grid.cell_m < math.inf):
        return Defect("shapes", f"{who}.cell_m is {grid.cell_m!r}, no length")
    shape = np.shape(grid.height_m)
    for name in _LAYERS:
        layer = getattr(grid, name)
        wanted = (*shape, 3) if name == "rgb" else shape
        if not isinstance(layer, np.ndarray) or layer.dtype != np.float32:
            return Defect("shapes", f"{who}.{name} is no float32 array")
        if layer.shape != wanted or len(shape) != 2:
            return Defect("shapes", f"{who}.{name} has shape {layer.shape}, not (rows, cols)")
    for name in ("count", "missing"):
        if not np.isfinite(getattr(grid, name)).all():
            return Defect("finite", f"{who}.{name} is not finite")
    if not np.isfinite(grid.height_m[grid.count > 0.0]).all():
        return Defect("finite", f"{who}.height_m is not finite where count is above 0")
    histogram = grid.histogram
    if histogram is not None and (
        histogram.dtype != np.uint8 or histogram.shape != (*shape, HEIGHT_BINS)
    ):
        return Defect("shapes", f"{who}.histogram is no uint8 array of (rows, cols, {HEIGHT_BINS})")
    return None


_LAYERS = (
    "count", "height_m", "height_std_m", "min_height_m", "max_height_m", "rgb", "intensity",
    "missing", "last_seen_s",
)  # fmt: skip


# ----------------------------------------------------------------------------------------- lander


def wrong_lander(part: Any, rig: SensorRig) -> str:
    """Defect of a lander that can be found before its first setpoint."""
    return lacks(part, "update", "view") or wrong_needs(part, rig)


def wrong_setpoint(setpoint: Any) -> Defect | None:
    """Defect of what ``update`` of a lander returned."""
    if not isinstance(setpoint, Setpoint):
        return Defect("answers", f"{type(setpoint).__name__}, not Setpoint")
    for name in ("position_odom", "velocity_odom", "acceleration_odom"):
        if wrong := wrong_array(f"a setpoint whose {name}", getattr(setpoint, name), (3,)):
            return wrong
    limit = setpoint.thrust_limit
    for name, number in (("yaw_odom", setpoint.yaw_odom), ("yaw_rate", setpoint.yaw_rate),
                         ("thrust_limit", 0.0 if limit is None else limit)):  # fmt: skip
        if not isinstance(number, int | float):
            return Defect("shapes", f"a setpoint whose {name} is a {type(number).__name__}")
        if not math.isfinite(number):
            return Defect("finite", f"a setpoint whose {name} is not finite")
    return None


def wrong_view(view: Any) -> Defect | None:
    """Defect of what ``view`` of a lander returned."""
    if not isinstance(view, LanderView):
        return Defect("answers", f"{type(view).__name__}, not LanderView")
    if not isinstance(view.phase, Phase):
        return Defect("answers", f"a view whose phase is {view.phase!r}, no Phase")
    for name in ("reference_world", "site_world", "committed_site_world"):
        place = getattr(view, name)
        if place is None and name != "reference_world":
            continue
        if wrong := wrong_array(f"a view whose {name}", place, (3,)):
            return wrong
    return None
