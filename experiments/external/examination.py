"""The examination of external parts: a part is asked in the synthetic world as a flight asks it,
and every rule that it breaks is noted. A kind of part has one function that asks it."""

import io
import itertools
import pickle
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from touchdown.experiments.external.loading import Build
from touchdown.experiments.external.wrapper import LONGEST_CALL_S, BrokenRuleError, ExternalPart

_COMMON = frozenset({
    "builds", "answers", "shapes", "finite", "inputs", "deterministic", "missing data", "latency",
})  # fmt: skip
RULES: Mapping[str, frozenset[str]] = {
    "estimator": _COMMON | {"time", "frames", "continuity", "twist", "motion"},
    "selector": _COMMON | {"terms", "order", "ground"},
    "lander": _COMMON | {"continuity", "mission", "touchdown"},
    "controller": _COMMON | {"steers", "limit", "stop"},
    "mapper": _COMMON | {"heights", "version"},
    "watch": _COMMON | {"warns", "calm"},
    "classifier": _COMMON | {"probabilities", "batch", "images"},
}
"""Names of the checked rules of each kind."""


@dataclass(frozen=True, slots=True)
class Violation:
    """Broken rule and the evidence."""

    rule: str
    reason: str
    trace: str = field(default="", compare=False)
    """traceback of the exception, if one was raised"""

    def __str__(self) -> str:
        return f"{self.rule}: {self.reason}"


@dataclass(slots=True)
class Findings:
    """What an examination found out about a part."""

    violations: list[Violation] = field(default_factory=list)
    """the first of each rule"""
    figures: dict[str, str] = field(default_factory=dict)
    """measured figures by name, as text"""

    def note(self, rule: str, reason: str, trace: str = "") -> None:
        """Notes a broken rule; the first reason of each counts."""
        if reason and not any(violation.rule == rule for violation in self.violations):
            self.violations.append(Violation(rule, reason, trace))


class Examined(ExternalPart):
    """A new part, and what it has answered. Raises BrokenRuleError where it breaks a rule."""

    def __init__(self, kind: str, build: Build, rig: Any, params: Mapping[str, Any]) -> None:
        super().__init__(kind, f"{build.__module__}:build", params, rig, build)
        self.figures: dict[str, str] = {}
        self.answers: list[tuple[str, int]] = []
        """of each call when it was and a digest of the answer, equal for answers that are equal to
        the bit"""
        self.times_s: list[float] = []
        self._last: Any = None

    def ask(
        self,
        method: str,
        *arguments: Any,
        when: str = "",
        rule: str = "answers",
        compared: Callable[[Any], Any] = lambda answer: answer,
    ) -> Any:
        """As `ExternalPart.ask`. ``compared``: what of the answer is to repeat."""
        before = self.seconds
        answer = super().ask(method, *arguments, when=when, rule=rule)
        self.times_s.append(self.seconds - before)
        if answer is not self._last or not self.answers:
            self.answers.append((when or method, _digest(compared(answer))))
        self._last = answer
        return answer


Examiner = Callable[[Examined], Iterator[tuple[str, str]]]
"""asks a part; gives rules, each with the reason why the part breaks it, "" where it does not"""


def examine_as(examiner: Examiner, start: Callable[[], Examined]) -> Findings:
    """The rules that a part breaks, its latency and other figures. ``start`` makes a new one.

    Two are asked the same, the second with another state of NumPy's global random numbers, and
    their answers compared."""
    findings = Findings()
    first = attempt(findings, start, examiner)
    if first is None:
        return findings
    text, reason = _latency(first.times_s, LONGEST_CALL_S[first.kind], first.map_text)
    findings.figures = {**first.figures, "latency": text}
    findings.note("latency", reason)
    state = np.random.get_state()  # noqa: NPY002  the one that two objects share by mistake
    np.random.seed(20240229)  # noqa: NPY002
    try:
        again = attempt(findings, start, examiner)
    finally:
        np.random.set_state(state)  # noqa: NPY002
    for one, other in itertools.zip_longest(first.answers, again.answers if again else ()):
        if one != other:
            when = (one or other)[0].removeprefix("at ")
            findings.note("deterministic", f"two runs differ from {when} on")
    return findings


def attempt(
    findings: Findings, start: Callable[[], Examined], examiner: Examiner
) -> Examined | None:
    """Asks a new part, and notes what it breaks. Returns it where it has answered all."""
    try:
        part = start()
        for rule, reason in examiner(part):
            findings.note(rule, reason)
    except BrokenRuleError as error:
        findings.note(error.rule, error.reason, _trace_of(error.__cause__))
        return None
    return part


def _latency(times_s: list[float], max_s: float, where: str) -> tuple[str, str]:
    """Processor times of calls as text, and the reason why the part is too slow, "" for another.
    The longest of each hundred, one at least, are left out of the mean: they may compile, or load a
    file. ``where``: on what they were measured."""
    ordered = sorted(times_s)
    mean_s = float(np.mean(ordered[: -1 - len(ordered) // 100] or ordered))
    text = (
        f"{1e3 * mean_s:.3g} ms a call, {1e3 * ordered[-1]:.3g} ms the longest "
        f"({len(ordered)} calls{where}, processor time)"
    )
    slow = f"{text}, above {1e3 * max_s:g} ms: a vehicle could not wait for it"
    return text, slow if mean_s > max_s else ""


def _trace_of(error: BaseException | None) -> str:
    """The traceback of an exception, without the frame of the caller here."""
    if error is None:
        return ""
    first = error.__traceback__.tb_next if error.__traceback__ is not None else None
    return "".join(traceback.format_exception(type(error), error, first))


def _digest(value: Any) -> int:
    pickled = io.BytesIO()
    pickler = pickle.Pickler(pickled, pickle.HIGHEST_PROTOCOL)
    pickler.fast = True  # equal values alike, be they one object or two
    try:
        pickler.dump(value)
    except Exception:  # of a class of somebody that cannot be pickled
        return 0
    return hash(pickled.getvalue())
