"""SQL over the runs of a directory, by DuckDB. It reads their table and nothing else: files,
network, extensions and settings are closed before the first statement."""

from __future__ import annotations

import json
import re
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.provenance import plain_json
from touchdown.sim.files.child import limited_memory

if TYPE_CHECKING:
    import duckdb

MAX_ROWS = 1_000_000
"""of one result"""
MEMORY_BYTES = 1 << 30
"""of a query with its result; nothing goes to the disk"""

_CLOSED: dict[str, Any] = {
    "memory_limit": "768MiB",
    "temp_directory": "",  # a query that needs more memory fails instead of filling the disk
    "max_temp_directory_size": "0B",
    "allow_persistent_secrets": False,
    "autoinstall_known_extensions": False,
    "autoload_known_extensions": False,
}
_READING = {"SELECT", "EXPLAIN", "MULTI"}
"""Kinds of statements that read; MULTI is a PIVOT."""
_PLAIN = re.compile(r"BOOLEAN|(U?(TINY|SMALL|BIG|HUGE)INT)|U?INTEGER|FLOAT|DOUBLE|VARCHAR|\"NULL\"")
"""Types whose values are numbers, text and booleans of Python."""


class QueryResult(NamedTuple):
    """Titles and rows of a query. Values are text, numbers, booleans, None, and lists and
    dictionaries of them; NaN and infinities are None within those."""

    columns: list[str]
    rows: list[tuple[Any, ...]]


def connect(directory: Path) -> duckdb.DuckDBPyConnection:
    """Returns an in-memory DuckDB connection with the table ``runs``: the rows of `load_rows`, the
    ``path`` of each run, and `settings_apart`. It is closed to everything else.
    Raises UsageError as load_rows."""
    import duckdb

    from touchdown.experiments.campaign.results_table import SCHEMA, load_rows, run_path, table_of
    from touchdown.experiments.config.keys import settings_apart

    rows = load_rows(directory)
    paths = [run_path(directory, row) for row in rows]
    for row, path, settings in zip(rows, paths, settings_apart(paths), strict=True):
        row |= {"path": str(path)} | {k: v for k, v in settings.items() if k not in SCHEMA}
    connection = duckdb.connect(":memory:", config=_CLOSED)
    connection.execute("set python_enable_replacements = false")
    connection.execute("set TimeZone = 'UTC'")
    connection.register("run_rows", table_of(rows))
    connection.execute("create table runs as select * from run_rows")
    connection.unregister("run_rows")
    connection.execute("set enable_external_access = false")
    connection.execute("set lock_configuration = true")
    return connection


def run_sql(directory: Path, sql: str) -> QueryResult:
    """Returns the result of one statement over the table ``runs``.

    Values of other types than text, numbers and booleans are those of DuckDB's JSON: times,
    intervals, identifiers and binary data are text. Ctrl-C ends the query. Raises UsageError for
    SQL that is wrong, that does not read, or that takes more than `MEMORY_BYTES`, and for a result
    that is too large.
    """
    import duckdb

    connection = connect(directory)
    try:
        # DuckDB's own limit does not cover strings.
        with limited_memory(MEMORY_BYTES), ThreadPoolExecutor(1) as pool:
            found = pool.submit(_fetched, connection, sql)
            try:
                return found.result()
            except KeyboardInterrupt:  # a signal reaches this thread alone, not that of the query
                while not found.done():
                    connection.interrupt()  # one that comes before the query runs is lost
                    time.sleep(0.05)
                raise
    except (duckdb.Error, MemoryError, UnicodeError, UsageError) as error:
        raise UsageError(f"query of '{directory}': {_message(error)}") from error


def _fetched(connection: duckdb.DuckDBPyConnection, sql: str) -> QueryResult:
    relation: Any = connection.sql(_one_statement(connection, sql))
    if relation is None:
        return QueryResult([], [])
    coded = [n for n, kind in enumerate(relation.types) if not _PLAIN.fullmatch(str(kind))]
    values = (
        f"to_json(#{n + 1})" if n in coded else f"#{n + 1}" for n in range(len(relation.types))
    )
    rows = relation.project(", ".join(values)).limit(MAX_ROWS + 1).fetchall()
    if len(rows) > MAX_ROWS:
        raise UsageError(f"it gives more than {MAX_ROWS} rows; add `limit`, or group them")
    return QueryResult(list(relation.columns), [_parsed(row, coded) for row in rows])


def _one_statement(connection: duckdb.DuckDBPyConnection, sql: str) -> str:
    statements = connection.extract_statements(sql)
    if not statements:
        raise UsageError("it is empty; give one, such as 'select run_id, outcome from runs'")
    if len(statements) > 1:
        raise UsageError(f"it has {len(statements)} statements; give one at a time")
    kind = statements[0].type.name
    if kind not in _READING:
        raise UsageError(
            f"a statement of the kind {kind} does not read runs; give one that does: SELECT, FROM, "
            "WITH, VALUES, DESCRIBE, SUMMARIZE, SHOW, PIVOT or EXPLAIN"
        )
    return sql


def _parsed(row: tuple[Any, ...], coded: list[int]) -> tuple[Any, ...]:
    """The row with the JSON of its values ``coded`` read."""
    values = list(row)
    for n in coded:
        values[n] = None if values[n] is None else plain_json(json.loads(values[n]))
    return tuple(values)


def _message(error: BaseException) -> str:
    """The text of DuckDB's error without its class and its picture of the statement, and the
    remedy where it has none."""
    import duckdb

    if isinstance(error, UsageError):
        return str(error)
    if isinstance(error, UnicodeError):
        return "it is not UTF-8 text; correct it"
    if isinstance(error, duckdb.OutOfMemoryException | MemoryError) or "bad_alloc" in str(error):
        return "it takes more than 1 GiB of memory; select, join or group less"
    text = " ".join(re.split(r"\s+LINE \d+:", str(error))[0].split())
    text = re.sub(r"^(\w+ )*Error: ", "", text)
    text = text[:1].lower() + text[1:] or "it failed with an empty message"
    if isinstance(error, duckdb.PermissionException):
        return f"{text}; a query reads `runs` alone: redirect the output of --csv or --json"
    return text
