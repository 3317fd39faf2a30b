"""One edition of the results: its sets of flights, flown, and their rows.

``docs/results/rows.parquet`` has the rows behind every table of README and the results pages, all
of one revision, which its metadata states beside date and cost of each set.
"""

import json
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from touchdown.experiments.campaign.forecast import Forecast, forecast
from touchdown.experiments.campaign.plan import Plan, load_plan
from touchdown.experiments.campaign.results_table import (
    RUNS,
    finished_ids,
    is_campaign,
    load_rows,
)
from touchdown.experiments.campaign.session import Watcher, default_jobs, fly_campaign, make_engine
from touchdown.experiments.errors import UsageError, nearest, reason_of
from touchdown.experiments.io.provenance import DIRTY, UNRECORDED_REMEDY, git_revision
from touchdown.experiments.io.run_directory import utc_now, write_text
from touchdown.experiments.io.untrusted import read_object
from touchdown.experiments.reporting.flights import Row
from touchdown.experiments.reproduce.parts import FLIGHTS
from touchdown.experiments.reproduce.run import reproduce

ROOT = Path(__file__).resolve().parents[2]
"""the source tree with its plans and pages"""
PAPER = "paper"
"""the part, and the folder, of the reproduction of the paper, which flies sets of its own"""
_NETWORKS = ("recognition",)
"""parts of the reproduction that are no flights and no pages of an edition"""


@dataclass(frozen=True, slots=True)
class FlightSet:
    """The flights of one campaign, ``configs/NAME.toml``; ``of_paper``: the reproduction flies
    them."""

    name: str
    of_paper: bool = False

    @property
    def file(self) -> str:
        return f"configs/{self.name}.toml"

    def directory(self, out: Path) -> Path:
        return out / PAPER / self.name / FLIGHTS if self.of_paper else out / self.name

    def plan(self, root: Path = ROOT) -> Plan:
        """The runs of the campaign. Raises UsageError without a source tree."""
        file = root / self.file
        if not file.is_file():
            raise UsageError(
                f"'{file}' does not exist: the flights of the results pages are planned in the "
                "source tree of Touchdown; call the command of a git checkout"
            )
        return load_plan(file)


SETS = (
    FlightSet("landing"),
    FlightSet("positioning", of_paper=True),
    FlightSet("commanded_site", of_paper=True),
    FlightSet("zou2024_sites", of_paper=True),
    FlightSet("zou2024", of_paper=True),
    FlightSet("one_sensor"),
    FlightSet("field_light"),
    FlightSet("field_harsh"),
    FlightSet("wind"),
    FlightSet("wrong_beliefs"),
    FlightSet("short"),
    FlightSet("limit"),
)


def chosen(parts: Sequence[str] = ()) -> list[FlightSet]:
    """The sets of some parts, of all where none is named: a set, or `PAPER` for all sets of the
    reproduction. Raises UsageError for an unknown name."""
    own = (found.name for found in SETS if not found.of_paper)
    names = list(dict.fromkeys((PAPER, *own, *MEASURED)))
    for name in parts:
        if name not in names:
            raise UsageError(
                f"--part {name}: no part of an edition{nearest(name, names)}; "
                f"known: {', '.join(names)}"
            )
    return [
        found for found in SETS
        if not parts or (PAPER if found.of_paper else found.name) in parts
    ]  # fmt: skip


def forecasts(sets: Sequence[FlightSet], out: Path, jobs: int | None) -> list[Forecast]:
    """The cost of each set, of the flights that ``out`` lacks."""
    at_once = jobs or default_jobs()
    return [
        forecast(plan := found.plan(), plan.runs, found.directory(out), at_once) for found in sets
    ]


def fly(
    sets: Sequence[FlightSet], out: Path, jobs: int | None, watcher: Callable[[], Watcher]
) -> list[dict[str, Any]]:
    """Flies what is left of the sets, each into its directory below ``out``, and returns their
    summaries. Raises UsageError before the first flight where the rows could not be printed in the
    end: the revision is not known, not committed, or not that of the flights that exist."""
    revision = git_revision()
    for found in sets:
        directory = found.directory(out)
        finished = finished_ids(directory)
        if {run.run_id for run in found.plan().runs} - finished:
            rows = load_rows(directory) if finished and is_campaign(directory) else []
            _check_revision(
                {revision or "", *(row["git_revision"] or "" for row in rows)}, directory
            )
    if any(found.of_paper for found in sets):
        reproduce(
            out / PAPER, quick=False, jobs=jobs or default_jobs(), skip=_NETWORKS, watcher=watcher
        )
    return [
        fly_campaign(found.plan(), found.directory(out), make_engine("local", jobs),
                     watcher=watcher())
        for found in sets
    ]  # fmt: skip


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


def _limit(out: Path) -> dict[str, Any]:
    from touchdown.experiments.benchmarks.limit.survey import measure

    runs = sorted((FlightSet("limit").directory(out) / RUNS).iterdir())
    return {"runs": [measure(run, True, lambda _: None) | {"run": run.name} for run in runs]}


def _cost(_out: Path) -> dict[str, Any]:
    from touchdown.experiments.benchmarks.all_measures import measure_all

    return {
        one.measure.title: {"unit": one.measure.unit, "value": one.values[0]}
        for _, figures in measure_all([ROOT])
        for one in figures
    }


MEASURED: Mapping[str, Callable[[Path], dict[str, Any]]] = {"limit": _limit, "cost": _cost}
"""Parts that measure something beside flights, or of the flights of the set of their name."""


def measure(parts: Sequence[str], out: Path) -> list[Path]:
    """Measures what of `MEASURED` is among the parts, of all where none is named, and is not
    measured yet at this revision. Returns the files ``NAME.json``. Raises UsageError for a source
    tree without a revision, or with changes."""
    files = []
    for name, run in MEASURED.items():
        if parts and name not in parts:
            continue
        file, revision = out / f"{name}.json", git_revision()
        if not file.is_file() or read_object(file)["revision"] != revision:
            _check_revision({revision or ""}, file)
            out.mkdir(parents=True, exist_ok=True)
            head = {"revision": revision, "date": utc_now()[:10]}
            write_text(file, json.dumps(head | {"figures": run(out)}, indent=1) + "\n")
        files.append(file)
    return files


FILE = "docs/results/rows.parquet"
_KEY = b"touchdown edition"
"""of the metadata: revision, date and core-hours by set"""
_FIGURES = 6
"""significant figures of a stored number"""
COLUMNS = (
    "run_id", "scene", "estimator", "seed", "unit", "profile", "outcome", "reason", "ground_safe",
    "position_error_m.mean", "position_error_m.max", "trajectory_error_m", "nees.below_14_2",
    "nees.median", "landing.target_offset_m", "landing.vertical_speed_mps",
    "landing.vertical_accel_mps2", "landing.slope_deg", "landing.roughness_m",
    "landing.estimate_error_at_commit_m", "landing.estimate_error_at_contact_m",
    "map.levelness_error_deg.mean", "map.levelness_error_deg.max", "cpu_s",
)  # fmt: skip

Record = dict[str, dict[str, Any]]
"""Sets by name: revision, date, core_hours, rows"""


def read_record(root: Path) -> Record:
    """The sets of the file; none where it does not exist. Raises UsageError where it is damaged."""
    file = root / FILE
    if not file.is_file():
        return {}
    try:
        table = pq.read_table(file)
        record: Record = json.loads(table.schema.metadata[_KEY])
        for row in table.to_pylist():
            known = {key: value for key, value in row.items() if value is not None}
            record[known.pop("set")].setdefault("rows", []).append(known)
        return record
    except (OSError, ValueError, KeyError, TypeError, pa.ArrowException) as error:
        raise UsageError(f"'{file}' is damaged: {reason_of(error)}; restore it from git") from error


def write_record(record: Record, root: Path) -> Path:
    """Writes the sets into the file; returns it."""
    rows = [{"set": name, **row} for name, entry in record.items() for row in entry["rows"]]
    heads = {
        name: {key: value for key, value in entry.items() if key != "rows"}
        for name, entry in record.items()
    }
    columns = {key: [row.get(key) for row in rows] for key in ("set", *COLUMNS)}
    table = pa.table(columns).replace_schema_metadata({_KEY: json.dumps(heads)})
    pq.write_table(table, root / FILE, compression="zstd")
    return root / FILE


def record_of(found: FlightSet, out: Path) -> dict[str, Any]:
    """The part of the file for a set that is flown to its end. Raises UsageError for rows that are
    missing, of several revisions, or of a source tree with changes."""
    directory = found.directory(out)
    rows = load_rows(directory) if is_campaign(directory) else []
    planned = [run.run_id for run in found.plan().runs]
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
        "core_hours": _short(sum(row["cpu_s"] or 0.0 for row in own) / 3600.0),
        "rows": [_stored(row) for row in own],
    }


def _stored(row: Row) -> dict[str, Any]:
    return {key: _short(row[key]) for key in COLUMNS if row.get(key) not in (None, "")}


def _short(value: Any) -> Any:
    return float(f"{value:.{_FIGURES}g}") if isinstance(value, float) else value


def merged(before: Record, new: Record) -> Record:
    """The sets of ``before`` with those of ``new`` in their places. Raises UsageError where they
    would be of several revisions: an edition is of one."""
    record = {
        found.name: {**before, **new}[found.name]
        for found in SETS
        if found.name in before or found.name in new
    }
    if len({entry["revision"] for entry in record.values()}) > 1:
        named = ", ".join(f"{name} {entry['revision'][:12]}" for name, entry in record.items())
        raise UsageError(
            f"the sets would be of several revisions ({named}); fly all of them at one revision, "
            "without --part"
        )
    return record
