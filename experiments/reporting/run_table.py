"""The Markdown table of runs outside of a campaign."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from touchdown.experiments.io.results import LANDED, PartNames, RunResult, lookup
from touchdown.experiments.reporting.conditions import label_conditions
from touchdown.experiments.reporting.markdown_text import markdown_cell
from touchdown.experiments.reporting.measures import titled


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

    @property
    def heading(self) -> str:
        """The title, marked where the configuration sets the figures."""
        return titled(self.title, self.path)


LANDING_COLUMNS: tuple[Column, ...] = (
    Column("run", "run"),
    Column("scene", "scene"),
    Column("estimator", "estimator"),
    *(Column(kind, f"parts.{kind}") for kind in PartNames.model_fields),
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
    lines = ["| " + " | ".join(column.heading for column in kept) + " |"]
    lines.append("|" + "---|" * len(kept))
    cells = ([markdown_cell(column.text(row)) for column in kept] for row in rows)
    lines += [f"| {' | '.join(line)} |" for line in cells]
    return "\n".join(lines)


def as_rows(runs: Mapping[str, RunResult]) -> list[dict[str, Any]]:
    """The plain results with the name of each run as ``run``."""
    return [{**result.plain(), "run": name} for name, result in runs.items()]


def summary(runs: Mapping[str, RunResult], directory: Path) -> dict[str, Any]:
    """Counts of outcomes and unsafe touchdowns, and means over the runs below ``directory`` that
    have the value, by method and condition."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for name, row in zip(_group_names(runs, directory), as_rows(runs), strict=True):
        groups.setdefault(name, []).append(row)
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
        "means": {name: _means(rows) for name, rows in groups.items()},
    }


def _group_names(runs: Mapping[str, RunResult], directory: Path) -> list[str]:
    """Method and condition of each run: ``livo``, or ``livo, night`` where these vary."""
    found: list[dict[str, Any]] = [
        {
            "run_id": name,
            "run_dir": directory if (directory / "result.json").is_file() else directory / name,
            **{key: getattr(run, key) for key in ("scene", "estimator", "seed", "profile")},
            "wind_kmh": run.wind_kmh,
        }
        for name, run in runs.items()
    ]
    label_conditions(found)
    return [", ".join(filter(None, (row["estimator"], row["condition"]))) for row in found]


def _means(rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """The mean of every column of numbers."""
    means: dict[str, float] = {}
    for column in LANDING_COLUMNS:
        values = [lookup(row, column.path) for row in rows]
        if numbers := [value for value in values if isinstance(value, float)]:
            means[column.path] = fmean(numbers)
    return means


def summary_line(totals: Mapping[str, Any]) -> str:
    """Returns ``3 runs: LANDED 2, NO_SITE 1; 1 unsafe touchdown`` of a `summary`."""
    runs, unsafe = totals["runs"], totals["unsafe_touchdowns"]
    counts = ", ".join(f"{name} {count}" for name, count in sorted(totals["outcomes"].items()))
    line = f"{runs} run{'s' * (runs != 1)}: {counts}"
    return line + (f"; {unsafe} unsafe touchdown{'s' * (unsafe != 1)}" if unsafe else "")


def missed_lines(runs: Mapping[str, RunResult]) -> list[str]:
    """A line for each run without a site, or that gave one up: what it refused, by the truth."""
    return [
        f"{name}: {run.outcome}: {run.choice.missed.sentence()}"
        for name, run in runs.items()
        if run.choice is not None and run.choice.missed is not None
    ]
