"""The examination of an external part: it is asked as a flight asks it, and every rule that it
breaks is noted."""

from __future__ import annotations

import copy
import dataclasses
import functools
import time
import traceback
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, NamedTuple, cast
from zlib import crc32

import numpy as np

from touchdown.experiments.external.estimate_checks import call, describe_error
from touchdown.experiments.external.loading import Build, wrong_signature
from touchdown.experiments.external.wrapper import LONGEST_CALL_S, Defect

COMMON_RULES: Mapping[str, str] = {
    "builds": "build(params, rig) returns an object with the methods of its kind",
    "answers": "every call returns what its kind returns and does not raise",
    "shapes": "every array has its shape",
    "finite": "every number is finite",
    "inputs": "what it is given is left as it was",
    "deterministic": "the same calls give the same answers to the bit",
    "missing data": "it answers where nothing has arrived yet, or no longer",
    "latency": "a call takes no longer than a flight can wait",
}
"""Rules of all kinds, by name."""

_WATCHED_CALLS = 50
"""So many calls at first, and then every so many, are compared with what they were given."""
_NOTHING = object()
_WHOLE_BYTES = 256
"""Arrays up to here stand in a digest as they are, larger ones by a checksum."""


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

    def broke(self, *rules: str) -> bool:
        """True if one of these rules is broken."""
        return any(violation.rule in rules for violation in self.violations)

    def note(self, rule: str, reason: str, error: BaseException | None = None) -> None:
        """Notes a broken rule; the first reason of each counts."""
        if not self.broke(rule):
            self.violations.append(Violation(rule, reason, _trace_of(error)))


class Check(NamedTuple):
    """A rule and the function that gives the reason why a session breaks it; "" where none does."""

    rule: str
    reason: Callable[[Any], str]

    @property
    def sentence(self) -> str:
        """What the rule says."""
        return " ".join((self.reason.__doc__ or "").split()).rstrip(".")


def checks_of(*functions: Callable[[Any], str]) -> tuple[Check, ...]:
    """Checks whose rules are named as their functions."""
    return tuple(Check(function.__name__, function) for function in functions)


class SessionOver(Exception):  # noqa: N818  no error of anybody
    """A part has raised or answered wrongly: it is not asked any further."""


class Examination:
    """One part under examination. ``wrong`` gives the defect of a built object, "" without one;
    ``kept_calls``: what it was given in so many last calls is watched for later writes."""

    def __init__(
        self,
        kind: str,
        build: Build,
        params: Mapping[str, Any],
        rig: Any,
        wrong: Callable[[Any], str],
        kept_calls: int = 0,
    ) -> None:
        self.kind, self.rig, self.findings = kind, rig, Findings()
        self._build, self._params, self._wrong = build, params, wrong
        self._kept_calls, self._times_s, self._calls = kept_calls, list[float](), 0
        self._given: deque[tuple[str, Any, list[tuple[str, bytes]]]] = deque()
        self._answers: list[bytes] = []
        self._expected: list[bytes] | None = None

    def built(self) -> Any:
        """A new object, or None with the reason noted."""
        if reason := wrong_signature(self._build):
            self.findings.note("builds", reason)
            return None
        rig = copy.deepcopy(self.rig)
        before = digest(rig)
        part, error = call(self._build, copy.deepcopy(dict(self._params)), rig)
        reason = self._wrong(part) if error is None else f"build raised {describe_error(error)}"
        if reason:
            self.findings.note("builds", reason, error)
            return None
        if digest(rig) != before:
            self.findings.note("inputs", "build modified the rig")
        return part

    def twice(self, session: Callable[[Any], None]) -> None:
        """Runs ``session`` with two new objects, the second with another state of NumPy's global
        random numbers, and compares their answers. The first one's latency is noted."""
        self.once(session)
        if not self._calls:
            return
        first, (text, reason) = self._answers, self._latency()
        self.findings.figures["latency"] = text
        if reason:
            self.findings.note("latency", reason)
        if self.findings.broke("answers"):
            return
        state = np.random.get_state()  # noqa: NPY002  the one that two objects share by mistake
        np.random.seed(20240229)  # noqa: NPY002
        try:
            self.once(session, expected=first)
        finally:
            np.random.set_state(state)  # noqa: NPY002

    def once(self, session: Callable[[Any], None], expected: list[bytes] | None = None) -> None:
        """Runs ``session`` with a new object until it is over."""
        part = self.built()
        self._answers, self._expected = [], expected
        if part is None:
            return
        with suppress(SessionOver):
            session(part)
        self._compare_given(0)

    def judge(self, checks: Iterable[Check], session: Any) -> None:
        """Notes the rules that a session breaks."""
        for check in checks:
            if reason := check.reason(session):
                self.findings.note(check.rule, reason)

    def ask(
        self,
        part: Any,
        method: str,
        *arguments: Any,
        when: str = "",
        rule: str = "answers",
        wrong: Callable[[Any], Defect | None] = lambda _: None,
        compared: Callable[[Any], Any] = lambda answer: answer,
        known: Any = _NOTHING,
    ) -> Any:
        """The answer of a call. Where it raises, or its answer is ``wrong``, the broken rule is
        noted and the session ends. ``rule``: the one that an exception breaks; ``compared``: what
        of the answer is to repeat; ``known``: an earlier answer, which is not looked at again."""
        self._calls += 1
        every = self._kept_calls or self._calls <= _WATCHED_CALLS
        if every or self._calls % _WATCHED_CALLS == 0:
            arguments = copy.deepcopy(arguments)
            self._given.append((f"{when} {method}".strip(), arguments, _digests(arguments)))
        started = time.perf_counter()
        answer, error = call(getattr(part, method), *arguments)
        self._times_s.append(time.perf_counter() - started)
        if error is not None:
            text = f"{when} {method} raised {describe_error(error)}".strip()
            self.findings.note(rule, text, error)
            raise SessionOver
        self._compare_given(self._kept_calls)
        if answer is known:
            return answer
        if defect := wrong(answer):
            text = f"{when} {method} returned {defect.reason}".strip()
            self.findings.note(defect.rule, text)
            raise SessionOver
        self._repeat(compared(answer), when or method)
        return answer

    def _repeat(self, answer: Any, when: str) -> None:
        self._answers.append(digest(answer))
        number = len(self._answers) - 1
        if self._expected is not None and self._answers[-1:] != self._expected[number : number + 1]:
            self.findings.note(
                "deterministic", f"two runs differ from {when.removeprefix('at ')} on"
            )
            raise SessionOver

    def _compare_given(self, kept: int) -> None:
        while len(self._given) > kept:
            what, arguments, before = self._given.popleft()
            for (name, now), (_, old) in zip(_digests(arguments), before, strict=True):
                if now != old:
                    self.findings.note("inputs", f"{what}: '{name}' modified, which it was given")

    def _latency(self) -> tuple[str, str]:
        """Wall times of calls as text, and the reason why the part is too slow, "" for another. The
        longest of each hundred, one at least, are left out of the mean: they may compile, or load
        a file."""
        times_s = sorted(self._times_s)
        kept = times_s[: -1 - len(times_s) // 100] or times_s
        mean_s, most_s = sum(kept) / len(kept), LONGEST_CALL_S[self.kind]
        text = (
            f"{1e3 * mean_s:.3g} ms a call, {1e3 * times_s[-1]:.3g} ms the longest "
            f"({len(times_s)} calls)"
        )
        slow = f"{text}, above {1e3 * most_s:g} ms: a vehicle could not wait for it"
        return text, slow if mean_s > most_s else ""


def _trace_of(error: BaseException | None) -> str:
    """The traceback of an exception, without the frame of the caller here."""
    if error is None:
        return ""
    first = error.__traceback__.tb_next if error.__traceback__ is not None else None
    return "".join(traceback.format_exception(type(error), error, first))


def _digests(arguments: tuple[Any, ...]) -> list[tuple[str, bytes]]:
    """Names and digests of arguments, of a message by field."""
    found: list[tuple[str, bytes]] = []
    for number, value in enumerate(arguments, start=1):
        names = _field_names(cast(Hashable, type(value)))
        if names is None:
            found.append((f"argument {number}", digest(value)))
        found += [(name, digest(getattr(value, name))) for name in names or ()]
    return found


def digest(value: Any) -> bytes:
    """Bytes that are equal for values that are equal to the bit."""
    pieces: list[bytes] = []
    _add_pieces(value, pieces)
    return b"".join(pieces)


@functools.cache
def _field_names(kind: Hashable) -> tuple[str, ...] | None:
    """Of a dataclass; None for another type."""
    if not dataclasses.is_dataclass(kind):
        return None
    return tuple(field.name for field in dataclasses.fields(kind))


def _add_pieces(value: Any, pieces: list[bytes]) -> None:
    if isinstance(value, np.ndarray):
        pieces.append(f"{value.dtype.str}{value.shape}".encode())
        if value.nbytes <= _WHOLE_BYTES and not value.dtype.hasobject:
            pieces.append(value.tobytes())
        else:
            data = np.ascontiguousarray(value)
            pieces.append(str(crc32(data.view(np.uint8).data)).encode())
    elif isinstance(value, float | int | str):
        pieces.append(repr(value).encode())
    elif (names := _field_names(cast(Hashable, type(value)))) is not None:
        for name in names:
            _add_pieces(getattr(value, name), pieces)
    elif isinstance(value, tuple | list):
        pieces.append(str(len(value)).encode())
        for item in value:
            _add_pieces(item, pieces)
    elif hasattr(value, "items"):
        for name, item in value.items():
            pieces.append(str(name).encode())
            _add_pieces(item, pieces)
    else:
        pieces.append(repr(value).encode())
