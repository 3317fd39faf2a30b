"""External parts in flight: each is asked as the shipped one is, its calls are watched, its answers
are checked, and every error is told in one line."""

import copy
import dataclasses
import functools
import time
from collections.abc import Callable, Hashable, Mapping
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from touchdown.controller.api import Setpoint
from touchdown.estimator.api import Estimate, MapView, spare_sensors
from touchdown.experiments.errors import ExternalPartError
from touchdown.experiments.external.answers import DefectError, check_answer, wrong_part
from touchdown.experiments.external.loading import (
    GIVEN,
    Build,
    call,
    describe_error,
    external_builder,
    imported_code,
    location,
    wrong_signature,
)
from touchdown.landing.api import (
    GroundPrediction,
    LanderView,
    RankedSites,
    Selection,
    SelectorInput,
    WatchInput,
    WatchReport,
)
from touchdown.landing.selection.offered import selection_of
from touchdown.sim.api import Command, Observation, SensorNeeds

LONGEST_CALL_S: Mapping[str, float] = {
    "estimator": 0.02,
    "selector": 1.0,
    "lander": 0.005,
    "controller": 0.005,
    "mapper": 0.02,
    "classifier": 1.0,
    "watch": 0.005,
}
"""Mean processor time of a call, in the thread that makes it, from which on a part is slow: a
control step of 5 ms for what runs in each; a fifth of a scan's period for what gets most of its
work with a scan; a second for what the vehicle hovers for."""


class BrokenRuleError(ExternalPartError):
    """A rule that an external part broke, in one line with that of the part's code."""

    def __init__(
        self, kind: str, name: str, defect: DefectError, error: BaseException | None
    ) -> None:
        self.rule, self.reason = defect.rule, defect.reason
        where = "" if error is None else location(error, name.partition(":")[0])
        more = f"; `touchdown check-plugin {kind} {name}` says more"
        super().__init__(
            f"{kind} '{name}': {self.reason}{where} (rule '{self.rule}')"
            f"{'' if name.startswith(GIVEN) else more}"
        )


class ExternalPart:
    """The object that ``name``, MODULE:FUNCTION, or else ``build``, makes for a slot from
    ``params`` and ``rig``. What it is given cannot be written to.

    Raises BrokenRuleError for every exception in building and in calls, and for a wrong answer;
    UsageError if the function does not exist."""

    def __init__(
        self, kind: str, name: str, params: Mapping[str, Any], rig: Any, build: Build | None = None
    ) -> None:
        build = build or external_builder(name, kind)
        self.kind, self.name, self.rig = kind, name, rig
        self.calls, self.seconds = 0, 0.0
        """of the calling thread's processor time in calls so far: other work of the machine is not
        the part's"""
        self._cells: tuple[int, ...] = ()
        """rows and columns of the largest map of the calls"""
        self._time = ""
        self._given: dict[int, tuple[Any, Any]] = {}
        """arguments of the last call and their read-only views, by identity"""
        self._map: Any = None
        self.inner: Any = None
        if reason := wrong_signature(build):
            raise self._error(DefectError("builds", reason))
        self.inner, error = call(build, copy.deepcopy(dict(params)), read_only(rig))
        if error is not None:
            raise self._error(_raised("build", error, "builds"), error) from error
        if reason := wrong_part(kind, self.inner, rig):
            raise self._error(DefectError("builds", reason))

    def ask(self, method: str, *arguments: Any, when: str = "", rule: str = "answers") -> Any:
        """The answer of a method, checked. ``when``, for errors, is the time of the input by
        default; ``rule`` is the one that an exception breaks."""
        if arguments:
            time_s = getattr(getattr(arguments[0], "estimate", arguments[0]), "time_s", None)
            self._time = "" if time_s is None else f"at {time_s:.3f} s"
            # A map comes many times.
            self._given = {id(a): self._given.get(id(a)) or (a, read_only(a)) for a in arguments}
        what = f"{when or self._time} {method}".strip()
        inputs = [self._given[id(argument)][1] for argument in arguments]
        started = time.thread_time()
        answer, error = call(getattr(self.inner, method), *inputs)
        self.calls += 1
        self.seconds += time.thread_time() - started
        for argument in arguments:
            self._see(getattr(argument, "map_view", argument))
        if error is not None:
            raise self._error(_raised(what, error, rule), error) from error
        if answer is self._map is not None:
            return answer
        try:
            check_answer(self.kind, method, answer, self.rig, arguments)
        except DefectError as defect:
            text = f"{what} returned {defect.reason}"
            raise self._error(DefectError(defect.rule, text)) from None
        self._map = answer if isinstance(answer, MapView) else None
        self._see(answer)
        return answer

    def _see(self, value: Any) -> None:
        if isinstance(value, MapView):
            self._cells = max(self._cells, value.coarse.height_m.shape)

    def slowness(self) -> str:
        """A sentence about a part whose calls took more than `LONGEST_CALL_S`; "" for another."""
        mean_s, max_s = self.seconds / max(self.calls, 1), LONGEST_CALL_S[self.kind]
        if mean_s <= max_s:
            return ""
        return (
            f"{self.kind} '{self.name}' took {1e3 * mean_s:.3g} ms of processor time a call"
            f"{self.map_text}, above {1e3 * max_s:g} ms (rule 'latency'): simulated time waited, a "
            "vehicle could not"
        )

    @property
    def map_text(self) -> str:
        """The size of the largest map of the calls; "" without one."""
        return f" on a map of {' x '.join(map(str, self._cells))} cells" if self._cells else ""

    def _error(self, defect: DefectError, error: BaseException | None = None) -> BrokenRuleError:
        return BrokenRuleError(self.kind, self.name, defect, error)


def _raised(what: str, error: BaseException, rule: str) -> DefectError:
    """The defect of a call that raised ``error``; writing to what was given is one of its own."""
    if isinstance(error, ValueError) and "read-only" in str(error):
        return DefectError("inputs", f"{what} modified what it was given ({describe_error(error)})")
    return DefectError(rule, f"{what} raised {describe_error(error)}")


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
    names = _field_names(cast(Hashable, type(value)))
    old = [getattr(value, name) for name in names]
    new = [_with_arrays(item, change) for item in old]
    if all(a is b for a, b in zip(old, new, strict=True)):
        return value
    twin = object.__new__(type(value))  # copy.copy takes ten times as long
    for name, item in zip(names, new, strict=True):
        object.__setattr__(twin, name, item)  # of a frozen class
    return twin


@functools.cache
def _field_names(kind: Hashable) -> tuple[str, ...]:
    """Of a dataclass; none of another type."""
    if not dataclasses.is_dataclass(kind):
        return ()
    return tuple(field.name for field in dataclasses.fields(kind))


class _Slot:
    """What fills a slot of a flight with a part; ``needs`` are those of the part."""

    kind = ""

    def __init__(self, name: str, params: Mapping[str, Any], rig: Any) -> None:
        self.part, self.rig = ExternalPart(self.kind, name, params, rig), rig
        self.needs: SensorNeeds = getattr(self.part.inner, "needs", SensorNeeds())


class ExternalEstimator(_Slot):
    """Passes observations to an estimator."""

    kind = "estimator"

    def update(self, obs: Observation) -> Estimate:
        """The estimate, checked."""
        return own(self.part.ask("update", obs))

    @property
    def spare_sensors(self) -> tuple[str, ...]:
        """The sensors that the part can do without in a replay."""
        return spare_sensors(self.part.inner)


class ExternalSelector(_Slot):
    """Asks a selector for sites and makes candidates of them."""

    kind = "selector"

    def offer(self, seen: SelectorInput) -> RankedSites:
        """The sites that it offers, checked."""
        return self.part.ask("select", seen)

    def select(self, seen: SelectorInput) -> Selection:
        """The selection that these sites make."""
        return selection_of(own(self.offer(seen)), seen, self.rig.landing)


class ExternalController(_Slot):
    """Asks a controller for rotor speeds."""

    kind = "controller"

    def update(self, estimate: Estimate, setpoint: Setpoint) -> Command:
        """The command, checked."""
        return own(self.part.ask("update", estimate, setpoint))


class ExternalClassifier(_Slot):
    """Asks a ground classifier for the classes of images."""

    kind = "classifier"

    def __init__(self, name: str, params: Mapping[str, Any], rig: Any) -> None:
        super().__init__(name, params, rig)
        self.image_size = int(self.part.inner.image_size)
        self.min_probability = float(self.part.inner.min_probability)

    def classify(self, images: NDArray[np.uint8]) -> GroundPrediction:
        """The predictions, checked."""
        found: GroundPrediction = self.part.ask("classify", images)
        table = np.array(found.probabilities, np.float64)
        table /= table.sum(axis=1, keepdims=True)
        return GroundPrediction(probabilities=table, in_distribution=found.in_distribution)

    def description(self) -> dict[str, Any]:
        """Name, image size, hash of the code and limit, for a result."""
        return {
            "network": self.part.name,
            "image_size": self.image_size,
            "sha256": imported_code(self.part.name),
            "min_probability": self.min_probability,
        }


class ExternalMapper(_Slot):
    """Asks a mapper for the map."""

    kind = "mapper"
    _given: MapView | None = None

    def update(self, obs: Observation, estimate: Estimate) -> MapView:
        """The map, checked whenever it is another one."""
        view: MapView = self.part.ask("update", obs, estimate)
        if view is not self._given:
            self._given, self._view = view, read_only(view)
        return self._view


class ExternalLander(_Slot):
    """Asks a lander for setpoints."""

    kind = "lander"

    def update(self, obs: Observation, estimate: Estimate, map_view: MapView) -> Setpoint:
        """The setpoint, checked."""
        return own(self.part.ask("update", obs, estimate, map_view))

    def view(self) -> LanderView:
        """The state of the mission, checked."""
        return self.part.ask("view")


class ExternalWatch(_Slot):
    """Asks a watch for its verdict."""

    kind = "watch"

    def look(self, seen: WatchInput) -> WatchReport:
        """The report, checked."""
        return own(self.part.ask("look", seen))


PARTS: Mapping[str, type[_Slot]] = {
    slot.kind: slot
    for slot in (
        ExternalEstimator,
        ExternalSelector,
        ExternalLander,
        ExternalController,
        ExternalMapper,
        ExternalClassifier,
        ExternalWatch,
    )
}
"""by slot"""
