"""The examination of an external part: it is asked as a flight asks it, and every rule that it
breaks is noted."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from touchdown.experiments.external.conformance_report import (
    Findings,
    LatencyWatch,
    Violation,
    digest,
    slow,
    trace_of,
)
from touchdown.experiments.external.estimate_checks import call, describe_error
from touchdown.experiments.external.loading import Build, wrong_signature
from touchdown.experiments.external.wrapper import Defect

COMMON_RULES: Mapping[str, str] = {
    "builds": "build(params, rig) returns an object with the methods of its kind",
    "answers": "every call returns what its kind returns and does not raise",
    "shapes": "every array has its shape",
    "finite": "every number is finite",
    "inputs": "what it is given is left as it was",
    "deterministic": "the same calls give the same answers to the bit",
    "missing data": "it answers where nothing has arrived yet",
    "latency": "a call takes no longer than a flight can wait",
}
"""Rules of all kinds beside the estimator, by name."""

_DIGEST_EVERY = 50
"""calls whose inputs are compared with what they were, of long sessions"""


class Trial:
    """One part under examination. ``wrong`` gives the defect of a built object, "" without one."""

    def __init__(
        self,
        kind: str,
        build: Build,
        params: Mapping[str, Any],
        rig: Any,
        wrong: Callable[[Any], str],
    ) -> None:
        self.kind, self.rig = kind, rig
        self.findings = Findings()
        self._build, self._params, self._wrong = build, params, wrong
        self.latency = LatencyWatch()
        self._calls = 0

    def broke(self, rule: str) -> bool:
        return any(violation.rule == rule for violation in self.findings.violations)

    def note(self, rule: str, reason: str, trace: str = "") -> None:
        """Notes a broken rule; the first reason of each counts."""
        if not self.broke(rule):
            self.findings.violations.append(Violation(rule, reason, trace))

    def judge(self, defect: Defect | None, what: str = "") -> None:
        """Notes a defect of an answer."""
        if defect is not None:
            self.note(defect.rule, f"{what} {defect.reason}".strip())

    def built(self) -> Any:
        """A new object, or None with the reason noted."""
        if reason := wrong_signature(self._build):
            self.note("builds", reason)
            return None
        rig = copy.deepcopy(self.rig)
        before = digest(rig)
        part, error = call(self._build, copy.deepcopy(dict(self._params)), rig)
        if error is not None:
            self.note("builds", f"build raised {describe_error(error)}", trace_of(error))
            return None
        if reason := self._wrong(part):
            self.note("builds", reason)
            return None
        if digest(rig) != before:
            self.note("inputs", "build modified the rig")
        return part

    def ask(
        self, part: Any, method: str, *arguments: Any, when: str = "", rule: str = "answers"
    ) -> Any:
        """The answer of a call, None where it raised. ``rule``: the one that it breaks then."""
        self._calls += 1
        watched = self._calls <= _DIGEST_EVERY or self._calls % _DIGEST_EVERY == 0
        given = copy.deepcopy(arguments) if watched else arguments
        before = digest(given) if watched else b""
        with self.latency:
            answer, error = call(getattr(part, method), *given)
        if error is not None:
            what = f"{when} {method} raised {describe_error(error)}".strip()
            self.note(rule, what, trace_of(error))
            return None
        if watched and digest(given) != before:
            self.note("inputs", f"{when} {method} modified what it was given".strip())
        return answer

    def sessions(self, session: Callable[[Any], Iterator[Any]]) -> None:
        """Runs ``session`` of two new objects, the second with another state of NumPy's global
        random numbers, and compares the answers that it yields."""
        first = self.built()
        if first is None:
            return
        answers = [digest(answer) for answer in session(first)]
        self.findings.figures["latency"] = self.latency.text()
        if reason := slow(self.kind, self.latency):
            self.note("latency", reason)
        second = self.built()
        if second is None or self.broke("answers"):
            return
        state = np.random.get_state()  # noqa: NPY002  the one that two objects share by mistake
        np.random.seed(20240229)  # noqa: NPY002
        try:
            for number, answer in enumerate(session(second)):
                if number >= len(answers) or digest(answer) != answers[number]:
                    self.note("deterministic", f"two runs differ from answer {number + 1} on")
                    return
        finally:
            np.random.set_state(state)  # noqa: NPY002
