"""Commands that read finished flights: ``touchdown report`` and ``touchdown regress``."""

from __future__ import annotations

import json
from pathlib import Path

import click

from experiments.cli_base import EXIT_DONE, EXIT_FAILED


@click.command()
@click.argument("directory", type=click.Path(path_type=Path))
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    help="Write the full report there.  [DIRECTORY/report for a campaign]",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def report(directory: Path, out: Path | None, as_json: bool) -> int:
    """Report on all flights at or below DIRECTORY.

    Of a campaign, or with --out: the paper's tables and figures, measured beside published, as
    report.html (one file, no network needed), report.md and report.json. Of any other directory: a
    Markdown table of its runs, and their summary.

    Example: touchdown report campaigns/positioning
    """
    from experiments.reporting.flights import is_campaign

    if out is None and not is_campaign(directory):
        return _print_table(directory, as_json)
    return _write_report(directory, out or directory / "report", as_json)


def _print_table(directory: Path, as_json: bool) -> int:
    from experiments.report import LANDING_COLUMNS, load_runs, markdown_table, summary

    rows = load_runs(directory)
    totals = summary(rows)
    if as_json:
        click.echo(json.dumps({"summary": totals, "runs": rows}, indent=2))
    else:
        click.echo(markdown_table(rows, LANDING_COLUMNS))
        click.echo(f"\n{json.dumps(totals, indent=2)}")
    return EXIT_DONE


def _write_report(directory: Path, out: Path, as_json: bool) -> int:
    from experiments.config import UsageError
    from experiments.reporting.document import as_json as figures
    from experiments.reporting.document import make_report, write_report
    from experiments.reporting.flights import campaign_text, load_flights

    rows = load_flights(directory)
    made = make_report(
        rows,
        title=f"Touchdown: {directory.resolve().name}",
        configuration=campaign_text(directory),
    )
    try:
        written = write_report(made, rows, out)
    except OSError as error:
        raise UsageError(f"--out {out}: cannot be written: {error.strerror}") from error
    if as_json:
        files = {kind: str(path) for kind, path in written.items()}
        click.echo(json.dumps({**figures(made, rows), "files": files}, indent=2))
        return EXIT_DONE
    for section in made.sections[:2]:
        click.echo(f"{section.title}\n")
        click.echo("\n".join(f"- {line}" for line in section.words) + "\n")
    for path in written.values():
        click.echo(f"written: {path}")
    return EXIT_DONE


__all__ = ["EXIT_FAILED", "report"]
