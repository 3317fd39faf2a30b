"""The table of runs outside of a campaign, a line each, and what they come to."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pandas as pd

from touchdown.experiments.io.results import PartNames, RunResult
from touchdown.experiments.reporting.flights import values
from touchdown.experiments.reporting.report_tables import UNSAFE, landed_of
from touchdown.experiments.reporting.tables import Table, groups, make_table, value

_COLUMNS = (
    *(value(name) for name in ("scene", "estimator")),
    *(value(f"parts.{kind}", kind) for kind in PartNames.model_fields),
    *(value(name) for name in ("seed", "outcome")),
    *(
        value(column)
        for column in (
            "position_error_m.mean",
            "position_error_m.max",
            "position_error_m.yaw_deg",
            "trajectory_error_m",
            "landing.target_offset_m",
            "landing.vertical_speed_mps",
            "landing.vertical_accel_mps2",
            "landing.slope_deg",
            "landing.tilt_deg",
        )
    ),
    value("landing.safe_geometry", "safe geometry"),
    value("landing.class_true", "true class"),
    value("landing.class_predicted", "predicted class"),
    value("map.levelness_error_deg.mean"),
    value("timing.real_time_factor"),
)


def run_table(frame: pd.DataFrame) -> Table:
    """A table with a line per run; columns without any value are left out."""
    return make_table(frame, "runs", "Runs", _COLUMNS, ("run_id",), names=("run",))


def summary(frame: pd.DataFrame) -> dict[str, Any]:
    """Counts of outcomes and unsafe landings, and means over the runs that have the value, by
    method and condition."""
    means = {
        ", ".join(filter(None, names)): {
            column.column: float(found.mean())
            for column in _COLUMNS
            if column.column != "seed" and (found := _numbers(own, column.column)).size
        }
        for names, own in groups(frame, ("estimator", "condition"))
    }
    return {
        "runs": len(frame),
        "outcomes": {name: int(n) for name, n in frame["outcome"].value_counts().items()},
        "unsafe_touchdowns": UNSAFE.of(landed_of(frame)),
        "means": means,
    }


def _numbers(own: pd.DataFrame, column: str) -> Any:
    is_number = column in own and own[column].dtype.kind == "f"
    return values(own, column) if is_number else values(own, "")


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
