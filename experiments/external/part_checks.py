"""Checks of the answers of external parts that a flight depends on. Each returns the broken rule
and how, or None."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from touchdown.estimator.api import MapView
from touchdown.experiments.errors import nearest
from touchdown.experiments.external.estimate_checks import describe_error
from touchdown.experiments.external.wrapper import Defect
from touchdown.landing.api import RankedSites, ScoreTerm, Site, TermLayer
from touchdown.sim.api import Command


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
