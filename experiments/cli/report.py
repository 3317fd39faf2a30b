"""Commands that read finished flights: ``touchdown report``, ``regress`` and ``query``."""

from __future__ import annotations

import atexit
import csv
import gc
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from touchdown.experiments.cli.common import (
    JSON,
    PATH,
    PRESET,
    Number,
    answer,
)
from touchdown.experiments.errors import UsageError, visible
from touchdown.experiments.terminal import make_console, say

if TYPE_CHECKING:
    from touchdown.experiments.reporting.sql import QueryResult


@click.command()
@click.argument("directory", type=PATH)
@click.option(
    "--out", type=PATH, help="Write the full report there.  [DIRECTORY/report for a campaign]"
)
@JSON
def report(directory: Path, out: Path | None, as_json: bool) -> int:
    """Report on all flights at or below DIRECTORY.

    Of a campaign, or with --out: what varies and what that changes, tables and figures, as
    report.html (one file, no network needed), report.md and report.json. Of any other directory: a
    Markdown table of its runs, a line on how they ended, and one for each that found no site or
    gave one up: what was refused, and whether it was safe. Exit code 1 means that runs of a
    campaign have other outcomes than its file expects.

    Example: touchdown report campaigns/positioning
    """
    from touchdown.experiments.campaign.results_table import is_campaign

    if out is None and not is_campaign(directory):
        return _print_table(directory, as_json)
    return _write_report(directory, out or directory / "report", as_json)


def _print_table(directory: Path, as_json: bool) -> int:
    from touchdown.experiments.io.results import load_runs
    from touchdown.experiments.reporting.flights import frame_of, label_conditions, load_flights
    from touchdown.experiments.reporting.report_tables import (
        missed_lines,
        run_table,
        summary,
        summary_line,
    )

    runs, rows = load_runs(directory), load_flights(directory)
    label_conditions(rows)
    frame = frame_of(rows)
    totals = summary(frame)

    def show(_figures: Mapping[str, Any]) -> None:
        say("\n".join([*run_table(frame).lines, "", summary_line(totals), *missed_lines(runs)]))

    plain = [{**result.plain(), "run": name} for name, result in runs.items()]
    return answer({"summary": totals, "runs": plain}, as_json, show)


def _write_report(directory: Path, out: Path, as_json: bool) -> int:
    from touchdown.experiments.campaign import expectations
    from touchdown.experiments.campaign.results_table import is_campaign
    from touchdown.experiments.reporting import report
    from touchdown.experiments.reporting.flights import (
        campaign_name,
        campaign_text,
        first_condition,
        load_flights,
    )

    rows = load_flights(directory)
    verdicts = expectations.judge_campaign(directory) if is_campaign(directory) else []
    made = report.make_report(
        rows,
        title=campaign_name(directory) or directory.resolve().name,
        configuration=campaign_text(directory),
        verdicts=verdicts,
        first=first_condition(directory),
    )
    files = {kind: str(path) for kind, path in report.write_report(made, rows, out).items()}

    def show(_figures: Mapping[str, Any]) -> None:
        for section in made.sections[:2]:
            for table in section.tables:
                say("\n".join(map(visible, ["", table.title, "", *table.lines])))
            say("\n".join(["", *(f"- {visible(line)}" for line in section.words)]))
        say("")
        for line in expectations.idle_conditions(rows):
            say(f"warning: {visible(line)}\n")
        if verdicts:
            say("\n".join(map(visible, expectations.lines(verdicts))) + "\n")
        for path in files.values():
            say(f"written: {visible(path)}")

    figures = {**report.as_json(made, rows), "files": files}
    return answer(figures, as_json, show, good=expectations.all_as_expected(verdicts))


@click.command()
@click.argument("directory", metavar="DIRECTORY|FILE.toml", type=PATH)
@click.option(
    "--baseline",
    required=True,
    metavar="F.json",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Flights to compare with, written by --update.",
)
@click.option("--update", is_flag=True, help="Make the flights of DIRECTORY the baseline.")
@click.option(
    "--margin",
    type=Number(min=0.0, max=100.0),
    default=0.0,
    show_default=True,
    help="Share by which errors may grow: 0.1 asks for more than 10 % worse.",
)
@click.option(
    "--require-power",
    is_flag=True,
    help="Exit 1 also where a scene and method has too few equal seeds to find any change.",
)
@click.option(
    "--bounds",
    is_flag=True,
    help="Compare position error, NEES, stated sigma, d_L and levelness with bounds from the "
    "baseline's spread between seeds; for few flights.",
)
@PRESET
@click.option("--out", type=PATH, metavar="DIR",
              help="With FILE.toml: a new directory that keeps the flights.  [none]")  # fmt: skip
@JSON
def regress(directory: Path, baseline: Path, update: bool, as_json: bool, **more: Any) -> int:
    """Exit 1 when DIRECTORY's flights are worse than the baseline's. FILE.toml is a campaign, which
    is flown first.

    Compares each scene and method: a paired test on equal seeds, Welch's where seeds differ,
    corrected over all of them, so that chance alone fails at most 5 comparisons of 100. Flights
    with an error in the baseline and none now are worse without a test, and so is
    a directory with nothing to compare. --bounds compares six figures of few flights instead.

    Example: touchdown regress campaigns/positioning --baseline baseline.json
    """
    from touchdown.experiments.reporting.regression.baseline import read_baseline, write_baseline
    from touchdown.experiments.reporting.regression.bounds import bounds_lines, check_bounds
    from touchdown.experiments.reporting.regression.compare import compare, comparison_lines

    before = None if update else read_baseline(baseline)
    rows = _rows_of(directory, more["preset"], more["out"])
    if before is None:
        write_baseline(rows, baseline)
        return answer(
            {"baseline": str(baseline), "flights": len(rows)},
            as_json,
            lambda _figures: say(f"written: {baseline}, {len(rows)} flights"),
        )
    if more["bounds"]:
        bounded = check_bounds(rows, before)
        figures, lines, failed = bounded.as_json(), bounds_lines(bounded), bounded.failed
    else:
        compared = compare(rows, before, more["margin"])
        figures, lines = compared.as_json(), comparison_lines(compared)
        failed = compared.failed(more["require_power"])
    return answer(figures, as_json, lambda _: say("\n".join(map(visible, lines))), good=not failed)


def _rows_of(source: Path, preset: str | None, out: Path | None) -> list[dict[str, Any]]:
    """The flights of a directory, or of a campaign's file, flown into ``out`` or a directory that
    goes afterwards. Raises UsageError where ``out`` has flights already: they would not be flown
    again."""
    from touchdown.experiments.campaign.plan import load_plan
    from touchdown.experiments.campaign.progress import Display
    from touchdown.experiments.campaign.results_table import is_campaign
    from touchdown.experiments.campaign.session import fly_campaign, make_engine
    from touchdown.experiments.reporting.flights import load_flights

    if source.suffix != ".toml":
        if preset is not None or out is not None:
            raise UsageError(f"--preset and --out go with FILE.toml: '{source}' is flown already")
        return load_flights(source)
    plan = load_plan(source, preset=preset)
    if out is not None and is_campaign(out):
        raise UsageError(f"--out {out} has flights already; name a new directory, or compare it")
    with tempfile.TemporaryDirectory() as folder:
        directory = out or Path(folder) / "flights"
        fly_campaign(plan, directory, make_engine("local", None), watcher=Display())
        return load_flights(directory)


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
    from touchdown.experiments.reporting.sql import run_sql

    if as_json and as_csv:
        raise UsageError("--json and --csv exclude each other; give one of them")
    atexit.unregister(gc.freeze)  # of `main`; with it the library prints what it takes for leaks
    found = run_sql(directory, sql)
    show = _print_csv if as_csv else _print_rows
    return answer(_objects(found) if as_json else None, as_json, lambda _: show(found))


def _objects(found: QueryResult) -> dict[str, Any]:
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

    def shown(value: Any) -> Any:
        return visible(value) if isinstance(value, str) and sys.stdout.isatty() else value

    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow(map(shown, found.columns))
    writer.writerows([shown(value) for value in row] for row in found.rows)


def _print_rows(found: QueryResult) -> None:
    from rich.table import Table
    from rich.text import Text

    table = Table()
    for title in found.columns:
        table.add_column(title)
    for row in found.rows:
        cells = (f"{v:.6g}" if isinstance(v, float) else "" if v is None else str(v) for v in row)
        table.add_row(*(Text(visible(cell, keep="\n")) for cell in cells))
    make_console().print(table)
