"""Error of the estimate over the distance flown, which separates drift from a constant offset."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from touchdown.experiments.reporting.flights import Row, airborne, methods_of, read_trajectory
from touchdown.experiments.reporting.measures import estimates, is_marked, mean_of, setting_notes
from touchdown.experiments.reporting.queries import CellKey
from touchdown.experiments.reporting.tables import Table, figure, name_cell

BINS_M = (0.0, 50.0, 100.0, 150.0, 200.0)
_NAMES = tuple(f"{first:.0f}-{last:.0f}" for first, last in pairwise(BINS_M))


def error_by_distance(run_dir: Path) -> dict[str, float]:
    """Mean 3-D error of the estimate (m) while the distance flown since lift-off, by the truth, was
    within each pair of neighbours of `BINS_M`; bins that a flight did not reach are left out."""
    truth = read_trajectory(run_dir / "truth.tum")
    estimate = read_trajectory(run_dir / "estimate.tum")
    if truth is None or estimate is None:
        return {}
    count = min(len(truth.time_s), len(estimate.time_s))
    start = airborne(truth)
    if count <= start + 1 or not np.allclose(truth.time_s[:count], estimate.time_s[:count]):
        return {}
    position = truth.position[start:count]
    steps = np.linalg.norm(np.diff(position, axis=0), axis=1)
    flown = np.concatenate([[0.0], np.cumsum(steps)])
    error = np.linalg.norm(estimate.position[start:count] - position, axis=1)
    found = {}
    for name, first, last in zip(_NAMES, BINS_M[:-1], BINS_M[1:], strict=True):
        inside = (flown >= first) & (flown < last)
        if flown[-1] >= last - 0.1 * (last - first):
            found[name] = float(error[inside].mean())
    return found


def add_errors_by_distance(rows: list[dict[str, Any]]) -> None:
    """Adds the keys ``error_by_distance.0-50`` and so on to survey flights, from their files."""
    for row in rows:
        if row["mode"] == "fly":
            for name, value in error_by_distance(Path(row["run_dir"])).items():
                row[f"error_by_distance.{name}"] = value


def distance_tables(rows: Sequence[Row]) -> list[Table]:
    """One table, methods down and distances across, over all scenes; none without such figures."""
    names = [n for n in _NAMES if any(f"error_by_distance.{n}" in row for row in rows)]
    if len(names) < 2:
        return []
    header = ["method", *(f"{name} m" for name in names)]
    table = Table("distance", "Position error (m) over the distance flown", header, [])
    by_bin = {n: estimates(rows, mean_of(f"error_by_distance.{n}"), pooled=True) for n in names}
    for method in methods_of(rows):
        found = {n: by_method.get(CellKey(method)) for n, by_method in by_bin.items()}
        marked = is_marked(f"error_by_distance.{names[0]}", method)
        table.rows.append([name_cell(method), *(figure(found[n], marked=marked) for n in names)])
        table.numbers[method] = {n: e.value if e else None for n, e in found.items()}
    table.notes = setting_notes([f"error_by_distance.{names[0]}"], methods_of(rows))
    table.notes += ["All scenes together; the climb to the survey's height counts as distance too."]
    return [table]
