"""SQL over the runs of a directory, by DuckDB. It reads their table and nothing else: files,
network, extensions and settings are closed before the first statement.

A query runs in a process of its own with a hard limit on memory, which DuckDB's own limit does not
cover and which can be ended in any of its functions.
"""

from __future__ import annotations

import json
import re
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.provenance import plain_json
from touchdown.sim.files import child

if TYPE_CHECKING:
    import duckdb
    import pyarrow as pa

MOST_ROWS, MOST_BYTES = 1_000_000, 128 << 20
"""of one result"""
MEMORY_BYTES = 1 << 30
"""of a query's process, for the table of the runs and all made of it; nothing goes to the disk"""

_CLOSED: dict[str, Any] = {
    "memory_limit": "768MiB",  # here DuckDB can still say what is wrong
    "temp_directory": "",  # a query that needs more memory fails instead of filling the disk
    "max_temp_directory_size": "0B",
    "allow_persistent_secrets": False,
    "autoinstall_known_extensions": False,
    "autoload_known_extensions": False,
}
_READING = {"SELECT", "EXPLAIN", "MULTI"}
"""Kinds of statements that read; MULTI is a PIVOT."""
_PLAIN = {
    "BOOLEAN", "TINYINT", "SMALLINT", "INTEGER", "BIGINT", "HUGEINT", "UTINYINT", "USMALLINT",
    "UINTEGER", "UBIGINT", "UHUGEINT", "FLOAT", "DOUBLE", "VARCHAR", "JSON", "NULL",
}  # fmt: skip
"""Types whose values are numbers, text and booleans of Python."""
_NO_MEMORY = (child.NO_MEMORY, -signal.SIGABRT, -signal.SIGKILL)
"""Exit codes; a library that finds no memory aborts"""
_TOO_LARGE = "it takes more than 1 GiB of memory; select, join or group less"


class QueryResult(NamedTuple):
    """Titles and rows of a query. Values are text, numbers, booleans, None, and lists and
    dictionaries of them; NaN and infinities are None within those."""

    columns: list[str]
    rows: list[tuple[Any, ...]]


def connect(directory: Path) -> duckdb.DuckDBPyConnection:
    """Returns an in-memory DuckDB connection with the table ``runs``: the rows of `load_rows`, the
    ``path`` of each run, and `settings_apart`. It is closed to everything else.
    Raises UsageError as load_rows."""
    return _closed(_table(directory))


def _table(directory: Path) -> pa.Table:
    from touchdown.experiments.campaign.results_table import SCHEMA, load_rows, run_path, table_of
    from touchdown.experiments.config.settings import settings_apart

    rows = load_rows(directory)
    paths = [run_path(directory, row) for row in rows]
    for row, path, settings in zip(rows, paths, settings_apart(paths), strict=True):
        row |= {"path": str(path)} | {k: v for k, v in settings.items() if k not in SCHEMA}
    return table_of(rows)


def _closed(table: pa.Table) -> duckdb.DuckDBPyConnection:
    import duckdb

    connection = duckdb.connect(":memory:", config=_CLOSED)
    connection.execute("set python_enable_replacements = false")
    connection.execute("set TimeZone = 'UTC'")
    connection.register("run_rows", table)
    connection.execute("create table runs as select * from run_rows")
    connection.unregister("run_rows")
    connection.execute("set enable_external_access = false")
    connection.execute("set lock_configuration = true")
    return connection


def run_sql(directory: Path, sql: str) -> QueryResult:
    """Returns the result of one statement over the table ``runs``, from a process of its own.

    Decimal numbers are floats; times, intervals, identifiers, binary data and the like are
    DuckDB's text. Ctrl-C ends the query. Raises UsageError for SQL that is wrong, that does not
    read, or that takes more than `MEMORY_BYTES`, and for a result that is too large.
    """
    table = _table(directory)
    try:
        return _asked_of_child(table, sql)
    except UsageError as error:
        raise UsageError(f"query of '{directory}': {error}") from error


def query_table(table: pa.Table, sql: str) -> QueryResult:
    """As `run_sql`, of a table and in this process: without limits on what DuckDB does."""
    import duckdb

    try:
        return _fetched(_closed(table), sql)
    except (duckdb.Error, MemoryError, UnicodeError) as error:
        raise UsageError(_message(error)) from error


def _fetched(connection: duckdb.DuckDBPyConnection, sql: str) -> QueryResult:
    relation: Any = connection.sql(_one_statement(connection, sql))
    if relation is None:
        return QueryResult([], [])
    columns, types = list(relation.columns), list(relation.types)
    shown = [_shown_type(kind) for kind in types]
    if any(shown):
        casts = (f"cast(#{n} as {kind})" if kind else f"#{n}" for n, kind in enumerate(shown, 1))
        relation = relation.project(", ".join(casts))
    rows = relation.limit(MOST_ROWS + 1).fetchall()
    if len(rows) > MOST_ROWS:
        raise UsageError(f"it gives more than {MOST_ROWS} rows; add `limit`, or group them")
    return QueryResult(columns, [tuple(_plain(value) for value in row) for row in rows])


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


def _shown_type(kind: Any) -> str:
    """The type to which values are cast to be numbers, text and booleans, and lists and structures
    of them; "" for a type that needs no cast."""
    name = str(kind).strip('"')
    if name in _PLAIN:
        return ""
    if kind.id == "decimal":
        return "double"
    if kind.id in ("list", "array"):
        children = dict(kind.children)
        inner = _shown_type(children["child"]) or str(children["child"])
        size = children.get("size", "") if kind.id == "array" else ""
        return f"{inner}[{size}]"
    if kind.id == "struct":
        inner = ", ".join(f"{_quoted(n)} {_shown_type(k) or str(k)}" for n, k in kind.children)
        return f"struct({inner})"
    return "varchar"


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'


def _plain(value: Any) -> Any:
    return plain_json(value) if isinstance(value, list | tuple | dict) else value


def _message(error: BaseException) -> str:
    """The text of DuckDB's error without its class and its picture of the statement, and the
    remedy where it has none."""
    import duckdb

    if isinstance(error, UnicodeError):
        return "it is not UTF-8 text; correct it"
    if isinstance(error, duckdb.OutOfMemoryException | MemoryError) or "bad_alloc" in str(error):
        return _TOO_LARGE
    text = " ".join(re.split(r"\s+LINE \d+:", str(error))[0].split())
    text = re.sub(r"^(\w+ )*Error: ", "", text)
    text = text[:1].lower() + text[1:] or "it failed with an empty message"
    if isinstance(error, duckdb.PermissionException):
        return f"{text}; a query reads `runs` alone: redirect the output of --csv or --json"
    return text


# ------------------------------------------------------------------------------------- the process


def _asked_of_child(table: pa.Table, sql: str) -> QueryResult:
    """As `query_table`, in a process that has `MEMORY_BYTES` and ends with this one."""
    import pyarrow as pa

    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, table.schema) as stream:
        stream.write_table(table)
    data = json.dumps(sql).encode() + b"\n" + sink.getvalue().to_pybytes()
    ended = child.run_limited(_answer, str(MOST_BYTES), data, memory_bytes=MEMORY_BYTES)
    if ended.code in _NO_MEMORY:
        raise UsageError(_TOO_LARGE)
    if ended.answer is None:
        raise UsageError(f"it ended the process that ran it (exit code {ended.code})")
    if ended.answer:
        raise UsageError(ended.answer)
    columns, *rows = map(json.loads, ended.output.splitlines())
    return QueryResult(columns, [tuple(row) for row in rows])


def _answer(most_bytes: str) -> str:
    """Answers the SQL on the first line of stdin about the table behind it: prints a line of JSON
    for the titles and one for each row. Returns the text of an error, "" for none."""
    import pyarrow as pa

    left = int(most_bytes)
    try:
        sql = json.loads(sys.stdin.buffer.readline())
        with pa.ipc.open_stream(sys.stdin.buffer.read()) as stream:
            found = query_table(stream.read_all(), sql)
        for row in (found.columns, *found.rows):
            line = json.dumps(row)
            left -= len(line)
            if left < 0:
                size = int(most_bytes) >> 20
                return f"it gives more than {size} MiB; add `limit`, or group the rows"
            print(line)
    except UsageError as error:
        return str(error)
    return ""
