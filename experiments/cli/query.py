"""The command ``touchdown query``."""

from __future__ import annotations

import atexit
import csv
import gc
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from touchdown.experiments.cli.common import EXIT_DONE, JSON, PATH

if TYPE_CHECKING:
    from touchdown.experiments.reporting.sql import QueryResult


@click.command()
@click.argument("directory", type=PATH, metavar="DIR")
@click.argument("sql")
@JSON
@click.option("--csv", "as_csv", is_flag=True, help="Print comma-separated values.")
def query(directory: Path, sql: str, as_json: bool, as_csv: bool) -> int:
    """Run SQL over the runs in DIR, a campaign or any directory of runs. The table is `runs`.

    Names with a dot are quoted: "position_error_m.mean". `describe runs` lists them all. A query
    reads this table alone, no files, and may be interrupted.

    Example: touchdown query runs/positioning 'select estimator, avg("position_error_m.mean") from
    runs group by all'
    """
    from touchdown.experiments.errors import UsageError
    from touchdown.experiments.reporting.sql import run_sql

    if as_json and as_csv:
        raise UsageError("--json and --csv exclude each other; give one of them")
    atexit.unregister(gc.freeze)  # of `main`; with it the library prints what it takes for leaks
    found = run_sql(directory, sql)
    if as_json:
        click.echo(json.dumps(_objects(found), indent=2))
    elif as_csv:
        _print_csv(found)
    else:
        _print_table(found)
    return EXIT_DONE


def _objects(found: QueryResult) -> dict[str, Any]:
    from touchdown.experiments.errors import UsageError
    from touchdown.experiments.io.provenance import plain_json

    twice = [name for n, name in enumerate(found.columns) if name in found.columns[:n]]
    if twice:
        raise UsageError(
            f"two columns are called '{twice[0]}', and a JSON object holds one; name one of them, "
            "such as select seed as first"
        )
    rows = [dict(zip(found.columns, row, strict=True)) for row in found.rows]
    return {"columns": found.columns, "rows": plain_json(rows)}


def _print_csv(found: QueryResult) -> None:
    """The values as they are; on a terminal, control characters as escapes."""
    from touchdown.experiments.errors import visible

    def shown(value: Any) -> Any:
        return visible(value) if isinstance(value, str) and sys.stdout.isatty() else value

    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow(map(shown, found.columns))
    writer.writerows([shown(value) for value in row] for row in found.rows)


def _print_table(found: QueryResult) -> None:
    from rich.table import Table
    from rich.text import Text

    from touchdown.experiments.errors import visible
    from touchdown.experiments.terminal import make_console

    table = Table()
    for title in found.columns:
        table.add_column(title)
    for row in found.rows:
        cells = (f"{v:.6g}" if isinstance(v, float) else "" if v is None else str(v) for v in row)
        table.add_row(*(Text(visible(cell, keep="\n")) for cell in cells))
    make_console().print(table)
