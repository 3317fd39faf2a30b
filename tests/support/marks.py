"""A few numbers of large results, which tell whether one has changed."""

import dataclasses
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
import pytest

from touchdown.sim.typing import Array

PERIOD = 10007
"""a prime, so that no row or column of a picture meets one weight alone"""
WEIGHTS = np.random.default_rng(20).standard_normal((3, PERIOD))

Marks = dict[str, list[float]]
"""by part: how many values there are, their norm, and three weighted sums"""


def numbers(value: Any) -> Iterator[Array]:
    """All numbers in a value, texts as their checksums."""
    if isinstance(value, str):
        yield np.array([crc32(value.encode()) / 2**32])
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield from numbers(getattr(value, field.name))
    elif isinstance(value, Mapping):
        yield from numbers([item for key in sorted(value) for item in (key, value[key])])
    elif isinstance(value, list | tuple):
        for item in value:
            yield from numbers(item)
    else:
        yield np.ravel(np.asarray(-1.0 if value is None else value))


def marks_of(parts: Mapping[str, Any]) -> Marks:
    return {name: _marks(value) for name, value in parts.items()}


def _marks(value: Any) -> list[float]:
    values = np.concatenate([np.zeros(0, np.uint8), *numbers(value)])
    folded = np.pad(values, (0, -values.size % PERIOD)).reshape(-1, PERIOD)
    sums = WEIGHTS @ folded.sum(axis=0, dtype=np.float64)
    square = np.einsum("i,i", values, values, dtype=np.float64, casting="unsafe")
    return [float(f"{one:.9g}") for one in (values.size, np.sqrt(square), *sums)]


def check(file: Path, what: str, found: Mapping[str, Any], loose: Mapping[str, float]) -> None:
    """Whether parts are as in a file of `write`, within 1e-6 of their norm or what ``loose``
    says of what the name of a part begins with: processors round differently."""
    told, marks = json.loads(file.read_text())[what], marks_of(found)
    assert told.keys() == marks.keys()
    for name, (size, norm, *sums) in told.items():
        assert marks[name][0] == size, name
        within = loose.get(name.partition(",")[0], 1e-6) * norm + 1e-9
        assert marks[name][1:] == pytest.approx([norm, *sums], abs=within, rel=0.0), name


def write(file: Path, all_parts: Mapping[str, Mapping[str, Any]]) -> None:
    lines = (f'"{what}": {json.dumps(marks_of(parts))}' for what, parts in all_parts.items())
    file.write_text("{\n" + ",\n".join(lines) + "\n}\n")
