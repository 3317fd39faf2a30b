"""Broken rules of external parts, and digests that tell whether values are equal to the bit."""

from __future__ import annotations

import dataclasses
import functools
import time
import traceback
from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import Any, cast
from zlib import crc32

import numpy as np

from touchdown.experiments.external.wrapper import LONGEST_CALL_S
from touchdown.sim.api import Observation


@dataclass(frozen=True, slots=True)
class Violation:
    """Broken rule, a key of `RULES`, and the evidence."""

    rule: str
    reason: str
    trace: str = field(default="", compare=False)
    """traceback of the exception, if one was raised"""

    def __str__(self) -> str:
        return f"{self.rule}: {self.reason}"


@dataclass(slots=True)
class Findings:
    """What a check found out about a part."""

    violations: list[Violation] = field(default_factory=list)
    """the first of each rule"""
    figures: dict[str, str] = field(default_factory=dict)
    """measured figures by name, as text"""


class LatencyWatch:
    """Wall times of calls, each measured in a ``with`` of its own. The longest of each hundred, one
    at least, are left out of the mean: they may compile, or load a file."""

    def __init__(self) -> None:
        self._times: list[float] = []
        self._started = 0.0

    def __enter__(self) -> None:
        self._started = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        self._times.append(time.perf_counter() - self._started)

    @property
    def mean_s(self) -> float:
        """Of all calls but the longest; of that where there is no other; 0 without calls."""
        times = sorted(self._times)
        kept = times[: -1 - len(times) // 100] or times or [0.0]
        return sum(kept) / len(kept)

    def text(self) -> str:
        """Such as "0.31 ms a call, 6.2 ms the longest (200 calls)"."""
        longest = max(self._times, default=0.0)
        mean_ms, longest_ms = 1e3 * self.mean_s, 1e3 * longest
        return (
            f"{mean_ms:.3g} ms a call, {longest_ms:.3g} ms the longest ({len(self._times)} calls)"
        )


def slow(kind: str, latency: LatencyWatch) -> str:
    """Reason why a part is too slow; "" for another."""
    most_s = LONGEST_CALL_S[kind]
    if latency.mean_s <= most_s:
        return ""
    return f"{latency.text()}, above {1e3 * most_s:g} ms: a vehicle could not wait for it"


def trace_of(error: BaseException) -> str:
    """The traceback of an exception, without the frame of the caller here."""
    first = error.__traceback__.tb_next if error.__traceback__ is not None else None
    return "".join(traceback.format_exception(type(error), error, first))


_WHOLE_BYTES = 256
"""Arrays up to here stand in a digest as they are, larger ones by a checksum."""


def digests_of(obs: Observation) -> list[tuple[str, bytes]]:
    """Names and digests of an observation's fields."""
    names = [field.name for field in dataclasses.fields(obs)]
    return [(name, digest(getattr(obs, name))) for name in names]


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
