"""The report of a campaign: tables and figures, as Markdown, HTML and JSON."""

import contextlib
import html
import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

import pandas as pd

from touchdown.experiments.campaign.expectations import Verdict
from touchdown.experiments.campaign.results_table import is_successful
from touchdown.experiments.errors import UsageError, visible
from touchdown.experiments.io.provenance import UNRECORDED_REMEDY
from touchdown.experiments.io.result_parts import PartNames
from touchdown.experiments.io.run_directory import run_directory, write_text
from touchdown.experiments.io.untrusted import as_plain_name, read_object
from touchdown.experiments.reporting import published
from touchdown.experiments.reporting.comparison import (
    difference_tables,
    factors_of,
    level_table,
    varying_words,
)
from touchdown.experiments.reporting.curves import curves, dial_frames, dials_of, methods_over
from touchdown.experiments.reporting.figures import Picture, pictures_of
from touchdown.experiments.reporting.flights import (
    Row,
    frame_of,
    label_conditions,
    number,
    ordered,
)
from touchdown.experiments.reporting.report_tables import (
    accuracy_table,
    axis_table,
    expectation_table,
    flight_table,
    intruder_table,
    landing_tables,
    map_table,
)
from touchdown.experiments.reporting.statistics import INTERVAL
from touchdown.experiments.reporting.tables import (
    Table,
    fenced,
    markdown_cell,
    markdown_text,
    narrowed,
    plain_title,
)
from touchdown.experiments.reporting.trajectories import add_path_deviation

_FILES = {"markdown": "report.md", "html": "report.html", "json": "report.json"}
_MAX_DRAWN = 2
"""conditions with drawings of their own"""
_MAX_NAMED = 20
"""unsuccessful flights that are listed by name"""
_UNNAMED = "unnamed condition"


@dataclass(slots=True)
class Section:
    key: str
    title: str
    words: list[str] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    pictures: list[Picture] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Report:
    title: str
    sections: list[Section]
    configuration: str = ""
    """text of the campaign's file, empty without one"""
    paper: bool = False


def make_report(
    rows: list[dict[str, Any]],
    *,
    title: str,
    configuration: str = "",
    verdicts: Sequence[Verdict] = (),
    first: str = "",
    paper: bool = False,
) -> Report:
    """Returns the report of the flights ``rows`` (see `flights.load_flights`); ``verdicts``: on the
    expectations of the campaign; ``first``: its first condition, with which the others are
    compared; ``paper``: with the paper's figures beside ours, and by the numbers of its tables.
    Every figure is of the flights of one condition, but for methods compared over dials. Tables are
    of at most `tables.MAX_COLUMNS` columns, but for those of the paper."""
    add_path_deviation(rows)
    label_conditions(rows)
    frame = frame_of(sorted(rows, key=lambda row: (row["condition"] != first, row["condition"])))
    pictures = _pictures(frame, paper)
    drawn_dials = {} if paper else dial_frames(rows, frame, dials_of(configuration))
    dials = [curves(dial, flown) for dial, flown in drawn_dials.items()]
    paired = methods_over(rows, frame, list(drawn_dials)) if dials else frame
    differences, shown = difference_tables(paired, ["condition"] if dials else [])
    compared = paired.assign(condition="") if dials else frame

    def drawn(*names: str) -> list[Picture]:
        return [picture for picture in pictures if picture.name.startswith(names)]

    sections = [
        Section("curves", "Where it ends", [line for *_, words in dials for line in words],
                [table for table, *_ in dials], [picture for _, picture, _ in dials]),
        Section("varies", "What varies" if factors_of(compared) else "At a glance",
                [*varying_words(compared, configuration), *part_words(rows), *shown],
                [level_table(compared), *differences]),
        Section("summary", "Outcomes", summary_words(compared)),
        Section("flights", "Flights", tables=[flight_table(frame)]),
        Section("accuracy", "Accuracy", tables=[accuracy_table(frame, paper=paper)]),
        Section("axes", "Errors by axis", [], [axis_table(frame, paper=paper)], drawn("fig10")),
        Section("map", "Maps", tables=[map_table(frame, paper=paper)]),
        Section("paths", "Trajectories", pictures=drawn("fig9")),
        Section("landings", "Landings", [], landing_tables(frame, paper=paper), drawn("fig12")),
        Section("intruders", "Intruders", tables=[intruder_table(frame)]),
        Section("expected", "As expected", tables=[expectation_table(verdicts)]),
        Section("conditions", "Conditions", condition_words(rows, paper=paper)),
    ]  # fmt: skip
    for section in sections:
        tables = [table for table in section.tables if table.rows]
        section.tables = tables if paper else [part for t in tables for part in narrowed(t)]
    kept = [section for section in sections if section.words or section.tables or section.pictures]
    return Report(title, kept, configuration, paper)


def _pictures(frame: pd.DataFrame, paper: bool) -> list[Picture]:
    """The figures of each of the first conditions, which they name where there are several."""
    conditions = ordered(frame, "condition")
    found: list[Picture] = []
    for condition in conditions[:_MAX_DRAWN]:
        pictures = pictures_of(frame[frame["condition"] == condition])
        for picture in () if paper else pictures:
            picture.title = plain_title(picture.title)
        if len(conditions) > 1:
            label = condition or _UNNAMED
            for picture in pictures:
                picture.name += f"_{as_plain_name(label).replace(' ', '_')}"
                picture.title += f", `{label}`"
        found += pictures
    return found


def summary_words(frame: pd.DataFrame) -> list[str]:
    """The conditions, and the flights that were not successful."""
    conditions = ordered(frame, "condition")
    words = []
    if len(conditions) > 1:
        listed = ", ".join(f"`{name or _UNNAMED}`" for name in conditions)
        words.append(f"{len(conditions)} conditions: {listed}. No figure is over several of them.")
        if len(conditions) > _MAX_DRAWN:
            words.append(f"Drawings are of the first {_MAX_DRAWN} conditions alone.")
    elif "profile" in frame:
        words += [f"Profile: `{name}`." for name in frame["profile"].dropna().unique()]
    rows: list[Row] = frame.to_dict("records")
    lost = [row for row in rows if not is_successful(row)]
    if not lost:
        return [*words, f"All {len(rows)} flights were successful."]
    unmeasured = sum(number(row, "position_error_m.mean") is None for row in lost)
    words.append(
        f"{len(lost)} of {len(rows)} flights were not successful. Their errors up to the loss are "
        "in every figure"
        + (f", but those of {unmeasured} that have no figure at all." if unmeasured else ".")
    )
    words += [
        f"{row['scene']}, `{row['estimator']}`, seed {row['seed']}: {row['outcome']}"
        + " on unsafe ground" * (row["outcome"] == "LANDED")
        + (f" ({row['reason']})" if isinstance(row.get("reason"), str) and row["reason"] else "")
        for row in lost[:_MAX_NAMED]
    ]
    return words + [f"and {len(lost) - _MAX_NAMED} more."] * (len(lost) > _MAX_NAMED)


def condition_words(rows: Sequence[Row], *, paper: bool = True) -> list[str]:
    """Scenes, methods, seeds, revision and the definition of the intervals; the paper's report has
    the parts here."""
    frame = frame_of(rows)
    seeds = {row["seed"] for row in rows}
    winds = sorted({row["wind_kmh"] for row in rows if row.get("wind_kmh") is not None})
    versions = {k: row[k] for row in rows for k in row if k.startswith("versions.") and row[k]}
    methods = ", ".join(f"`{name}`" for name in ordered(frame, "estimator"))
    lines = [
        f"Scenes: {', '.join(ordered(frame, 'scene'))}. Methods: {methods}. "
        f"{_seeds(seeds)}. "
        f"Mean wind: {', '.join(f'{wind:g}' for wind in winds) or 'not recorded'} km/h.",
        *(part_words(rows) if paper else ()),
        *_revision_words(row.get("git_revision") for row in rows),
        f"Intervals: {INTERVAL}, 10 000 seeded resamples; percentages of flights: Wilson's score "
        "interval. Fewer than three flights have no interval.",
        *([f"Published figures: {published.SOURCE}."] if paper else []),
    ]
    if versions:
        named = (f"{key.partition('.')[2]} {value}" for key, value in versions.items())
        lines.append(f"Versions: {', '.join(named)}.")
    return lines


def _seeds(seeds: set[int]) -> str:
    if len(seeds) == 1:
        return f"Seed {min(seeds)}"
    return f"{len(seeds)} seeds from {min(seeds)} to {max(seeds)}"


def part_words(rows: Sequence[Row]) -> list[str]:
    """The parts beside the estimator that flew and are not those by default, in a line."""
    sentences = []
    for kind in PartNames.model_fields:
        names = sorted({row[f"parts.{kind}"] for row in rows if row.get(f"parts.{kind}")})
        others = len(names) and any(not row.get(f"parts.{kind}") for row in rows)
        if names:
            told = ", ".join(f"`{name}`" for name in names)
            sentences.append(f"{kind.capitalize()}: {told}{', and that by default' * others}.")
    return [" ".join(sentences)] if sentences else []


def _revision_words(recorded: Iterable[str | None]) -> list[str]:
    """The revisions, and the remedy for results without one."""
    found = list(recorded)
    revisions = sorted({revision for revision in found if revision})
    lines = []
    if revisions:
        names = ", ".join(f"`{revision}`" for revision in revisions)
        lines.append(f"Git revision{'s' * (len(revisions) > 1)}: {names}.")
    if len(revisions) > 1:
        lines.append("The flights are of more than one revision: compare with care.")
    if None in found:
        lines.append(
            f"Git revision of {found.count(None)} flights not recorded: {UNRECORDED_REMEDY}."
        )
    return lines


def page(report: Report) -> str:
    """One self-contained HTML file: nothing is loaded from anywhere."""
    return _rendered("report.html.j2", report, code=_code)


def markdown(report: Report) -> str:
    """The report as Markdown; figures are linked as ``figures/NAME.svg``."""
    return _rendered("report.md.j2", report, text=markdown_text, cell=markdown_cell, fenced=fenced)


def _rendered(template: str, report: Report, **filters: Any) -> str:
    import jinja2

    source = resources.files("touchdown.experiments.reporting").joinpath(template)
    environment = jinja2.Environment(
        autoescape=template.endswith(".html.j2"),
        undefined=jinja2.StrictUndefined,
        trim_blocks=template.endswith(".md.j2"),
        lstrip_blocks=template.endswith(".md.j2"),
        keep_trailing_newline=True,
    )
    environment.filters.update(filters)
    environment.finalize = _shown
    return environment.from_string(source.read_text(encoding="utf-8")).render(report=report)


def _code(text: str) -> Any:
    """Escaped text with `names` as code elements."""
    import markupsafe

    escaped = html.escape(visible(text), quote=False)
    return markupsafe.Markup(re.sub(r"`([^`]*)`", r"<code>\1</code>", escaped))


def _shown(value: Any) -> Any:
    """Text of outside without control characters; what is markup already stays."""
    import markupsafe

    is_text = isinstance(value, str) and not isinstance(value, markupsafe.Markup)
    return visible(value, keep="\n\t") if is_text else value


def as_json(report: Report, rows: Sequence[Row]) -> dict[str, Any]:
    """Returns the notes, and the numbers of the tables."""
    outcomes = frame_of(rows)["outcome"].value_counts() if rows else {}
    return {
        "title": report.title,
        "flights": len(rows),
        "outcomes": {name: int(count) for name, count in outcomes.items()},
        "words": {s.key: s.words for s in report.sections if s.words},
        "tables": {t.key: t.numbers for s in report.sections for t in s.tables if t.numbers},
    }


def write_report(report: Report, rows: Sequence[Row], out: Path) -> dict[str, Path]:
    """Writes ``report.md``, ``report.html``, ``report.json`` and ``figures/`` into ``out``, which
    appears complete where it is new. Raises UsageError where a file there is of no report, or
    where ``out`` cannot be written."""
    try:
        if out.exists():
            _check_replaceable(out)
            _write(report, rows, out)
        else:
            with run_directory(out, own=()) as partial:
                _write(report, rows, partial)
    except OSError as error:
        raise UsageError(f"--out {out}: cannot be written: {error.strerror}") from error
    return {kind: out / name for kind, name in _FILES.items()}


def _check_replaceable(out: Path) -> None:
    there = [name for name in _FILES.values() if (out / name).exists()]
    with contextlib.suppress(OSError, ValueError):
        if {"title", "flights", "words", "tables"} <= read_object(out / _FILES["json"]).keys():
            return
    if there:
        raise UsageError(
            f"--out {out}: holds '{there[0]}', which is of no report; name another directory"
        )


def _write(report: Report, rows: Sequence[Row], out: Path) -> None:
    (out / "figures").mkdir(parents=True, exist_ok=True)
    for section in report.sections:
        for picture in section.pictures:
            write_text(out / "figures" / f"{picture.name}.svg", picture.svg)
    texts = {  # the first marks the others as of a report
        "json": json.dumps(as_json(report, rows), indent=2) + "\n",
        "markdown": markdown(report),
        "html": page(report),
    }
    for kind, text in texts.items():
        write_text(out / _FILES[kind], text)
