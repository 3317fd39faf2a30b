"""The Markdown table of runs outside of a campaign."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

from touchdown.experiments.io.results import LANDED, RunResult, lookup
from touchdown.experiments.reporting.markdown_text import markdown_cell


@dataclass(frozen=True, slots=True)
class Column:
    """A column of the table; ``path``: the dotted key in ``result.json``."""

    title: str
    path: str
    format: str = "{}"

    def text(self, row: Mapping[str, Any]) -> str:
        """The cell of a row."""
        value = lookup(row, self.path)
        if value is None:
            return "–"
        if isinstance(value, bool):
            return "yes" if value else "no"
        return self.format.format(value)


LANDING_COLUMNS: tuple[Column, ...] = (
    Column("run", "run"),
    Column("scene", "scene"),
    Column("estimator", "estimator"),
    Column("seed", "seed"),
    Column("outcome", "outcome"),
    Column("position error mean (m)", "position_error_m.mean", "{:.3f}"),
    Column("max (m)", "position_error_m.max", "{:.3f}"),
    Column("yaw (deg)", "position_error_m.yaw_deg", "{:.3f}"),
    Column("E_tra (m)", "trajectory_error_m", "{:.3f}"),
    Column("d_L (m)", "landing.target_offset_m", "{:.3f}"),
    Column("v_z (m/s)", "landing.vertical_speed_mps", "{:.3f}"),
    Column("a_z (m/s²)", "landing.vertical_accel_mps2", "{:.3f}"),
    Column("slope (deg)", "landing.slope_deg", "{:.2f}"),
    Column("tilt (deg)", "landing.tilt_deg", "{:.2f}"),
    Column("safe geometry", "landing.safe_geometry"),
    Column("true class", "landing.class_true"),
    Column("predicted class", "landing.class_predicted"),
    Column("levelness (deg)", "map.levelness_error_deg.mean", "{:.2f}"),
    Column("real-time factor", "timing.real_time_factor", "{:.2f}"),
)


def markdown_table(runs: Mapping[str, RunResult], columns: Sequence[Column]) -> str:
    """Returns a Markdown table with one line per run; columns without any value are left out."""
    rows = as_rows(runs)
    kept = [c for c in columns if any(lookup(row, c.path) is not None for row in rows)]
    lines = ["| " + " | ".join(column.title for column in kept) + " |"]
    lines.append("|" + "---|" * len(kept))
    cells = ([markdown_cell(column.text(row)) for column in kept] for row in rows)
    lines += [f"| {' | '.join(line)} |" for line in cells]
    return "\n".join(lines)


def as_rows(runs: Mapping[str, RunResult]) -> list[dict[str, Any]]:
    """The plain results with the name of each run as ``run``."""
    return [{**result.plain(), "run": name} for name, result in runs.items()]


def summary(runs: Mapping[str, RunResult]) -> dict[str, Any]:
    """Counts of outcomes and unsafe touchdowns, and means over the runs that have the value."""
    rows = as_rows(runs)
    means: dict[str, float] = {}
    for column in LANDING_COLUMNS:
        values = [lookup(row, column.path) for row in rows]
        numbers = [value for value in values if isinstance(value, float)]
        if numbers:
            means[column.path] = fmean(numbers)
    unsafe = sum(
        result.outcome == LANDED
        and result.landing is not None
        and result.landing.ground_safe is False
        for result in runs.values()
    )
    return {
        "runs": len(runs),
        "outcomes": dict(Counter(result.outcome for result in runs.values())),
        "unsafe_touchdowns": unsafe,
        "means": means,
    }


def summary_line(totals: Mapping[str, Any]) -> str:
    """Returns ``3 runs: LANDED 2, NO_SITE 1; 1 unsafe touchdown`` of a `summary`."""
    runs, unsafe = totals["runs"], totals["unsafe_touchdowns"]
    counts = ", ".join(f"{name} {count}" for name, count in sorted(totals["outcomes"].items()))
    line = f"{runs} run{'s' * (runs != 1)}: {counts}"
    return line + (f"; {unsafe} unsafe touchdown{'s' * (unsafe != 1)}" if unsafe else "")
