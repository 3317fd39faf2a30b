"""Measures of a report: figures with intervals over the flights of a scene and a method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from touchdown.experiments.reporting.flights import Row
from touchdown.experiments.reporting.queries import CellKey, numbers_by_cell
from touchdown.experiments.reporting.statistics import Estimate, mean_interval, variance_interval


@dataclass(frozen=True, slots=True)
class Measure:
    """``estimate`` takes one list of numbers per column, over the flights that have them all."""

    columns: tuple[str, ...]
    estimate: Callable[..., Estimate | None]


def mean_of(column: str) -> Measure:
    """Mean over flights of a column of the rows."""
    return Measure((column,), mean_interval)


TRAJECTORY_VARIANCE = Measure(("trajectory_error_m", "trajectory_variance_m2"), variance_interval)
"""sigma^2_tra over the flights, see `variance_interval`"""


def estimates(
    rows: Sequence[Row], measure: Measure, *, pooled: bool = False
) -> dict[CellKey, Estimate]:
    """Returns the figure of every cell that has one; with ``pooled``, of every method over all its
    scenes."""
    return {
        key: found
        for key, numbers in numbers_by_cell(rows, measure.columns, pooled=pooled).items()
        if (found := measure.estimate(*numbers)) is not None
    }
