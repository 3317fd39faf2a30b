"""The table of a campaign, one row per run: written to Parquet, read as rows."""

import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from touchdown.experiments.campaign.plan import config_sha
from touchdown.experiments.config.keys import flatten
from touchdown.experiments.config.loading import load_config
from touchdown.experiments.errors import UsageError, is_text, reason_of
from touchdown.experiments.io.result_parts import ground_safe
from touchdown.experiments.io.results import (
    RunResult,
    columns,
    is_success,
    load_result,
    result_files,
)
from touchdown.experiments.io.run_directory import RUN_FILES, whole_file
from touchdown.experiments.io.untrusted import is_plain_name, read_object, shown
from touchdown.sim.files.opening import no_file

CRASHED = "CRASHED"
"""Outcome of a run whose flight raised, died, or exceeded a limit."""

ROW_FILE, RESULTS_FILE = "row.parquet", "results.parquet"
CAMPAIGN_RUN_FILES = RUN_FILES | {ROW_FILE}
"""Names of all files in the directory of a campaign's run."""
RUNS, FAILED = "runs", "failed"
"""Folders of a campaign's directory: finished runs, and one JSON file for every crashed one."""

_RUN_COLUMNS: Mapping[str, str] = {
    "run_id": "text",
    "mode": "text",
    "success": "bool",
    "ground_safe": "bool",
    "go_arounds": "float",
    "wall_s": "float",
    "cpu_s": "float",
    "worker_memory_mb": "float",
    "config_sha": "text",
    "started_utc": "text",
}
"""Columns of a run beside its result. ``success``: see `RunResult.is_success`; ``ground_safe``: the
ground at the touchdown was safe by what the flight is judged on, null without a touchdown;
``go_arounds``: see `Choice.go_arounds`, null without a choice;
``worker_memory_mb``: anonymous and shared memory of the worker process after the run, MB."""
_FIRST_COLUMNS = (
    "run_id", "scene", "estimator", "seed", "profile", "wind_kmh", "outcome", "success", "reason",
    "mode", "wall_s", "cpu_s", "worker_memory_mb", "git_revision", "config_sha", "started_utc",
)  # fmt: skip


_KINDS = {**_RUN_COLUMNS, **columns()}
SCHEMA: Mapping[str, str] = {name: _KINDS[name] for name in (*_FIRST_COLUMNS, *_KINDS)}
"""Columns of every table and their kinds, derived from `RunResult`. Other keys of a result follow
them."""


def make_row(
    result: RunResult, run_id: str, mode: str, sha: str | None, **more: Any
) -> dict[str, Any]:
    """Returns the row of a run: ``result`` flattened, with dots between its keys, and the columns
    of the run.

    ``more`` fills ``wall_s``, ``cpu_s``, ``worker_memory_mb`` and ``started_utc`` where they are
    known.
    """
    row: dict[str, Any] = dict.fromkeys(SCHEMA)
    told = result.plain()
    told.pop("settings_set", None)  # as columns they would differ from run to run
    row |= {key: value for key, value in flatten(told) if value is not None}
    wall_s = None if result.timing is None else result.timing.wall_s
    row |= {"run_id": run_id, "mode": mode, "config_sha": sha, "wall_s": wall_s}
    if result.choice is not None:
        row["go_arounds"] = float(result.choice.go_arounds)
    return row | more | judged_columns(row)


def judged_columns(row: Mapping[str, Any]) -> dict[str, bool | None]:
    """The columns ``success`` and ``ground_safe`` of a row."""
    safe = ground_safe(
        row.get("landing.judged_on"),
        safe=row.get("landing.safe"),
        safe_geometry=row.get("landing.safe_geometry"),
    )
    return {"success": is_success(row["outcome"], safe), "ground_safe": safe}


def is_successful(row: Mapping[str, Any]) -> bool:
    """`RunResult.is_success` of a row."""
    return judged_columns(row)["success"] is True


def crashed_row(record: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the row of a file of ``failed/``, with the error as the reason."""
    known = {key: record[key] for key in SCHEMA if key in record}
    outcome = {"outcome": CRASHED, "reason": record["error"], "success": False}
    return dict.fromkeys(SCHEMA) | known | outcome


def table_of(rows: Sequence[Mapping[str, Any]]) -> Any:
    """Returns a ``pyarrow.Table``: the columns of ``SCHEMA``, then all others by name.

    Whole numbers become floats except in ``seed``, lists that are no numbers and mixed columns
    JSON text; a column without any value outside the schema is left out.
    """
    import pyarrow as pa

    kinds = dict(SCHEMA)
    for key in sorted({key for row in rows for key in row} - kinds.keys()):
        found = {_kind(row[key]) for row in rows if row.get(key) is not None}
        if found:
            kinds[key] = found.pop() if len(found) == 1 else "json"
    types = {
        "text": pa.string(),
        "json": pa.string(),
        "int": pa.int64(),
        "float": pa.float64(),
        "bool": pa.bool_(),
        "floats": pa.list_(pa.float64()),
    }
    cast = [{key: _cast(row.get(key), kind) for key, kind in kinds.items()} for row in rows]
    schema = pa.schema({key: types[kind] for key, kind in kinds.items()})
    return pa.Table.from_pylist(cast, schema=schema)


def _kind(value: Any) -> str:
    if isinstance(value, bool):
        return "bool"
    if isinstance(value, int | float):
        return "float"
    if isinstance(value, str):
        return "text"
    numbers = isinstance(value, list) and all(
        isinstance(item, int | float) and not isinstance(item, bool) for item in value
    )
    return "floats" if numbers else "json"


def _cast(value: Any, kind: str) -> Any:
    if value is None:
        return None
    try:
        if kind == "float":
            return float(value) if _kind(value) == "float" and math.isfinite(value) else None
        if kind == "floats":
            return [float(item) for item in value] if _kind(value) == "floats" else None
    except OverflowError:
        return None  # a whole number of hundreds of digits
    if kind == "bool":
        return value if isinstance(value, bool) else None
    if kind == "json" or (kind == "text" and not isinstance(value, str)):
        return json.dumps(value, default=str)
    return value


def write_table(rows: Sequence[Mapping[str, Any]], path: Path, stamp: str = "") -> None:
    """Writes a Parquet file, atomically."""
    import pyarrow.parquet as pq

    table = table_of(rows).replace_schema_metadata({"touchdown.stamp": stamp})
    with whole_file(path) as partial:
        # Dictionaries and statistics of a single row are larger than the row.
        pq.write_table(table, partial, use_dictionary=len(rows) > 1, write_statistics=False)


def _read_table(path: Path) -> list[dict[str, Any]]:
    import pyarrow.parquet as pq

    return pq.ParquetFile(path).read().to_pylist()


def is_campaign(directory: Path) -> bool:
    return (directory / "campaign.json").is_file()


def load_rows(directory: Path) -> list[dict[str, Any]]:
    """Returns one dictionary per run, sorted by scene, estimator and seed; keys as in ``SCHEMA``
    and more.

    ``directory`` is that of a campaign in any state (crashed runs are rows too), or holds run
    directories at any depth. Raises UsageError without a run.
    """
    rows = refresh(directory) if is_campaign(directory) else _plain_rows(directory)
    if not rows:
        raise UsageError(f"'{directory}' holds no finished run yet")
    # Through a table, so that both kinds of directory give the same types.
    return sorted(table_of(rows).to_pylist(), key=_order)


def run_path(directory: Path, row: Mapping[str, Any]) -> Path:
    """The run directory of a row of `load_rows`."""
    if is_campaign(directory):
        return directory / RUNS / str(row["run_id"])
    name = str(row["run_id"])
    return directory if name == directory.resolve().name else directory / name


def refresh(directory: Path, *, must_write: bool = False) -> list[dict[str, Any]]:
    """Returns all rows of a campaign; rewrites ``results.parquet`` where it is out of date.

    Reading does without the file where it cannot be written. Raises UsageError for that with
    ``must_write``.
    """
    results = directory / RESULTS_FILE
    stamp = _stamp(directory)
    rows = _rows_at(results, stamp)
    if rows is None:
        rows = sorted([*_finished_rows(directory), *_crashed_rows(directory)], key=_order)
        try:
            write_table(rows, results, stamp)
        except OSError as error:
            if must_write:
                raise UsageError(f"'{results}' cannot be written: {error.strerror}") from error
    return rows


def check_rows(directory: Path) -> None:
    """Raises UsageError for a damaged row in a campaign's directory, so that it is named before
    anything is flown."""
    for _ in (*_finished_rows(directory), *_crashed_rows(directory)):
        pass


def finished_ids(directory: Path) -> set[str]:
    """Names of the complete runs."""
    runs = directory / RUNS
    if not runs.is_dir():
        return set()
    return {path.name for path in runs.iterdir() if is_whole(path)}


def is_whole(run: Path) -> bool:
    """True if a run directory of a campaign is complete. It appears at once, but a power failure
    may have cut its files short."""
    return _ends_in(run / ROW_FILE, b"PAR1") and _ends_in(run / "result.json", b"}")


def _ends_in(path: Path, mark: bytes) -> bool:
    try:
        if no_file(path):
            return False
        with path.open("rb") as file:
            file.seek(-min(8, os.fstat(file.fileno()).st_size), os.SEEK_END)
            return file.read().rstrip().endswith(mark)
    except OSError:
        return False


def _order(row: Mapping[str, Any]) -> tuple[Any, ...]:
    wind = row["wind_kmh"] if row["wind_kmh"] is not None else math.inf
    return (row["scene"], row["estimator"], row["seed"], wind, row["run_id"])


def _stamp(directory: Path) -> str:
    """A text that changes whenever a run is added or removed."""
    folders = [directory / name for name in (RUNS, FAILED)]
    return " ".join(str(f.stat().st_mtime_ns) if f.is_dir() else "-" for f in folders)


def _rows_at(results: Path, stamp: str) -> list[dict[str, Any]] | None:
    """The rows of a file written at ``stamp``; None where it is older or damaged."""
    import pyarrow.lib
    import pyarrow.parquet as pq

    if no_file(results):  # a pipe would be waited for
        return None
    try:
        metadata = pq.read_schema(results).metadata or {}
        if metadata.get(b"touchdown.stamp", b"").decode() != stamp:
            return None
        rows = _read_table(results)
        for row in rows:
            _check_names(row, row.get("run_id"))
            # A file that came with the runs may name others: its rows are made anew.
            if not is_plain_name(row["run_id"]):
                return None
        return rows
    except (OSError, ValueError, pyarrow.lib.ArrowException):
        return None


def _finished_rows(directory: Path) -> Iterable[dict[str, Any]]:
    for run_id in sorted(finished_ids(directory)):
        yield read_row(directory / RUNS / run_id)


def read_row(run: Path) -> dict[str, Any]:
    """The row of a finished run of a campaign. Raises UsageError where it is damaged or of another
    run."""
    try:
        rows = _read_table(run / ROW_FILE)
        if len(rows) != 1:
            raise ValueError(f"it has {len(rows)} rows")
        _check_names(rows[0], run.name)
    except (OSError, ValueError) as error:  # of pyarrow, too
        raise UsageError(
            f"'{run / ROW_FILE}' is damaged; remove the directory '{run}' and give the "
            f"campaign again, which flies it anew ({reason_of(error)})"
        ) from error
    row = _of_schema(dict.fromkeys(SCHEMA) | rows[0])  # earlier versions have fewer columns
    return row | judged_columns(row)


def _of_schema(row: Mapping[str, Any]) -> dict[str, Any]:
    """``row`` with values of the kinds of ``SCHEMA``; None for others."""
    return {key: _cast(value, SCHEMA.get(key, "")) for key, value in row.items()}


def _check_names(row: Mapping[str, Any], run_id: object) -> None:
    """Raises ValueError unless a row identifies its run, and that is ``run_id``."""
    for key in ("run_id", "scene", "estimator", "outcome"):
        if not isinstance(row.get(key), str):
            raise ValueError(f"{key} = {shown(row.get(key))}")
    seed = row.get("seed")
    if type(seed) is not int or not -(2**63) <= seed < 2**63:
        raise ValueError(f"seed = {shown(seed)}")
    if _kind(row.get("wind_kmh")) != "float" and row.get("wind_kmh") is not None:
        raise ValueError(f"wind_kmh = {shown(row['wind_kmh'])}")
    if row["run_id"] != run_id:
        raise ValueError(f"it is of the run {shown(row['run_id'])}")


def _crashed_rows(directory: Path) -> Iterable[dict[str, Any]]:
    folder = directory / FAILED
    for path in sorted(folder.glob("*.json")) if folder.is_dir() else ():
        if not (directory / RUNS / path.stem).exists():
            try:
                _check_names(row := crashed_row(read_object(path)), path.stem)
            except (OSError, ValueError, KeyError, TypeError) as error:
                raise UsageError(
                    f"'{path}' is damaged; remove it and give the campaign again "
                    f"({reason_of(error)})"
                ) from error
            yield _of_schema(row)


def _plain_rows(directory: Path) -> list[dict[str, Any]]:
    """Rows of runs outside of a campaign."""
    if not directory.is_dir():
        raise UsageError(f"'{directory}' is no directory of runs")
    rows = []
    for path in result_files(directory):
        if not is_text(str(path)):
            raise UsageError(f"the name of '{path.parent}' is no UTF-8 text; rename that directory")
        result, name = load_result(path), path.parent.relative_to(directory).as_posix()
        mode, sha = _mode_and_sha(path.with_name("config.json"), result)
        rows.append(make_row(result, name if name != "." else directory.resolve().name, mode, sha))
    return rows


def _mode_and_sha(file: Path, result: RunResult) -> tuple[str, str | None]:
    """Mode and configuration hash of a single run, from its configuration file; where that is
    missing or of another version, the mode follows from the outcome."""
    try:
        config = load_config(file, allow_code=True)  # nothing is imported
    except UsageError:
        return ("fly" if result.outcome == "COMPLETED" else "land"), None
    return ("fly" if config.landing.survey_only else "land"), config_sha(config)
