"""Calls of external parts in flight: watched, and every error told in one line."""

from __future__ import annotations

import copy
import dataclasses
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import Estimate, spare_sensors
from touchdown.experiments.errors import ExternalPartError
from touchdown.experiments.external.estimate_checks import (
    call,
    describe_error,
    wrong_estimate,
    wrong_estimator,
)
from touchdown.experiments.external.loading import external_builder, location, wrong_signature
from touchdown.sim.api import Observation, SensorNeeds, SensorRig

LONGEST_CALL_S: Mapping[str, float] = {
    "estimator": 0.02,
    "selector": 1.0,
    "lander": 0.005,
    "controller": 0.005,
    "mapper": 0.02,
    "classifier": 1.0,
}
"""Mean wall time of a call from which on a part is slow: a control step of 5 ms for what runs in
each; a fifth of a scan's period for what gets most of its work with a scan; a second for what the
vehicle hovers for."""


class Defect(NamedTuple):
    """A rule that an external part broke, and how."""

    rule: str
    reason: str


class ExternalPart:
    """The object that ``name``, MODULE:FUNCTION, builds for a slot from ``params`` and ``rig``.

    ``wrong`` gives the defect of the object, "" if there is none. Raises ExternalPartError for
    every exception in building and in calls; UsageError if the function does not exist. What the
    object is given cannot be written to."""

    def __init__(
        self,
        kind: str,
        name: str,
        params: Mapping[str, Any],
        rig: Any,
        wrong: Callable[[Any], str],
    ) -> None:
        build = external_builder(name, kind)
        self.kind, self.name = kind, name
        self.calls, self.seconds = 0, 0.0
        """of wall time in calls so far"""
        if reason := wrong_signature(build):
            raise self.error(Defect("builds", reason))
        self.inner, error = call(build, copy.deepcopy(dict(params)), read_only(rig))
        if error is not None:
            raise self.error(raised("build", error, "builds"), error) from error
        if reason := wrong(self.inner):
            raise self.error(Defect("builds", reason))

    def ask(
        self,
        method: str,
        *arguments: Any,
        when: str = "",
        wrong: Callable[[Any], Defect | None] = lambda _answer: None,
    ) -> Any:
        """The answer of a method, which is not ``wrong``. ``when``: such as "at 1.200 s", for
        errors."""
        started = time.perf_counter()
        inputs = (read_only(argument) for argument in arguments)
        answer, error = call(getattr(self.inner, method), *inputs)
        self.calls += 1
        self.seconds += time.perf_counter() - started
        if error is not None:
            raise self.error(raised(f"{when} {method}".strip(), error), error) from error
        if defect := wrong(answer):
            text = f"{when} {method} returned {defect.reason}".strip()
            raise self.error(Defect(defect.rule, text))
        return answer

    def get(self, attribute: str) -> Any:
        """The value of an attribute, which may be a property."""
        value, error = call(lambda: getattr(self.inner, attribute))
        if error is not None:
            raise self.error(raised(attribute, error), error) from error
        return value

    def error(self, defect: Defect, error: BaseException | None = None) -> ExternalPartError:
        """The error for a broken rule, with the line of the part's code that raised ``error``."""
        where = "" if error is None else location(error, self.name.partition(":")[0])
        return ExternalPartError(
            f"{self.kind} '{self.name}': {defect.reason}{where} (rule '{defect.rule}'); "
            f"`touchdown check-plugin {self.kind} {self.name}` says more"
        )

    def slowness(self) -> str:
        """A sentence about a part whose calls took too long for a flight; "" for another."""
        return slowness(self.kind, self.name, self.seconds / max(self.calls, 1))


def slowness(kind: str, name: str, mean_s: float) -> str:
    """A sentence about a part whose calls took ``mean_s`` of wall time; "" where that is no more
    than `LONGEST_CALL_S`."""
    most_s = LONGEST_CALL_S[kind]
    if mean_s <= most_s:
        return ""
    return (
        f"{kind} '{name}' took {1e3 * mean_s:.3g} ms a call, above {1e3 * most_s:g} ms (rule "
        "'latency'): simulated time waited, a vehicle could not"
    )


def raised(what: str, error: BaseException, rule: str = "answers") -> Defect:
    """The defect of a call that raised ``error``; writing to what was given is one of its own."""
    if isinstance(error, ValueError) and "read-only" in str(error):
        return Defect("inputs", f"{what} modified what it was given ({describe_error(error)})")
    return Defect(rule, f"{what} raised {describe_error(error)}")


def read_only(value: Any) -> Any:
    """``value``, a message or a rig, with views of its arrays that cannot be written to."""
    return _with_arrays(value, _locked)


def own(value: Any) -> Any:
    """``value``, an answer, with arrays as the shipped parts make them: float64, in one piece, to
    be written to. Those that are so already stay the same."""
    return _with_arrays(value, lambda array: np.require(array, np.float64, ["C", "W"]))


def _locked(array: NDArray[Any]) -> NDArray[Any]:
    if not array.flags.writeable:
        return array
    view = array.view()
    view.flags.writeable = False
    return view


def _with_arrays(value: Any, change: Callable[[NDArray[Any]], NDArray[Any]]) -> Any:
    """``value`` with all arrays in it changed; itself where none is."""
    if isinstance(value, np.ndarray):
        return change(value)
    if type(value) is tuple and value:
        items = tuple(_with_arrays(item, change) for item in value)
        return value if all(a is b for a, b in zip(items, value, strict=True)) else items
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        return value
    twin = value
    for field in dataclasses.fields(value):
        old = getattr(value, field.name)
        new = _with_arrays(old, change)
        if new is not old:
            twin = copy.copy(value) if twin is value else twin
            object.__setattr__(twin, field.name, new)  # of a frozen class
    return twin


class ExternalEstimator:
    """Passes observations to an external estimator and checks its estimates. Raises as
    `ExternalPart`, and ExternalPartError for an invalid estimate."""

    needs: SensorNeeds

    def __init__(self, name: str, params: Mapping[str, Any], rig: SensorRig) -> None:
        self.part = ExternalPart(
            "estimator", name, params, rig, lambda inner: wrong_estimator(inner, rig)
        )
        inner = self.part.inner
        self.needs, self.spare_sensors = inner.needs, spare_sensors(inner)

    def update(self, obs: Observation) -> Estimate:
        """Estimate of the external estimator, checked."""
        when = f"at {obs.time_s:.3f} s"
        checked: Estimate = own(self.part.ask("update", obs, when=when, wrong=_defect))
        return checked


def _defect(estimate: Any) -> Defect | None:
    reason = wrong_estimate(estimate)
    rule = "finite" if reason.endswith("not finite") else "shapes"
    rule = rule if isinstance(estimate, Estimate) else "answers"
    return Defect(rule, reason) if reason else None
