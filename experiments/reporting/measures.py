"""Measures of a report: figures with intervals over the flights of a scene and a method, and which
figures are set by the configuration instead of measured."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
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


# ---------------------------------------------------------------------------------- set figures


@dataclass(frozen=True, slots=True)
class Setting:
    """Figures that a key of the configuration sets. They are marked wherever they are printed, and
    no comparison with the paper has them.

    ``columns``: columns of the rows, or their beginnings up to a dot. ``methods``: the estimators
    whose figures are set; of all of them where it is empty.
    """

    name: str
    columns: tuple[str, ...]
    key: str
    why: str
    methods: tuple[str, ...] = ()


SETTINGS: tuple[Setting, ...] = (
    Setting(
        "T_total", ("map.duration_s",), "survey.duration_s", "the survey is planned to last as long"
    ),
    Setting(
        "v_z",
        ("landing.vertical_speed_mps",),
        "landing.touchdown_speed_mps",
        "the last part of the descent is commanded at it",
    ),
    Setting(
        "the error of `gps`",
        ("trajectory_error_m", "trajectory_variance_m2", "position_error_m.", "path_deviation.",
         "error_by_distance."),
        "gps.preset",
        "the error is the receiver's, whose preset was fitted to the paper's Table 2",
        ("gps",),
    ),
)  # fmt: skip
SET_MARK = "(set)"


def setting_of(column: str, method: str | None = None) -> Setting | None:
    """The setting that the figure of ``column`` comes from with ``method``; None for a measured
    figure. Without a method: only a setting of all methods."""
    for setting in SETTINGS:
        of_method = not setting.methods or method in setting.methods
        if of_method and any(
            column == name or (name.endswith(".") and column.startswith(name))
            for name in setting.columns
        ):
            return setting
    return None


def is_marked(column: str, method: str) -> bool:
    """True if a figure is set with ``method`` and measured with others, so that its own cell and
    not the title of its column bears the mark."""
    return setting_of(column, method) is not None and setting_of(column) is None


def titled(title: str, column: str) -> str:
    """``title`` of a column, marked where the configuration sets its figures."""
    return f"{title} {SET_MARK}" if setting_of(column) else title


def setting_notes(columns: Iterable[str], methods: Iterable[str]) -> list[str]:
    """A sentence on each setting that ``columns`` show with ``methods``."""
    known = list(methods)
    found = {
        setting.name: setting
        for column in columns
        for method in known
        if (setting := setting_of(column, method)) is not None
    }
    return [
        f"{SET_MARK}: {setting.name} is set by `{setting.key}`, not measured ({setting.why}), and "
        "is not compared with the paper."
        for setting in found.values()
    ]
