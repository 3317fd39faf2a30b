"""The sets of flights behind README and the results pages, flown and written.

``docs/results/results.json`` has the rows behind the tables with the revision of their flights; the
tables stand in the pages between markers that nobody else writes between.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from touchdown.experiments.campaign.forecast import Forecast, forecast
from touchdown.experiments.campaign.plan import Plan, load_plan
from touchdown.experiments.campaign.results_table import (
    CRASHED,
    finished_ids,
    is_campaign,
    load_rows,
)
from touchdown.experiments.campaign.session import Watcher, default_jobs, fly_campaign, make_engine
from touchdown.experiments.errors import UsageError, nearest, reason_of
from touchdown.experiments.io.provenance import DIRTY, UNRECORDED_REMEDY, git_revision
from touchdown.experiments.io.run_directory import write_text
from touchdown.experiments.io.untrusted import read_object
from touchdown.experiments.reporting.flights import Row, frame_of
from touchdown.experiments.results_tables import tables

ROOT = Path(__file__).resolve().parents[2]
"""the source tree with its plans and pages"""
DEFAULT_PROFILE = "field"


@dataclass(frozen=True, slots=True)
class FlightSet:
    """Flights of one profile; ``file``: their campaign, relative to the source tree."""

    name: str
    profile: str
    file: str

    @property
    def key(self) -> str:
        """``field/landings``: directory below ``--out``, and name in the file of results."""
        return f"{self.profile}/{self.name}"

    @property
    def command(self) -> str:
        """The command that flies the sets of its profile."""
        profile = "" if self.profile == DEFAULT_PROFILE else f" PROFILE={self.profile}"
        return f"make results{profile}"

    def plan(self, root: Path = ROOT) -> Plan:
        """The runs of the campaign in this profile. Raises UsageError without a source tree."""
        file = root / self.file
        if not file.is_file():
            raise UsageError(
                f"'{file}' does not exist: the flights of the results pages are planned in the "
                "source tree of Touchdown; call the command of a git checkout"
            )
        plan = load_plan(file)
        runs = [run for run in plan.runs if run.values.get("profile") == self.profile]
        return replace(plan, runs=tuple(runs))


SETS = (
    FlightSet("landings", "field", "configs/landing.toml"),
    FlightSet("positioning", "field", "configs/positioning.toml"),
    FlightSet("blind", "field", "configs/one_sensor.toml"),
    FlightSet("short", "field", "configs/short.toml"),
    FlightSet("landings", "ideal", "configs/landing.toml"),
    FlightSet("positioning", "ideal", "configs/positioning.toml"),
)


def chosen(profile: str, only: Sequence[str] = ()) -> list[FlightSet]:
    """The sets of a profile; those called ``only`` where any are named. Raises UsageError for an
    unknown name."""
    of_profile = [found for found in SETS if found.profile == profile]
    names = [found.name for found in of_profile]
    for name in only:
        if name not in names:
            raise UsageError(
                f"--only {name}: no set of profile '{profile}'{nearest(name, names)}; "
                f"known: {', '.join(names)}"
            )
    return [found for found in of_profile if not only or found.name in only]


def forecasts(sets: Sequence[FlightSet], out: Path, jobs: int | None) -> list[Forecast]:
    """The cost of each set, of the flights that ``out`` lacks."""
    at_once = jobs or default_jobs()
    return [forecast(plan := found.plan(), plan.runs, out / found.key, at_once) for found in sets]


def fly(
    sets: Sequence[FlightSet], out: Path, jobs: int | None, watcher: Callable[[], Watcher]
) -> list[dict[str, Any]]:
    """Flies what is left of the sets, each into ``out``/profile/name, and returns their summaries.
    Raises UsageError before the first flight where the rows could not be printed in the end: the
    revision is not known, not committed, or not that of the flights that exist."""
    plans = {found: found.plan() for found in sets}
    revision = git_revision()
    for found, plan in plans.items():
        directory = out / found.key
        finished = finished_ids(directory)
        if {run.run_id for run in plan.runs} - finished:
            rows = load_rows(directory) if finished and is_campaign(directory) else []
            _check_revision(
                {revision or "", *(row["git_revision"] or "" for row in rows)}, directory
            )
    return [
        fly_campaign(plan, out / found.key, make_engine("local", jobs), watcher=watcher())
        for found, plan in plans.items()
    ]


def _check_revision(revisions: Collection[str], directory: Path) -> None:
    """Raises UsageError where flights in ``directory`` are, or would be, of several revisions, of
    none, or of a source tree with changes."""
    if "" in revisions:
        raise UsageError(f"'{directory}': a flight has no git revision: {UNRECORDED_REMEDY}")
    if len(revisions) > 1:
        names = ", ".join(sorted(name[:12] for name in revisions))
        raise UsageError(
            f"'{directory}' holds flights of {len(revisions)} revisions ({names}); a page is of "
            "one: check it out, or fly all of them into a new --out"
        )
    (revision,) = revisions
    if revision.endswith(DIRTY):
        raise UsageError(
            f"'{directory}': the flights are of revision {revision[:12]} with changes that were "
            "not committed; commit them, and fly into a new --out"
        )


# ----------------------------------------------------------------------------------------- record

FILE = "docs/results/results.json"
FORMAT = "touchdown-results-1"
SHORT = "short"
"""The set whose table states its own revision beside that of the flights it is compared with."""
_FIGURES = 6
"""significant figures of a stored number"""

COLUMNS = (
    "run_id", "scene", "estimator", "seed", "profile", "outcome", "ground_safe",
    "position_error_m.mean", "position_error_m.max", "trajectory_error_m", "nees.below_14_2",
    "landing.target_offset_m", "landing.vertical_speed_mps", "landing.vertical_accel_mps2",
    "landing.slope_deg", "landing.estimate_error_at_commit_m",
    "map.levelness_error_deg.mean", "map.levelness_error_deg.max", "cpu_s",
)  # fmt: skip

Record = dict[str, dict[str, Any]]
"""Sets by `FlightSet.key`: revision, date, plan, command, rows"""


def read_record(root: Path) -> Record:
    """The sets of the file; none where it does not exist. Raises UsageError where it is damaged."""
    file = root / FILE
    if not file.is_file():
        return {}
    try:
        tree = read_object(file)
        if tree["format"] != FORMAT:
            raise ValueError(f"its format is {tree['format']!r}, not {FORMAT!r}")
        return dict(tree["sets"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(f"'{file}' is damaged: {reason_of(error)}; restore it from git") from error


def record_of(found: FlightSet, directory: Path) -> dict[str, Any]:
    """The part of the file for a set that is flown to its end. Raises UsageError for rows that are
    missing, of several revisions, or of a source tree with changes."""
    plan = found.plan()
    rows = load_rows(directory) if is_campaign(directory) else []
    planned = [run.run_id for run in plan.runs]
    by_name = {row["run_id"]: row for row in rows}
    missing = [name for name in planned if name not in by_name]
    if missing:
        raise UsageError(
            f"'{directory}': {len(missing)} of {len(planned)} flights are missing, such as "
            f"'{missing[0]}'; give the command again to fly them"
        )
    own = [by_name[name] for name in planned]
    revisions = {str(row["git_revision"] or "") for row in own}
    _check_revision(revisions, directory)
    return {
        "revision": revisions.pop(),
        "date": max(str(row["started_utc"] or "") for row in own)[:10],
        "plan": found.file,
        "command": found.command,
        "core_hours": _short(sum(row["cpu_s"] or 0.0 for row in own) / 3600.0),
        "rows": [_stored(row) for row in own],
    }


def _stored(row: Row) -> dict[str, Any]:
    kept = {key: _short(row[key]) for key in COLUMNS if row.get(key) is not None}
    if row["outcome"] == CRASHED or row.get("reason"):
        kept["reason"] = str(row["reason"])
    return kept


def _short(value: Any) -> Any:
    return float(f"{value:.{_FIGURES}g}") if isinstance(value, float) else value


def merged(before: Record, new: Record) -> Record:
    """The sets of ``before`` with those of ``new`` in their places. Raises UsageError where the
    sets of a profile but `SHORT` would be of several revisions: a page prints several of them."""
    record = {**before, **new}
    for profile in {key.partition("/")[0] for key in new}:
        names = sorted(key for key in record if key.partition("/")[0] == profile)
        own = {key: record[key] for key in names if key != f"{profile}/{SHORT}"}
        if len({entry["revision"] for entry in own.values()}) > 1:
            named = ", ".join(f"{key} {entry['revision'][:12]}" for key, entry in own.items())
            raise UsageError(
                f"the sets of profile '{profile}' would be of several revisions ({named}); fly all "
                "of them at one revision, without --only"
            )
    return record


def record_text(record: Record) -> str:
    """The text of the file, a row a line."""
    parts = []
    for key in sorted(record):
        entry = dict(record[key])
        rows = ",\n".join(f"   {json.dumps(row, ensure_ascii=False)}" for row in entry.pop("rows"))
        head = json.dumps(entry, ensure_ascii=False)[1:-1]
        parts.append(f'  {json.dumps(key)}: {{{head}, "rows": [\n{rows}]}}')
    body = ",\n".join(parts)
    return f'{{"format": {json.dumps(FORMAT)},\n "sets": {{\n{body}}}}}\n'


# ------------------------------------------------------------------------------------------- pages


@dataclass(frozen=True, slots=True)
class Block:
    """A part of a page: ``<!-- results NAME -->`` to ``<!-- end of results -->``. ``sets`` are the
    keys of the sets whose rows ``lines`` takes."""

    page: str
    name: str
    sets: tuple[str, ...]
    lines: Callable[..., Sequence[str]]

    def text(self, record: Record) -> str:
        """The lines between the markers."""
        if any(key not in record for key in self.sets):
            command = next(found.command for found in SETS if found.key == self.sets[0])
            return (
                f"Not flown at a stated revision yet: `{command}` flies it and writes this table."
            )
        flown = [record[key] for key in self.sets]
        lines = self.lines(*(frame_of(entry["rows"]) for entry in flown))
        return "\n".join([*lines, "", _origin(self.sets, record)])


def _origin(keys: Sequence[str], record: Record) -> str:
    """The revision, profile and plan of the flights of a table."""
    entries = [record[key] for key in keys]
    plans = " and ".join(f"`{entry['plan']}`" for entry in entries)
    hours = sum(entry["core_hours"] for entry in entries)
    found = dict.fromkeys(entry["revision"][:12] for entry in entries)
    revisions = "revision" + "s" * (len(found) > 1)
    revisions += " " + " and ".join(f"`{name}`" for name in found)
    profile = keys[0].partition("/")[0]
    return (
        f"*Flown at {revisions} in profile `{profile}`, "
        f"{max(entry['date'] for entry in entries)}: {plans}, by `{entries[0]['command']}`, "
        f"{hours:.2f} core-hours.*"
    )


_FIELD, _IDEAL = "docs/results/field.md", "docs/results/ideal.md"
BLOCKS = (
    Block("README.md", "summary", ("field/landings", "field/positioning"), tables.summary),
    Block(_FIELD, "landings", ("field/landings",), tables.landings),
    Block(_FIELD, "positioning", ("field/positioning", "field/landings"), tables.positioning),
    Block(_FIELD, "levelness", ("field/positioning", "field/landings"), tables.levelness),
    Block(_FIELD, "blind", ("field/blind",), tables.blind),
    Block(_FIELD, "pairs", (f"field/{SHORT}", "field/landings"), tables.pairs),
    Block(_IDEAL, "landings", ("ideal/landings",), tables.landings),
    Block(
        _IDEAL,
        "positioning",
        ("ideal/positioning", "ideal/landings"),
        tables.positioning,
    ),
    Block(
        _IDEAL,
        "levelness",
        ("ideal/positioning", "ideal/landings"),
        tables.levelness,
    ),
)
_PART = r"(<!-- results {name} -->\n).*?(\n<!-- end of results -->)"


def written(text: str, page: str, record: Record) -> str:
    """``text`` of a page with its blocks as ``record`` has them. Raises UsageError where a marker
    is missing."""
    for block in (found for found in BLOCKS if found.page == page):
        parts = re.split(_PART.format(name=block.name), text, flags=re.DOTALL)
        if len(parts) != 4:
            raise UsageError(
                f"{page}: no single part from '<!-- results {block.name} -->' to "
                "'<!-- end of results -->'; restore the markers"
            )
        before, start, end, after = parts
        text = f"{before}{start}{block.text(record)}{end}{after}"
    return text


def write_pages(sets: Sequence[FlightSet], out: Path, root: Path = ROOT) -> list[Path]:
    """Writes the sets that are flown below ``out`` into the file of results, and the blocks of all
    pages. Returns the files; raises UsageError, before any is written, where rows or markers are
    missing, or where a page would be of several revisions."""
    new = {found.key: record_of(found, out / found.key) for found in sets}
    record = merged(read_record(root), new)
    texts = {root / FILE: record_text(record)} | {
        root / page: written((root / page).read_text(encoding="utf-8"), page, record)
        for page in dict.fromkeys(block.page for block in BLOCKS)
    }
    for file, text in texts.items():
        write_text(file, text)
    return list(texts)
