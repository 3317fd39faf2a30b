"""Conditions of flights: what varies beside scene, method and seed. No figure of a report is over
flights of several conditions."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from touchdown.experiments.campaign.directory import read_plan_file
from touchdown.experiments.campaign.results_table import is_campaign
from touchdown.experiments.config.keys import flatten
from touchdown.experiments.config.settings import UNTOLD
from touchdown.experiments.io.untrusted import read_object
from touchdown.experiments.reporting.flights import Row
from touchdown.scenes.api import short_name

_WORLD = ("profile", "preset", "light")
"""Keys that set many others."""
_SAME = (*UNTOLD, "landing.site_xy_m", "landing.survey_only")
"""Keys, or their beginnings, that make no condition."""


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


def first_condition(directory: Path) -> str:
    """The condition of the run that a campaign flies first; "" outside of a campaign."""
    if not is_campaign(directory):
        return ""
    for run in read_plan_file(directory)["runs"]:
        named = {key: str(run["values"].get(key)) for key in ("scene", "estimator", "seed")}
        return condition_of({**named, "run_id": run["run_id"]})
    return ""
