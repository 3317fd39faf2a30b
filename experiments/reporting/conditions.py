"""The table of a campaign's conditions: everything that a requirement asks of the flights of one
condition, method and scene. A condition is what varies beside scene, method and seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from touchdown.experiments.campaign.directory import read_plan_file
from touchdown.experiments.campaign.results_table import is_campaign, is_successful
from touchdown.experiments.reporting.flights import Row, number, values
from touchdown.experiments.reporting.statistics import Estimate, mean_interval, ratio_interval
from touchdown.experiments.reporting.tables import (
    ALL_SCENES,
    MISSING,
    Cell,
    Table,
    figure,
    name_cell,
    ordered_cells,
)

_ERROR = "position_error_m.mean"


@dataclass(frozen=True, slots=True)
class _Figure:
    """A column of the table: the mean of ``column``, or its largest value."""

    title: str
    column: str
    largest: bool = False
    scale: float = 1.0

    def of(self, rows: Sequence[Row]) -> Estimate | None:
        numbers = [self.scale * value for value in values(rows, self.column)]
        if not numbers:
            return None
        return (
            Estimate(max(numbers), None, None, len(numbers))
            if self.largest
            else mean_interval(numbers)
        )


_FIGURES = (
    _Figure("mean error (m)", _ERROR),
    _Figure("worst flight (m)", _ERROR, largest=True),
    _Figure("largest error (m)", "position_error_m.max", largest=True),
    _Figure("NEES below 14.2 (%)", "nees.below_14_2", scale=100.0),
    _Figure("E_tra (m)", "trajectory_error_m"),
    _Figure("error at the commit (m)", "landing.estimate_error_at_commit_m"),
    _Figure("worst (m)", "landing.estimate_error_at_commit_m", largest=True),
    _Figure("error at contact (m)", "landing.estimate_error_at_contact_m"),
    _Figure("worst (m)", "landing.estimate_error_at_contact_m", largest=True),
    _Figure("d_L (m)", "landing.target_offset_m"),
)


def condition_of(row: Row) -> str:
    """What a run's name holds beside scene, method and seed; "" for a name of another form."""
    start = f"{Path(row['scene']).stem}-{row['estimator'].replace(':', '.')}-s{row['seed']}"
    name = Path(str(row["run_id"])).name
    return name.removeprefix(start).strip("-") if name.startswith(start) else ""


def first_condition(directory: Path) -> str:
    """The condition of the run that a campaign flies first; "" outside of a campaign."""
    if not is_campaign(directory):
        return ""
    for run in read_plan_file(directory)["runs"]:
        named = {key: str(run["values"].get(key)) for key in ("scene", "estimator", "seed")}
        return condition_of({**named, "run_id": run["run_id"]})
    return ""


def condition_table(rows: Sequence[Row], first: str = "") -> Table:
    """A line for each condition, method and scene, and for each method over all its scenes.

    ``first``: the condition that the others are compared with by the ratio of mean errors on equal
    scenes and seeds, where there are several.
    """
    conditions = list(dict.fromkeys(condition_of(row) for row in rows))
    conditions.sort(key=lambda name: (name != first, name))
    compared = len(conditions) > 1 and first in conditions
    kept = [f for f in _FIGURES if values(rows, f.column)]
    header = ["condition", "method", "scene", "flights", "successful", "DIVERGED"]
    header += [f.title for f in kept]
    header += [f"mean error over that of {first}"] if compared else []
    table = Table("conditions", "Flights by condition, method and scene", header, [])
    for condition in conditions:
        members = [row for row in rows if condition_of(row) == condition]
        for method, scene, group in _groups(members):
            line = [Cell(condition or MISSING), name_cell(method), name_cell(scene)]
            line += [Cell(str(count)) for count in _counts(group)]
            found = {f.title + f.column: f.of(group) for f in kept}
            line += map(figure, found.values())
            if compared:
                found["ratio"] = _ratio(group, _equal(group, rows, first))
                line.append(figure(found["ratio"]))
            table.rows.append(line)
            numbers = table.numbers.setdefault(condition or "all", {}).setdefault(method, {})
            counted = ("flights", "successful", "diverged")
            cell: dict[str, Any] = dict(zip(counted, _counts(group), strict=True))
            numbers[scene] = cell | {
                (f"{f.column}.worst" if f.largest else f.column): estimate.as_json()
                for f in kept
                if (estimate := found[f.title + f.column]) is not None
            }
            if (ratio := found.get("ratio")) is not None:
                numbers[scene]["error_ratio"] = ratio.as_json()
    return table


def _groups(rows: Sequence[Row]) -> list[tuple[str, str, list[Row]]]:
    """Method, scene and flights, and after several scenes of a method all of them together."""
    found: list[tuple[str, str, list[Row]]] = []
    cells = ordered_cells(rows)
    for method in dict.fromkeys(key.method for key in cells):
        own = [row for row in rows if row["estimator"] == method]
        scenes = [str(key.scene) for key in cells if key.method == method]
        found += [(method, s, [row for row in own if row["scene"] == s]) for s in scenes]
        if len(scenes) > 1:
            found.append((method, ALL_SCENES, own))
    return found


def _counts(rows: Sequence[Row]) -> tuple[int, int, int]:
    diverged = sum(row["outcome"] == "DIVERGED" for row in rows)
    return len(rows), sum(map(is_successful, rows)), diverged


def _key(row: Row) -> tuple[object, ...]:
    return row["scene"], row["estimator"], row["seed"]


def _equal(group: Sequence[Row], rows: Sequence[Row], first: str) -> Mapping[object, Row]:
    """Flights of the first condition by scene, method and seed."""
    wanted = {_key(row) for row in group}
    return {_key(r): r for r in rows if _key(r) in wanted and condition_of(r) == first}


def _ratio(group: Sequence[Row], others: Mapping[object, Row]) -> Estimate | None:
    """Ratio of the sums of errors over the flights that both conditions have."""
    pairs = [
        (mine, theirs)
        for row in group
        if (other := others.get(_key(row))) is not None
        and (mine := number(row, _ERROR)) is not None
        and (theirs := number(other, _ERROR)) is not None
    ]
    return ratio_interval(pairs)
