"""One row a run: from ``result.json`` to Parquet, and back as rows or a database."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from touchdown.experiments.campaign.plan import config_sha
from touchdown.experiments.config.keys import flatten
from touchdown.experiments.config.loading import load_config
from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.results import load_run

CRASHED = "CRASHED"
"""Outcome of a run that never came to one: its flight raised, died, or went over a limit."""

ROW_FILE, RESULTS_FILE = "row.parquet", "results.parquet"
RUNS, FAILED = "runs", "failed"
"""Folders of a campaign's directory: finished runs, and one JSON file for every crashed one."""

_POSITION = ("mean", "rmse", "max", "x", "y", "z", "yaw_deg")
_LANDING = (
    "touchdown_time_s",
    "target_offset_m",
    "slope_deg",
    "vertical_speed_mps",
    "horizontal_speed_mps",
    "vertical_accel_mps2",
    "impact_peak_mps2",
    "bounce_m",
    "tilt_deg",
    "obstacle_distance_m",
)
_STAGES = ("world", "estimator", "mapper", "lander", "controller", "recorder", "referee")
SCHEMA: Mapping[str, str] = {
    "run_id": "text",
    "scene": "text",
    "estimator": "text",
    "seed": "int",
    "wind_kmh": "float",
    "outcome": "text",
    "reason": "text",
    "mode": "text",
    "wall_s": "float",
    "cpu_s": "float",
    "git_revision": "text",
    "config_sha": "text",
    "started_utc": "text",
    **{f"position_error_m.{name}": "float" for name in _POSITION},
    "trajectory_error_m": "float",
    "trajectory_error_max_m": "float",
    "trajectory_variance_m2": "float",
    "landing.commanded_xy_m": "floats",
    "landing.site_xy_m": "floats",
    "landing.touchdown_xy_m": "floats",
    **{f"landing.{name}": "float" for name in _LANDING},
    "landing.class_predicted": "text",
    "landing.class_true": "text",
    "landing.safe_geometry": "bool",
    "landing.safe_class": "bool",
    "landing.safe": "bool",
    "map.duration_s": "float",
    "map.density_per_m2": "float",
    "map.levelness_error_deg.mean": "float",
    "map.levelness_error_deg.max": "float",
    "map.levelness_error_deg.places": "float",
    "timing.wall_s": "float",
    "timing.sim_s": "float",
    "timing.real_time_factor": "float",
    **{f"timing.stage_ms.{name}": "float" for name in _STAGES},
}
"""Columns that every table has, and their types; what else a result holds follows them."""

TIMING_COLUMNS = ("wall_s", "cpu_s", "started_utc", "timing.")
"""Beginnings of the names of columns that differ between two flights of one configuration."""


def make_row(
    result: Mapping[str, Any], run_id: str, mode: str, sha: str | None, **more: Any
) -> dict[str, Any]:
    """The row of a run: ``result`` flattened, with dots between its keys, and who flew what.

    ``more`` fills ``wall_s``, ``cpu_s`` and ``started_utc`` where they are known.
    """
    timing = result.get("timing")
    wall_s = timing.get("wall_s") if isinstance(timing, dict) else None
    row: dict[str, Any] = dict.fromkeys(SCHEMA)
    row |= {key: value for key, value in flatten(result) if value is not None}
    row |= {"run_id": run_id, "mode": mode, "config_sha": sha, "wall_s": wall_s}
    return row | more


def crashed_row(record: Mapping[str, Any]) -> dict[str, Any]:
    """The row of a file of ``failed/``: what it is called, and the error as the reason."""
    known = {key: record[key] for key in SCHEMA if key in record}
    return dict.fromkeys(SCHEMA) | known | {"outcome": CRASHED, "reason": record["error"]}


# ----------------------------------------------------------------------------------------- tables


def table_of(rows: Sequence[Mapping[str, Any]]) -> Any:
    """``pyarrow.Table`` of rows: the columns of ``SCHEMA``, then all others by name.

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
    columns = {
        key: pa.array([_cast(row.get(key), kind) for row in rows], types[kind])
        for key, kind in kinds.items()
    }
    return pa.table(columns)


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
    if kind == "float":
        return float(value) if _kind(value) == "float" and math.isfinite(value) else None
    if kind == "floats":
        return [float(item) for item in value] if _kind(value) == "floats" else None
    if kind == "json" or (kind == "text" and not isinstance(value, str)):
        return json.dumps(value)
    return value


def write_table(rows: Sequence[Mapping[str, Any]], path: Path, stamp: str = "") -> None:
    """Writes Parquet beside ``path`` and moves it there at once."""
    import pyarrow.parquet as pq

    table = table_of(rows).replace_schema_metadata({"touchdown.stamp": stamp})
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        # A row alone would be mostly dictionaries and statistics of one value.
        pq.write_table(table, partial, use_dictionary=len(rows) > 1, write_statistics=False)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def _read_table(path: Path) -> list[dict[str, Any]]:
    import pyarrow.parquet as pq

    rows: list[dict[str, Any]] = pq.ParquetFile(path).read().to_pylist()
    return rows


# ------------------------------------------------------------------------------------ directories


def is_campaign(directory: Path) -> bool:
    return (directory / "campaign.json").is_file()


def load_rows(directory: Path) -> list[dict[str, Any]]:
    """One dictionary a run, keys as in ``SCHEMA`` and more, in the order of scene, estimator, seed.

    ``directory`` is a campaign's (finished, still flying or stopped: crashed runs are rows too), or
    holds run directories at any depth. Raises UsageError when there is no run.
    """
    rows = refresh(directory) if is_campaign(directory) else _plain_rows(directory)
    if not rows:
        raise UsageError(f"'{directory}' holds no finished run yet")
    # Through a table, so that both kinds of directory give the same types.
    return sorted(table_of(rows).to_pylist(), key=_order)


def connect(directory: Path) -> Any:
    """A DuckDB connection, in memory, with the view ``runs``. Raises UsageError as load_rows."""
    import duckdb

    connection = duckdb.connect(":memory:")
    connection.register("run_rows", table_of(load_rows(directory)))
    connection.execute("create view runs as select * from run_rows")
    return connection


def run_sql(directory: Path, sql: str) -> tuple[list[str], list[tuple[Any, ...]]]:
    """Titles and rows that ``sql`` gives over the view ``runs``. Raises UsageError for bad SQL."""
    import duckdb

    connection = connect(directory)
    try:
        found = connection.execute(sql)
        return [column[0] for column in found.description or []], found.fetchall()
    except duckdb.Error as error:
        text = " ".join(str(error).split("LINE 1")[0].split())
        raise UsageError(f"query of '{directory}': {text}") from error


def refresh(directory: Path) -> list[dict[str, Any]]:
    """All rows of a campaign; ``results.parquet`` is rewritten when it is not up to date."""
    results = directory / RESULTS_FILE
    stamp = _stamp(directory)
    rows = _rows_at(results, stamp)
    if rows is None:
        rows = sorted([*_finished_rows(directory), *_crashed_rows(directory)], key=_order)
        try:
            write_table(rows, results, stamp)
        except OSError as error:
            raise UsageError(f"'{results}' cannot be written: {error.strerror}") from error
    return rows


def finished_ids(directory: Path) -> set[str]:
    """Names of the runs that are whole."""
    runs = directory / RUNS
    if not runs.is_dir():
        return set()
    return {path.name for path in runs.iterdir() if is_whole(path)}


def is_whole(run: Path) -> bool:
    """Whether a run directory of a campaign can be read. It appears whole or not at all, but the
    machine may have failed before its files were on the disk."""
    return _ends_in(run / ROW_FILE, b"PAR1") and _ends_in(run / "result.json", b"}")


def _ends_in(path: Path, mark: bytes) -> bool:
    try:
        with path.open("rb") as file:
            file.seek(-min(8, os.fstat(file.fileno()).st_size), os.SEEK_END)
            return file.read().rstrip().endswith(mark)
    except OSError:
        return False


def _order(row: Mapping[str, Any]) -> tuple[Any, ...]:
    wind = row["wind_kmh"] if row["wind_kmh"] is not None else math.inf
    return (row["scene"], row["estimator"], row["seed"], wind, row["run_id"])


def _stamp(directory: Path) -> str:
    """Changes whenever a run is added or taken away."""
    folders = [directory / name for name in (RUNS, FAILED)]
    return " ".join(str(f.stat().st_mtime_ns) if f.is_dir() else "-" for f in folders)


def _rows_at(results: Path, stamp: str) -> list[dict[str, Any]] | None:
    """The rows of a file that was written at ``stamp``, None where it is older or broken."""
    import pyarrow.lib
    import pyarrow.parquet as pq

    try:
        metadata = pq.read_schema(results).metadata or {}
        if metadata.get(b"touchdown.stamp", b"").decode() != stamp:
            return None
        return _read_table(results)
    except (OSError, pyarrow.lib.ArrowException):
        return None


def _finished_rows(directory: Path) -> Iterable[dict[str, Any]]:
    for run_id in sorted(finished_ids(directory)):
        run = directory / RUNS / run_id
        try:
            rows = _read_table(run / ROW_FILE)
            for row in rows:
                _check_names(row)
        except (OSError, ValueError) as error:  # of pyarrow, too
            raise UsageError(
                f"'{run / ROW_FILE}' is damaged; remove the directory '{run}' and give the "
                f"campaign again, which flies it anew ({error})"
            ) from error
        yield from rows


def _check_names(row: Mapping[str, Any]) -> None:
    """Raises ValueError unless a row says which run it is of."""
    for key in ("run_id", "scene", "estimator", "seed", "outcome"):
        kind = int if key == "seed" else str
        if not isinstance(row.get(key), kind):
            raise ValueError(f"{key} = {row.get(key)!r}")


def _crashed_rows(directory: Path) -> Iterable[dict[str, Any]]:
    folder = directory / FAILED
    for path in sorted(folder.glob("*.json")) if folder.is_dir() else ():
        if not (directory / RUNS / path.stem).exists():
            try:
                record = json.loads(path.read_text(encoding="utf-8"))
                _check_names(row := crashed_row(record))
            except (OSError, ValueError, KeyError, TypeError) as error:
                raise UsageError(
                    f"'{path}' is damaged; remove it and give the campaign again ({error})"
                ) from error
            yield row


def _plain_rows(directory: Path) -> list[dict[str, Any]]:
    """Rows of runs that were flown one by one."""
    if not directory.is_dir():
        raise UsageError(f"'{directory}' is no directory of runs")
    rows = []
    for path in sorted(directory.rglob("result.json")):
        result, name = load_run(path), path.parent.relative_to(directory).as_posix()
        mode, sha = _mode_and_sha(path.with_name("config.json"), result)
        rows.append(make_row(result, name if name != "." else directory.name, mode, sha))
    return rows


def _mode_and_sha(file: Path, result: Mapping[str, Any]) -> tuple[str, str | None]:
    """Of a run that names neither: from its configuration, unless that is one of another version
    or missing."""
    try:
        config = load_config(file)
    except UsageError:
        return ("fly" if result["outcome"] == "COMPLETED" else "land"), None
    return ("fly" if config.landing.survey_only else "land"), config_sha(config)
