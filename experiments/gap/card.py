"""A row of the card: what is compared, its distance, its bound, and whether it holds."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from touchdown.sim.typing import Array


class Curves(NamedTuple):
    """One quantity of recordings and of the simulator over a common axis."""

    x: Array
    """(M,)"""
    recorded: Array
    """(K, M)"""
    simulated: Array
    """(L, M)"""


@dataclass(frozen=True, kw_only=True)
class Row:
    """A comparison. ``measure`` returns None where the folder of recordings has none of its."""

    name: str
    x: str
    """axis of the curves"""
    y: str
    """quantity, with its unit"""
    source: str
    """the recordings"""
    tuned: bool
    """the simulator's constants were chosen with these recordings in view; else it is a check"""
    changed: str
    """what of the simulator follows from them"""
    bound: float | None = None
    """largest distance; None: that of half of the recordings from the median of the others"""
    explained: str = ""
    """why the row misses its bound, where it does"""
    measure: Callable[[Path], Curves | None]


@dataclass(frozen=True, kw_only=True)
class Compared:
    """A row with its figures."""

    row: Row
    curves: Curves
    distance: float
    """root mean square over the axis of the difference of the medians"""
    bound: float

    @property
    def holds(self) -> bool:
        """True within the bound."""
        return self.distance <= self.bound

    def plain(self) -> dict[str, Any]:
        """The figures for JSON."""
        return {
            "name": self.row.name, "distance": self.distance, "bound": self.bound,
            "holds": self.holds, "recordings": len(self.curves.recorded),
            "tuned": self.row.tuned, "quantity": self.row.y,
        }  # fmt: skip


def compared(row: Row, curves: Curves) -> Compared:
    """Distance and bound of a row."""
    middle = np.median(curves.recorded, axis=0)
    distance = _apart(np.median(curves.simulated, axis=0), middle)
    bound = spread(curves.recorded) if row.bound is None else row.bound
    return Compared(row=row, curves=curves, distance=distance, bound=bound)


def spread(recorded: Array) -> float:
    """The distance of half of the recordings (K, M), K above 1, from the median of the others."""
    rows = range(len(recorded))
    apart = [_apart(recorded[k], np.median(np.delete(recorded, k, axis=0), axis=0)) for k in rows]
    return float(np.median(apart))


def _apart(one: Array, other: Array) -> float:
    return float(np.sqrt(np.mean((one - other) ** 2)))


def first_file(data: Path, ending: str) -> Path | None:
    """The first file below ``data``, by name, whose path ends so; None without one."""
    found = (
        Path(folder, name) for folder, _, names in os.walk(data, followlinks=True) for name in names
    )
    return min((file for file in found if file.as_posix().endswith("/" + ending)), default=None)
