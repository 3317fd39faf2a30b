"""The report of a campaign: text, tables and figures, as Markdown, HTML and JSON."""

from __future__ import annotations

import contextlib
import html
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any

from touchdown.experiments.campaign.expectations import Verdict
from touchdown.experiments.campaign.results_table import is_successful
from touchdown.experiments.errors import UsageError, visible
from touchdown.experiments.io.provenance import UNRECORDED_REMEDY
from touchdown.experiments.io.results import PartNames
from touchdown.experiments.io.run_directory import run_directory, write_text
from touchdown.experiments.io.untrusted import as_plain_name, read_object
from touchdown.experiments.reporting import published
from touchdown.experiments.reporting.conditions import (
    by_condition,
    condition_table,
    label_conditions,
)
from touchdown.experiments.reporting.drift import add_errors_by_distance, distance_tables
from touchdown.experiments.reporting.figures import Picture, all_pictures
from touchdown.experiments.reporting.flights import (
    Row,
    add_path_deviations,
    flies_paper_methods,
    methods_of,
    recorded_revision,
    scenes_of,
)
from touchdown.experiments.reporting.landing_figure import landing_pictures
from touchdown.experiments.reporting.landings import landing_sentences, landing_tables
from touchdown.experiments.reporting.markdown_text import fenced, markdown_cell, markdown_text
from touchdown.experiments.reporting.narrative import (
    leading_sentences,
    published_sentences,
    summary_sentences,
)
from touchdown.experiments.reporting.queries import outcome_counts
from touchdown.experiments.reporting.statistics import INTERVAL
from touchdown.experiments.reporting.tables import (
    Cell,
    Table,
    axis_tables,
    map_tables,
    nees_table,
    outcome_table,
    time_table,
    trajectory_tables,
)

_FILES = {"markdown": "report.md", "html": "report.html", "json": "report.json"}


@dataclass(frozen=True, slots=True)
class Section:
    key: str
    title: str
    words: list[str]
    tables: list[Table]
    pictures: list[Picture]


@dataclass(frozen=True, slots=True)
class Report:
    title: str
    tiles: list[tuple[str, str]]
    sections: list[Section]
    configuration: str
    """text of the campaign's file, empty without one"""


def make_report(
    rows: list[dict[str, Any]],
    *,
    title: str,
    configuration: str = "",
    verdicts: Sequence[Verdict] = (),
    first: str = "",
) -> Report:
    """Returns the report of the flights ``rows`` (see `flights.load_flights`); ``verdicts``: on the
    expectations of the campaign; ``first``: its first condition (see `condition_table`). Tables,
    figures and sentences are made from the flights of one condition each, which they name where
    there are several."""
    add_path_deviations(rows)
    add_errors_by_distance(rows)
    label_conditions(rows)
    conditions = by_condition(rows, first)
    parts = [
        _of_condition(own, name, several=len(conditions) > 1, drawn=number < _MOST_DRAWN)
        for number, (name, own) in enumerate(conditions.items())
    ]
    found = {sections[0].key: _joined(sections) for sections in zip(*parts, strict=True)}
    found["summary"].words[:0] = _condition_names(rows, list(conditions))
    found["paths"].words.extend(_path_sentences(rows))
    if flies_paper_methods(rows):
        found["axes"].words.extend(_AXIS_WORDS)
    found |= {
        section.key: section
        for section in (
            Section("flights", "Flights by condition", [], [condition_table(rows, first)], []),
            Section("expected", "As expected", *expectation_parts(verdicts), []),
            Section("conditions", "Conditions", condition_sentences(rows), [], []),
        )
    }
    kept = [found[key] for key in _ORDER if _is_shown(found[key])]
    return Report(title, tiles(rows), kept, configuration)


def _of_condition(rows: Sequence[Row], name: str, *, several: bool, drawn: bool) -> list[Section]:
    """The sections over flights of the condition ``name``, which they state where there are
    ``several``."""
    pictures = [*all_pictures(rows), *landing_pictures(rows)] if drawn else []

    def named(*names: str) -> list[Picture]:
        return [picture for picture in pictures if picture.name in names]

    consistency, time = nees_table(rows), time_table(rows)
    sections = [
        Section("summary", "Summary", summary_sentences(rows) + leading_sentences(rows), [], []),
        Section("published", "Beside the paper", published_sentences(rows), [], []),
        Section("accuracy", "Accuracy", [], trajectory_tables(rows) + distance_tables(rows), []),
        Section("axes", "Errors by axis", [], axis_tables(rows),
                named("fig10a", "fig10b", "fig10_estimate")),
        Section("map", "Maps", [], map_tables(rows), []),
        Section("paths", "Trajectories", [], [], named("fig9a", "fig9b")),
        Section("landings", "Landings", landing_sentences(rows), landing_tables(rows),
                named("fig12")),
        Section("outcomes", "Outcomes", [], [outcome_table(rows)], []),
        Section("consistency", "Consistency", [], [consistency] if consistency else [], []),
        Section("time", "Time", [], [time] if time else [], []),
    ]  # fmt: skip
    return [_stating(section, name) for section in sections] if several else sections


def _stating(section: Section, condition: str) -> Section:
    """``section`` with the condition in each sentence and title, and in each key and file name."""
    label = f"`{condition or UNNAMED}`"
    name = as_plain_name(condition or UNNAMED).replace(" ", "_")
    return Section(
        section.key,
        section.title,
        [f"{label}: {line}" for line in section.words],
        [
            replace(table, key=f"{table.key}@{condition}", title=f"{table.title}, {label}")
            for table in section.tables
        ],
        [
            replace(picture, name=f"{picture.name}_{name}", title=f"{picture.title}, {label}")
            for picture in section.pictures
        ],
    )


def _joined(sections: Sequence[Section]) -> Section:
    """One section of those of all conditions."""
    return Section(
        sections[0].key,
        sections[0].title,
        [line for section in sections for line in section.words],
        [table for section in sections for table in section.tables],
        [picture for section in sections for picture in section.pictures],
    )


def _condition_names(rows: Sequence[Row], names: Sequence[str]) -> list[str]:
    """The condition that all figures are of, or those that they are given by."""
    if len(names) == 1:
        profiles = sorted({str(row["profile"]) for row in rows if row.get("profile")})
        return [f"All flights are in profile `{profile}`." for profile in profiles[:1]]
    listed = ", ".join(f"`{name or UNNAMED}`" for name in names)
    lines = [f"{len(names)} conditions: {listed}. No figure is over flights of several of them."]
    if len(names) > _MOST_DRAWN:
        lines.append(f"Drawings are of the first {_MOST_DRAWN} conditions alone.")
    return lines


UNNAMED = "unnamed condition"
_MOST_DRAWN = 4
"""conditions with drawings of their own"""
_ORDER = (
    "summary", "published", "flights", "accuracy", "axes", "map", "paths", "landings", "outcomes",
    "expected", "consistency", "time", "conditions",
)  # fmt: skip


def _is_shown(section: Section) -> bool:
    if section.tables or section.pictures or section.key in _ALWAYS:
        return True
    return section.key in _TEXTS and bool(section.words)


def expectation_parts(verdicts: Sequence[Verdict]) -> tuple[list[str], list[Table]]:
    """Sentences on the unexpected runs, and a table with a row per expectation."""
    words = [
        f"`{run_id}`: {reason}." for v in verdicts for run_id, reason in v.failures.items()
    ]  # fmt: skip
    if not verdicts:
        return words, []
    rows = [
        [
            Cell(verdict.name, kind="name"),
            Cell(verdict.expected),
            Cell(", ".join(f"{name} {n}" for name, n in sorted(verdict.outcomes.items()))),
            Cell("–" if verdict.largest_error_m is None else f"{verdict.largest_error_m:.2f}"),
            Cell(verdict.word),
        ]
        for verdict in verdicts
    ]
    header = ["runs", "expected", "outcomes", "largest error, m", "verdict"]
    return words, [Table("expected", "Expectations and outcomes", header, rows)]


_ALWAYS = ("summary", "conditions")
_TEXTS = ("published", "expected")
_AXIS_WORDS = ["The paper shows its Fig. 10 without numbers, so none are compared."]


def _path_sentences(rows: Sequence[Row]) -> list[str]:
    if any(row["mode"] == "land" for row in rows):
        return []
    return ["No flight was to land: Fig. 9 b, the landing trajectories, is left out."]


def condition_sentences(rows: Sequence[Row]) -> list[str]:
    """Scenes, methods, seeds, revision and the definition of the intervals."""
    seeds = sorted({row["seed"] for row in rows})
    winds = sorted({row["wind_kmh"] for row in rows if row.get("wind_kmh") is not None})
    recorded = [recorded_revision(row) for row in rows]
    revisions = sorted({revision for revision in recorded if revision})
    unrecorded = recorded.count(None)
    versions = {k: row[k] for row in rows for k in row if k.startswith("versions.") and row[k]}
    lines = [
        f"Scenes: {', '.join(scenes_of(rows))}. "
        f"Methods: {', '.join(f'`{m}`' for m in methods_of(rows))}. Seeds: {_ranges(seeds)}. "
        f"Mean wind: {', '.join(f'{wind:g}' for wind in winds) or 'not recorded'} km/h.",
        _revision_text(revisions, unrecorded),
        f"Intervals: {INTERVAL}, 10 000 seeded resamples; shares: Wilson's score interval. "
        "A single flight has no interval.",
        f"Published figures: {published.SOURCE}.",
    ]
    if len(revisions) > 1:
        lines.insert(2, "The flights are of more than one revision: compare with care.")
    if versions:
        named = (f"{key.partition('.')[2]} {value}" for key, value in versions.items())
        lines.insert(2, f"Versions: {', '.join(named)}.")
    return [lines[0], *part_sentences(rows), *lines[1:]]


def part_sentences(rows: Sequence[Row]) -> list[str]:
    """The parts beside the estimator that flew and are not those by default, a sentence each."""
    sentences = []
    for kind in PartNames.model_fields:
        names = sorted({row[f"parts.{kind}"] for row in rows if row.get(f"parts.{kind}")})
        others = len(names) and any(not row.get(f"parts.{kind}") for row in rows)
        if names:
            told = ", ".join(f"`{name}`" for name in names)
            sentences.append(f"{kind.capitalize()}: {told}{', and that by default' * others}.")
    return [" ".join(sentences)] if sentences else []


def _revision_text(revisions: Sequence[str], unrecorded: int) -> str:
    """The revisions, and the remedy for results without one."""
    parts = []
    if revisions:
        names = ", ".join(f"`{revision}`" for revision in revisions)
        parts.append(f"Git revision{'s' * (len(revisions) > 1)}: {names}.")
    if unrecorded:
        parts.append(f"Git revision of {unrecorded} flights not recorded: {UNRECORDED_REMEDY}.")
    return " ".join(parts)


def _ranges(seeds: Sequence[int]) -> str:
    """Returns consecutive seeds as ranges: "0–2, 5" for 0, 1, 2, 5."""
    parts: list[list[int]] = []
    for seed in seeds:
        if parts and seed == parts[-1][-1] + 1:
            parts[-1].append(seed)
        else:
            parts.append([seed])
    return ", ".join(f"{p[0]}–{p[-1]}" if len(p) > 2 else ", ".join(map(str, p)) for p in parts)


def tiles(rows: Sequence[Row]) -> list[tuple[str, str]]:
    """The figures at the head of the page."""
    conditions = len(by_condition(rows))
    successful = f"{sum(is_successful(row) for row in rows)} of {len(rows)}"
    return [
        ("flights", str(len(rows))),
        ("conditions", str(conditions)) if conditions > 1 else ("successful", successful),
        ("scenes", str(len(scenes_of(rows)))),
        ("methods", str(len(methods_of(rows)))),
        ("seeds", str(len({row["seed"] for row in rows}))),
    ]


# ---------------------------------------------------------------------------------------- Markdown


def markdown(report: Report, pictures_at: str = "figures") -> str:
    """Returns the report as Markdown; figures are linked as ``pictures_at/NAME.svg``."""
    lines = [f"# {markdown_text(report.title)}", ""]
    for section in report.sections:
        lines += [f"## {section.title}", "", *(f"- {markdown_text(w)}" for w in section.words)]
        lines += [""] if section.words else []
        for picture in section.pictures:
            title = markdown_text(picture.title)
            lines += [f"![{title}]({pictures_at}/{picture.name}.svg)", ""]
            lines += [f"*{title}.* {markdown_text(picture.caption)}", ""]
        for table in section.tables:
            lines += [*markdown_table(table), ""]
    if report.configuration:
        lines += ["## Configuration", "", *fenced(report.configuration), ""]
    return "\n".join(lines)


def markdown_table(table: Table) -> list[str]:
    header = " | ".join(map(markdown_cell, table.header))
    lines = [f"**{markdown_text(table.title)}**", "", f"| {header} |"]
    lines.append("|" + "---|" * len(table.header))
    lines += ["| " + " | ".join(_markdown_cell(c) for c in row) + " |" for row in table.rows]
    lines += [""] if table.notes else []
    return lines + [f"- {markdown_text(note)}" for note in table.notes]


def _markdown_cell(cell: Cell) -> str:
    if cell.kind == "best":
        return f"**{markdown_cell(cell.text)}** {markdown_cell(cell.interval)}".rstrip()
    return markdown_cell(cell.plain)


# -------------------------------------------------------------------------------------------- HTML


def page(report: Report) -> str:
    """One self-contained HTML file: nothing is loaded from anywhere."""
    import jinja2

    source = resources.files("touchdown.experiments.reporting").joinpath("report.html.j2")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    environment.filters["code"] = _code
    environment.finalize = _shown
    template = environment.from_string(source.read_text(encoding="utf-8"))
    return template.render(report=report)


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
    """Returns the sentences, and the numbers of the tables."""
    return {
        "title": report.title,
        "flights": len(rows),
        "outcomes": outcome_counts(rows),
        "words": {s.key: s.words for s in report.sections if s.words},
        "tables": {t.key: t.numbers for s in report.sections for t in s.tables if t.numbers},
    }


def write_report(report: Report, rows: Sequence[Row], out: Path) -> dict[str, Path]:
    """Writes ``report.md``, ``report.html``, ``report.json`` and ``figures/`` into ``out``, which
    appears complete where it is new. Raises UsageError where a file there is of no report."""
    if not out.exists():
        with run_directory(out, own=()) as partial:
            return {kind: out / path.name for kind, path in _write(report, rows, partial).items()}
    _check_replaceable(out)
    return _write(report, rows, out)


def _check_replaceable(out: Path) -> None:
    there = [name for name in _FILES.values() if (out / name).exists()]
    with contextlib.suppress(OSError, ValueError):
        if {"title", "flights", "words", "tables"} <= read_object(out / _FILES["json"]).keys():
            return
    if there:
        raise UsageError(
            f"--out {out}: holds '{there[0]}', which is of no report; name another directory"
        )


def _write(report: Report, rows: Sequence[Row], out: Path) -> dict[str, Path]:
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
    return {kind: out / name for kind, name in _FILES.items()}
