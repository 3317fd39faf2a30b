"""Flights of a directory as rows, one flat dictionary each with dotted keys, and as a frame, and
their conditions: what varies beside scene, method and seed. No figure of a report is over flights
of several conditions."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.campaign.directory import read_plan_file
from touchdown.experiments.campaign.results_table import CRASHED, RUNS, is_campaign, load_rows
from touchdown.experiments.config.keys import UNTOLD, flatten
from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.provenance import UNRECORDED_REMEDY
from touchdown.experiments.io.untrusted import read_object
from touchdown.scenes.api import short_name
from touchdown.sim.files.opening import no_file

if TYPE_CHECKING:
    import pandas as pd

Row = Mapping[str, Any]

ORDER = {
    "scene": ("crossroad", "lake", "houses", "forest"),
    "estimator": ("livo", "zou2024", "stereo", "hybrid_flow", "gps", "optical_flow", "oracle"),
}
"""Names that come first in a report, the paper's scenes and the project's estimators."""


def load_flights(directory: Path) -> list[dict[str, Any]]:
    """Returns every flight of a campaign, or below a plain directory, as rows of
    `touchdown.experiments.campaign.results_table.load_rows`, with the key ``run_dir``. Raises
    UsageError without a flight or for an unreadable one."""
    rows = load_rows(directory)
    folder = directory / RUNS if is_campaign(directory) else directory
    for row in rows:
        run_dir = folder / row["run_id"]
        row["run_dir"] = str(run_dir if run_dir.is_dir() else folder)
    return rows


def frame_of(rows: Sequence[Row]) -> pd.DataFrame:
    """A frame of rows, with the columns ``condition``, empty where they have none, and ``unit``:
    flights of one unit share random draws, and count as one independent flight."""
    import pandas as pd

    frame = pd.DataFrame([dict(row) for row in rows])
    if "condition" not in frame:
        frame["condition"] = ""
    if "unit" not in frame:
        frame["unit"] = None
    # Rows without one are of flights whose draws were those of their seed over every scene.
    seeds = frame.get("seed", frame.index)
    frame["unit"] = frame["unit"].where(frame["unit"].notna(), [f"seed {seed}" for seed in seeds])
    return frame


def check_revisions(rows: Iterable[Row], directory: Path) -> None:
    """Raises UsageError where a flight that ended with a result has no git revision."""
    missing = [r for r in rows if r["outcome"] != CRASHED and not r.get("git_revision")]
    if missing:
        raise UsageError(
            f"'{directory}': {len(missing)} results have no git revision, the first is "
            f"'{missing[0]['run_id']}'; {UNRECORDED_REMEDY}"
        )


def campaign_text(directory: Path) -> str:
    """Returns the text of the campaign's file; empty without one."""
    file = directory / "campaign.toml"
    return "" if no_file(file) else file.read_text(encoding="utf-8", errors="replace")


def campaign_name(directory: Path) -> str:
    """The name of a campaign; "" outside of one."""
    return str(read_plan_file(directory)["name"]) if is_campaign(directory) else ""


def number(row: Row, key: str) -> float | None:
    """Returns a finite number of a row; None for any other value."""
    value = row.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if np.isfinite(value) else None


def values(frame: pd.DataFrame, column: str) -> NDArray[np.float64]:
    """The numbers of a column in the order of the flights, without missing ones."""
    return values_and_units(frame, column)[0]


def values_and_units(frame: pd.DataFrame, column: str) -> tuple[NDArray[np.float64], list[str]]:
    """`values`, and the units of their flights."""
    import pandas as pd

    if column not in frame:
        return np.empty(0), []
    found = pd.to_numeric(frame[column], errors="coerce").to_numpy(np.float64, na_value=np.nan)
    known = np.isfinite(found)
    return found[known], list(frame["unit"][known])


def ordered(frame: pd.DataFrame, column: str) -> list[str]:
    """The names in a column: scenes and methods in a fixed order, others by name; of any other
    column in the order of the flights."""
    found = list(dict.fromkeys(frame[column]))
    known = ORDER.get(column)
    if known is None:
        return found
    return sorted(found, key=lambda n: (known.index(n) if n in known else len(known), n))


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


def config_numbers(row: Row, keys: Sequence[str]) -> dict[str, float]:
    """Numbers of a run's configuration, NaN for none."""
    config = _config_of(row)
    found = {}
    for key in keys:
        try:
            found[key] = float(config.get(key, "nan"))
        except ValueError:
            found[key] = float("nan")
    return found


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
