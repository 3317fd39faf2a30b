"""SQL over the runs of a directory, by DuckDB. It reads their table and nothing else: files,
network, extensions and settings are closed before the first statement."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from touchdown.experiments.campaign.results_table import load_rows, table_of
from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.provenance import plain_json

if TYPE_CHECKING:
    import duckdb

MOST_ROWS = 1_000_000
"""of one result"""
MEMORY = "1GB"
"""for the table of the runs and all that a query makes of it; nothing is put on the disk"""

_CLOSED: dict[str, Any] = {
    "memory_limit": MEMORY,
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
_POLL_S, _PATIENCE_S = 0.1, 5.0


class QueryResult(NamedTuple):
    """Titles and rows of a query. Values are text, numbers, booleans, None, and lists and
    dictionaries of them; NaN and infinities are None within those."""

    columns: list[str]
    rows: list[tuple[Any, ...]]


def connect(directory: Path) -> duckdb.DuckDBPyConnection:
    """Returns an in-memory DuckDB connection with the table ``runs``, closed to everything else.
    Raises UsageError as load_rows."""
    import duckdb

    connection = duckdb.connect(":memory:", config=_CLOSED)
    connection.execute("set python_enable_replacements = false")
    connection.execute("set TimeZone = 'UTC'")
    connection.register("run_rows", table_of(load_rows(directory)))
    connection.execute("create table runs as select * from run_rows")
    connection.unregister("run_rows")
    connection.execute("set enable_external_access = false")
    connection.execute("set lock_configuration = true")
    return connection


def run_sql(directory: Path, sql: str) -> QueryResult:
    """Returns the result of one statement over the table ``runs``.

    Decimal numbers are floats; times, intervals, identifiers, binary data and the like are
    DuckDB's text. Ctrl-C ends the query. Raises UsageError for SQL that is wrong, that does not
    read, or whose result is too large.
    """
    import duckdb

    connection = connect(directory)
    try:
        return _interruptible(connection, lambda: _fetched(connection, sql))
    except (duckdb.Error, MemoryError, UnicodeError, UsageError) as error:
        raise UsageError(f"query of '{directory}': {_message(error)}") from error


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


# ------------------------------------------------------------------------------------- interruption


def _interruptible(
    connection: duckdb.DuckDBPyConnection, action: Callable[[], QueryResult]
) -> QueryResult:
    """Runs ``action`` in a thread, since DuckDB holds up the signals of its own thread."""
    ended: list[QueryResult | BaseException] = []
    over = threading.Event()  # a join that Ctrl-C has ended never waits again

    def work() -> None:
        try:
            ended.append(action())
        except BaseException as error:
            ended.append(error)
        finally:
            over.set()

    threading.Thread(target=work, daemon=True).start()
    try:
        while not over.wait(_POLL_S):
            pass
    except KeyboardInterrupt:
        connection.interrupt()
        over.wait(_PATIENCE_S)
        raise
    found = ended[0]
    if isinstance(found, BaseException):
        raise found
    return found


def _message(error: BaseException) -> str:
    """The text of DuckDB's error without its class and its picture of the statement, and the
    remedy where it has none."""
    import duckdb

    if isinstance(error, UsageError):
        return str(error)
    if isinstance(error, UnicodeError):
        return "it is not UTF-8 text; correct it"
    if isinstance(error, duckdb.OutOfMemoryException | MemoryError):
        return f"it takes more than {MEMORY} of memory; select, join or group less"
    text = " ".join(re.split(r"\s+LINE \d+:", str(error))[0].split())
    text = re.sub(r"^(\w+ )*Error: ", "", text)
    text = text[:1].lower() + text[1:] or "it failed with an empty message"
    if isinstance(error, duckdb.PermissionException):
        return f"{text}; a query reads `runs` alone: redirect the output of --csv or --json"
    return text
