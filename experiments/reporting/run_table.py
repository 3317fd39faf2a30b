"""Tables over finished runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from touchdown.experiments.api import ground_was_safe
from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.results import Row, load_run, lookup


@dataclass(frozen=True, slots=True)
class Column:
    """``path`` leads to the value in result.json, dots between the keys."""

    title: str
    path: str
    format: str = "{}"

    def text(self, row: Row) -> str:
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
    Column("taken for", "landing.class_predicted"),
    Column("levelness (deg)", "map.levelness_error_deg.mean", "{:.2f}"),
    Column("real-time factor", "timing.real_time_factor", "{:.2f}"),
)


def load_runs(directory: Path) -> list[dict[str, Any]]:
    """Every ``result.json`` at or below ``directory``, by scene, estimator and seed, and below
    ``run`` the directory that it lies in, from ``directory`` on.

    Raises UsageError when there is none or one cannot be read.
    """
    if not directory.is_dir():
        raise UsageError(f"'{directory}' is no directory of runs")
    rows = [
        {**load_run(path), "run": _name(path.parent, directory)}
        for path in sorted(directory.rglob("result.json"))
    ]
    if not rows:
        raise UsageError(f"'{directory}' holds no finished run (no result.json)")
    return sorted(rows, key=lambda row: (row["scene"], row["estimator"], row["seed"]))


def _name(run: Path, directory: Path) -> str:
    return directory.resolve().name if run == directory else run.relative_to(directory).as_posix()


def markdown_table(rows: list[dict[str, Any]], columns: tuple[Column, ...]) -> str:
    """One row a run; columns without any value are left out."""
    kept = [c for c in columns if any(lookup(row, c.path) is not None for row in rows)]
    lines = ["| " + " | ".join(column.title for column in kept) + " |"]
    lines.append("|" + "---|" * len(kept))
    lines += ["| " + " | ".join(column.text(row) for column in kept) + " |" for row in rows]
    return "\n".join(lines)


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Counts of outcomes and unsafe touchdowns, and means over the runs that have the value."""
    outcomes: dict[str, int] = {}
    for row in rows:
        outcomes[row["outcome"]] = outcomes.get(row["outcome"], 0) + 1
    means: dict[str, float | None] = {}
    for column in LANDING_COLUMNS:
        values = [lookup(row, column.path) for row in rows]
        numbers = [float(v) for v in values if isinstance(v, float)]
        if numbers:
            means[column.path] = fmean(numbers)
    unsafe = sum(
        row["outcome"] == "LANDED" and ground_was_safe(row.get("landing") or {}) is False
        for row in rows
    )
    return {"runs": len(rows), "outcomes": outcomes, "unsafe_touchdowns": unsafe, "means": means}


def summary_line(totals: Mapping[str, Any]) -> str:
    """``3 runs: LANDED 2, NO_SITE 1; 1 unsafe touchdown``, of `summary`."""
    runs, unsafe = totals["runs"], totals["unsafe_touchdowns"]
    counts = ", ".join(f"{name} {count}" for name, count in sorted(totals["outcomes"].items()))
    line = f"{runs} run{'s' * (runs != 1)}: {counts}"
    return line + (f"; {unsafe} unsafe touchdown{'s' * (unsafe != 1)}" if unsafe else "")
