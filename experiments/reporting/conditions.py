"""Conditions of flights, and their table: everything that a requirement asks of the flights of one
condition, method and scene. A condition is what varies beside scene, method and seed; no figure of
a report is over flights of several."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from touchdown.experiments.campaign.directory import read_plan_file
from touchdown.experiments.campaign.results_table import is_campaign, is_successful
from touchdown.experiments.config.keys import flatten
from touchdown.experiments.config.settings import UNTOLD
from touchdown.experiments.io.untrusted import read_object
from touchdown.experiments.reporting.flights import Row, methods_of, number, values
from touchdown.experiments.reporting.measures import is_marked, setting_notes
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
from touchdown.scenes.api import short_name

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
    """The condition of a flight: as `label_conditions` found it, or what a run's name holds beside
    scene, method and seed; "" for a name of another form."""
    if isinstance(found := row.get("condition"), str):
        return found
    start = f"{short_name(row['scene'])}-{row['estimator'].replace(':', '.')}-s{row['seed']}"
    name = Path(str(row["run_id"])).name
    return name.removeprefix(start).strip("-") if name.startswith(start) else ""


def label_conditions(rows: Sequence[dict[str, Any]]) -> None:
    """Gives each row the key ``condition``. Runs of a campaign have it in their names. For others
    it is the profile, the preset and the light where these vary, and the keys of their
    configurations that vary between flights of one method in one of each."""
    configs = [{} if condition_of(row) else _config_of(row) for row in rows]
    values: defaultdict[tuple[object, ...], set[str]] = defaultdict(set)
    for row, config in zip(rows, configs, strict=True):
        group = (row["estimator"], *(config.get(key) for key in _WORLD))
        for key, value in config.items():
            values[(*group, key)].add(value)
    varying = sorted({str(key[-1]) for key, found in values.items() if len(found) > 1})
    worlds = [k for k in _WORLD if len({config[k] for config in configs if k in config}) > 1]
    for row, config in zip(rows, configs, strict=True):
        named = [config[key] for key in worlds if config.get(key)]
        named += [f"{key}={config[key]}" for key in varying if key in config and key not in _WORLD]
        row["condition"] = condition_of(row) or ", ".join(named)


_WORLD = ("profile", "preset", "light")
"""Keys that set many others."""
_SAME = (*UNTOLD, "landing.site_xy_m", "landing.survey_only")
"""Keys, or their beginnings, that make no condition."""


def _config_of(row: Row) -> dict[str, str]:
    """Values of the configuration beside a run, as text; those that the row has where it lacks
    one."""
    try:
        tree = read_object(Path(str(row.get("run_dir", ""))) / "config.json")
        values = dict(flatten(tree))
    except (OSError, ValueError, RecursionError):
        values = {key: row.get(key) for key in ("profile", "preset")}
        values["wind.mean_kmh"] = row.get("wind_kmh")
    return {
        key: value if isinstance(value, str) else json.dumps(value)
        for key, value in values.items()
        if value is not None and not key.startswith(_SAME)
    }


def by_condition(rows: Sequence[Row], first: str = "") -> dict[str, list[Row]]:
    """The flights of each condition, those of ``first`` first, others by name."""
    names = sorted({condition_of(row) for row in rows}, key=lambda name: (name != first, name))
    return {name: [row for row in rows if condition_of(row) == name] for name in names}


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
    conditions = by_condition(rows, first)
    compared = len(conditions) > 1 and first in conditions
    kept = [f for f in _FIGURES if values(rows, f.column)]
    header = ["condition", "method", "scene", "flights", "successful", "DIVERGED"]
    header += [f.title for f in kept]
    header += [f"mean error over that of {first}"] if compared else []
    table = Table("conditions", "Flights by condition, method and scene", header, [])
    for condition, members in conditions.items():
        for method, scene, group in _groups(members):
            line = [Cell(condition or MISSING, kind="name"), name_cell(method), name_cell(scene)]
            line += [Cell(str(count)) for count in _counts(group)]
            found = {f.title + f.column: f.of(group) for f in kept}
            line += [
                figure(found[f.title + f.column], marked=is_marked(f.column, method)) for f in kept
            ]
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
    table.notes = setting_notes((f.column for f in kept), methods_of(rows))
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
