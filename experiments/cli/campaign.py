"""Commands for many flights: ``touchdown campaign``, ``results`` and ``reproduce``."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from touchdown.experiments.cli.common import (
    JOBS,
    JSON,
    OVERRIDES,
    PATH,
    PRESET,
    QUIET,
    CommandGroup,
    Parsed,
    answer,
    resumable,
)
from touchdown.experiments.errors import usage_errors, visible
from touchdown.experiments.terminal import say

if TYPE_CHECKING:
    from touchdown.experiments.campaign.forecast import Forecast
    from touchdown.experiments.reproduce.parts import Part


def _shard(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d+)/(\d+)", text)
    if not found or not 1 <= int(found[1]) <= int(found[2]):
        raise ValueError
    return int(found[1]), int(found[2])


def _place(text: str) -> Path | str:
    return text if "://" in text else Path(text)


class CampaignGroup(CommandGroup):
    """Runs ``campaign FILE.toml`` where the first argument is no subcommand."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        if not args:
            raise click.UsageError("missing argument 'FILE.toml', or 'status DIR'", ctx)
        if args[0].startswith("-") and args[0] not in ctx.help_option_names:
            args = ["--", *args]  # options of the flight, before the file
        return super().parse_args(ctx, args)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if args and args[0] not in self.commands and _is_flight(args):
            return "", fly_file, args
        return super().resolve_command(ctx, args)

    def format_help(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        fly_file.format_help(ctx, formatter)
        formatter.write_paragraph()
        formatter.write_text("See also `touchdown campaign status DIR`.")


def _is_flight(args: list[str]) -> bool:
    return args[0].startswith("-") or bool(re.search(r"[./]", args[0])) or "--out" in args


@click.group(cls=CampaignGroup)
def campaign() -> None:
    """Fly scenes x estimators x seeds x winds.

    Example: touchdown campaign configs/positioning.toml --out runs/positioning
    """


@click.command("campaign")
@click.argument("file", type=PATH, metavar="FILE.toml")
@click.option("--out", type=Parsed("DIR", "such as runs/many or s3://bucket/many", _place),
              metavar="DIR|ADDRESS",
              help="The campaign's directory, here or at an address such as s3://bucket/many; an "
                   "existing one is resumed.")  # fmt: skip
@JOBS
@click.option("--engine", type=click.Choice(["local", "ray"]), default="local", show_default=True)
@click.option("--ray-address", metavar="ADDRESS", help="Of a Ray cluster.  [a local one]")
@click.option("--shard", type=Parsed("I/N", "such as 1/4 to 4/4", _shard),
              help="Fly the I-th of N parts, on one of N machines.")  # fmt: skip
@click.option("--allow-code", is_flag=True,
              help="Import external estimators that a campaign.toml of results names.")  # fmt: skip
@PRESET
@OVERRIDES
@click.option("--dry-run", is_flag=True,
              help="Print the number of flights and their expected cost; fly nothing.")  # fmt: skip
@JSON
@QUIET
@click.pass_context
def fly_file(
    context: click.Context, file: Path, out: Path | str | None, as_json: bool, **more: Any
) -> int:
    """Fly all runs of FILE.toml: scenes x estimators x seeds x winds, in parallel.

    Every run becomes a directory below DIR/runs, and a row of DIR/results.parquet. It may be
    interrupted at any time; the same command resumes it. Exit code 0 means that every run has an
    outcome, as the file expects it, 1 that some have not, 2 invalid input. --dry-run flies and
    writes nothing.

    Example: touchdown campaign configs/positioning.toml --out runs/positioning --jobs 2
    """
    from touchdown.experiments.campaign.forecast import forecast, lines
    from touchdown.experiments.campaign.plan import load_plan, runs_of_shard
    from touchdown.experiments.campaign.progress import Display, print_summary
    from touchdown.experiments.campaign.remote import Remote, fly_to_address
    from touchdown.experiments.campaign.session import (
        Watcher,
        default_jobs,
        fly_campaign,
        make_engine,
    )

    shard = more["shard"]
    plan = load_plan(file, **{key: more[key] for key in ("allow_code", "preset", "overrides")})
    folder = Remote(out).directory if isinstance(out, str) else out
    expected = forecast(plan, runs_of_shard(plan, shard), folder, more["jobs"] or default_jobs())
    if more["dry_run"]:
        return answer(
            expected.as_json(), as_json, lambda _: say("\n".join(map(visible, lines(expected))))
        )
    if out is None or folder is None:
        raise click.MissingParameter(ctx=context, param_hint="'--out'", param_type="option")
    flown_by = make_engine(more["engine"], more["jobs"], more["ray_address"])
    watcher = Watcher() if more["quiet"] else Display(lines(expected))
    with resumable(
        "runs are kept, and the same command resumes the campaign "
        f"(see 'touchdown campaign status {folder}')"
    ):
        if isinstance(out, str):
            figures = fly_to_address(plan, out, flown_by, shard=shard, watcher=watcher)
        else:
            figures = fly_campaign(plan, out, flown_by, shard=shard, watcher=watcher)
    missing = figures["missing"]
    good = figures["as_expected"] and not (missing or figures["crashed"])
    code = answer(figures, as_json, print_summary, good=good)
    if missing:
        say(
            f"touchdown: {len(missing)} runs have no row, such as {missing[0]}; give the same "
            "command again to fly them",
            err=True,
        )
    return code


@campaign.command("status")
@click.argument("directory", type=PATH, metavar="DIR")
@JSON
def status(directory: Path, as_json: bool) -> int:
    """Print the progress of the campaign in DIR and its time by stage, also while it runs. Exit
    code 1 means that some results are not as its file expects.

    Example: touchdown campaign status runs/positioning
    """
    from touchdown.experiments.campaign.progress import print_summary
    from touchdown.experiments.campaign.session import summary

    figures = summary(directory)
    return answer(figures, as_json, print_summary, good=figures["as_expected"])


@click.command()
@click.argument("out", type=PATH, metavar="OUT")
@click.argument("parts", type=PATH, nargs=-1, required=True, metavar="DIR...")
@JSON
def merge(out: Path, parts: tuple[Path, ...], as_json: bool) -> int:
    """Make one campaign in OUT of the directories DIR, the shards of one file flown on machines
    without a common disk. Runs are copied; give the command again when more have come.

    Exit code 1 means that runs are missing or not as expected.

    Example: touchdown merge runs/all runs/part-1 runs/part-2
    """
    from touchdown.experiments.campaign.merging import merge as merge_parts
    from touchdown.experiments.campaign.progress import print_summary

    figures = usage_errors(lambda: merge_parts(out, parts))
    whole = not figures["remaining"] and not figures["crashed"]
    return answer(figures, as_json, print_summary, good=whole and figures["as_expected"])


@click.command()
@click.option("--out", type=PATH, metavar="DIR", required=True,
              help="Directory of the flights; an earlier one is continued.")  # fmt: skip
@click.option("--part", "parts", multiple=True, metavar="NAME",
              help="One part: paper, or a campaign such as landing. May be repeated.")  # fmt: skip
@click.option("--write", is_flag=True,
              help="Write docs/results/rows.parquet and the tables of the pages.")  # fmt: skip
@click.option("--dry-run", is_flag=True, help="Print what it would cost, and fly nothing.")
@JOBS
@JSON
@QUIET
def results(
    out: Path,
    parts: tuple[str, ...],
    write: bool,
    dry_run: bool,
    jobs: int | None,
    as_json: bool,
    quiet: bool,
) -> int:
    """Fly an edition of what README and the results pages print, and write their tables.

    Of a git checkout of Touchdown, without changes that are not committed. It may be interrupted at
    any time; the same command resumes it. --write takes rows of one revision only, which the pages
    state. Exit code 1 means that a flight has no outcome, 2 invalid input.

    Example: touchdown results --out runs/results --write
    """
    from touchdown.experiments.campaign.progress import Display
    from touchdown.experiments.campaign.session import Watcher
    from touchdown.experiments.results_tables import edition, pages

    sets = edition.chosen(parts)
    todo = edition.forecasts(sets, out, jobs)
    if dry_run:
        return answer(_costs(todo), as_json, lambda _figures: _print_costs(todo, err=False))
    if not quiet:
        _print_costs(todo, err=True)
    with resumable("flights are kept, and the same command resumes the rest"):
        summaries = edition.fly(sets, out, jobs, Watcher if quiet else Display)
        measured = edition.measure(parts, out)
    incomplete = any(found["missing"] for found in summaries)
    if write and incomplete:
        say(
            "touchdown: flights are missing, so nothing is written; the same command flies them",
            err=True,
        )
    files = (
        [str(file) for file in pages.write_pages(sets, out, measured)]
        if write and not incomplete
        else []
    )
    good = not any(found["crashed"] or found["missing"] for found in summaries)
    return answer({"sets": summaries, "written": files}, as_json, _print_sets, good=good)


def _print_sets(figures: Mapping[str, Any]) -> None:
    for found in figures["sets"]:
        counts = ", ".join(f"{name} {n}" for name, n in found["outcomes"].items())
        say(f"{found['directory']}: {found['finished']} of {found['runs']} flights; {counts}")
    for file in figures["written"]:
        say(f"written: {file}")


def _costs(found: Sequence[Forecast]) -> dict[str, Any]:
    """Flights and expected CPU time of each set by condition, then of all."""
    return {
        "sets": [one.as_json() for one in found],
        "left": sum(one.flights - one.finished for one in found),
        "core_hours": sum(one.core_hours for one in found),
    }


def _print_costs(found: Sequence[Forecast], *, err: bool) -> None:
    from touchdown.experiments.campaign.forecast import lines

    for one in found:
        say("\n".join(lines(one)), err=err)
    costs, wall_min = _costs(found), sum(one.wall_s for one in found) / 60.0
    say(
        f"together: {costs['left']} flights, {costs['core_hours']:.2f} core-hours, about "
        f"{wall_min:.0f} min here",
        err=err,
    )


@click.command()
@click.option("--out", type=PATH, metavar="DIR",
              help="Directory; required without --list. An earlier one is continued.")  # fmt: skip
@click.option("--quick", is_flag=True, help="Few flights and one small network.")
@JOBS
@click.option("--skip", multiple=True, metavar="PART",
              help="Leave a part out, such as recognition. May be repeated.")  # fmt: skip
@click.option("--photographs", multiple=True, metavar="[KIND=]DIR",
              help="Train the networks on these labelled photographs too, as --data of "
              "touchdown train. May be repeated.")  # fmt: skip
@click.option("--list", "only_list", is_flag=True,
              help="Print the parts, their tables and figures, and approximate times.")  # fmt: skip
@JSON
@QUIET
def reproduce(
    out: Path | None,
    jobs: int | None,
    only_list: bool,
    as_json: bool,
    quiet: bool,
    **chosen: Any,
) -> int:
    """Reproduce all tables and figures of the paper and compare them with the published ones.

    Calibrates, flies the campaigns of positioning and landing, trains networks, and writes
    DIR/report: report.html (one file, no network needed), report.md and report.json. It may be
    interrupted at any time; the same command resumes it, and without --quick extends a quick
    edition to a whole one. Exit code 1 means that a part failed its purpose, 2 invalid input.

    Example: touchdown reproduce --out runs/reproduction --quick
    """
    from touchdown.experiments.campaign.progress import Display
    from touchdown.experiments.campaign.session import Watcher, default_jobs
    from touchdown.experiments.reproduce import run
    from touchdown.experiments.terminal import make_notes

    chosen["jobs"] = jobs or default_jobs()
    if only_list:
        wanted = run.parts_wanted(chosen["skip"], chosen["photographs"])
        return answer({"parts": _overview(wanted, chosen["quick"])}, as_json, _print_list)
    if out is None:
        raise click.UsageError("missing option '--out'", click.get_current_context())
    with resumable("parts are kept, and the same command resumes the rest"):
        done = run.reproduce(
            out, notes=make_notes(quiet), watcher=Watcher if quiet else Display, **chosen
        )
    return answer(done.as_json(), as_json, _print_parts, good=done.successful)


def _overview(parts: Sequence[Part], quick: bool) -> list[dict[str, Any]]:
    """Parts with their tables, figures and approximate times on one core."""
    from touchdown.experiments.reproduce.parts import Extent

    extent = Extent(quick=quick)
    return [
        {
            "part": part.name,
            "title": part.title,
            "shows": list(part.shows),
            "core_minutes": part.core_seconds(extent) / 60.0,
        }
        for part in parts
    ]


def _print_list(figures: Mapping[str, Any]) -> None:
    parts = figures["parts"]
    for part in parts:
        minutes = part["core_minutes"]
        click.echo(f"{part['part']:15} {minutes:8.1f} min of one core   {', '.join(part['shows'])}")
    click.echo(f"{'together':15} {sum(p['core_minutes'] for p in parts):8.1f} min of one core")


def _print_parts(figures: Mapping[str, Any]) -> None:
    for part in figures["parts"]:
        verdict = "done" if part["good"] else f"FAILED: {part['why']}"
        click.echo(f"{part['part']:15} {part['edition']:6} {part['wall_s']:8.0f} s  {verdict}")
    for name in figures["skipped"]:
        click.echo(f"{name:15} left out")
    for path in figures["files"].values():
        click.echo(f"written: {path}")
