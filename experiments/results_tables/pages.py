"""Writing the tables into the pages, between markers that nobody else writes between."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.run_directory import write_text
from touchdown.experiments.reporting.flights import frame_of
from touchdown.experiments.results_tables import tables
from touchdown.experiments.results_tables.record import (
    FILE,
    SHORT,
    Record,
    merged,
    read_record,
    record_of,
    record_text,
)
from touchdown.experiments.results_tables.sets import ROOT, SETS, FlightSet


@dataclass(frozen=True, slots=True)
class Block:
    """A part of a page: ``<!-- results NAME -->`` to ``<!-- end of results -->``. ``sets`` are the
    keys of the sets whose rows ``lines`` takes."""

    page: str
    name: str
    sets: tuple[str, ...]
    lines: Callable[..., Sequence[str]]

    def text(self, record: Record) -> str:
        """The lines between the markers."""
        if any(key not in record for key in self.sets):
            command = next(found.command for found in SETS if found.key == self.sets[0])
            return (
                f"Not flown at a stated revision yet: `{command}` flies it and writes this table."
            )
        flown = [record[key] for key in self.sets]
        lines = self.lines(*(frame_of(entry["rows"]) for entry in flown))
        return "\n".join([*lines, "", _origin(self.sets, record)])


def _origin(keys: Sequence[str], record: Record) -> str:
    """The revision, profile and plan of the flights of a table."""
    entries = [record[key] for key in keys]
    plans = " and ".join(f"`{entry['plan']}`" for entry in entries)
    hours = sum(entry["core_hours"] for entry in entries)
    found = dict.fromkeys(entry["revision"][:12] for entry in entries)
    revisions = "revision" + "s" * (len(found) > 1)
    revisions += " " + " and ".join(f"`{name}`" for name in found)
    profile = keys[0].partition("/")[0]
    return (
        f"*Flown at {revisions} in profile `{profile}`, "
        f"{max(entry['date'] for entry in entries)}: {plans}, by `{entries[0]['command']}`, "
        f"{hours:.2f} core-hours.*"
    )


_FIELD, _IDEAL = "docs/results/field.md", "docs/results/ideal.md"
BLOCKS = (
    Block("README.md", "summary", ("field/landings", "field/positioning"), tables.summary),
    Block(_FIELD, "landings", ("field/landings",), tables.landings),
    Block(_FIELD, "positioning", ("field/positioning", "field/landings"), tables.positioning),
    Block(_FIELD, "levelness", ("field/positioning", "field/landings"), tables.levelness),
    Block(_FIELD, "blind", ("field/blind",), tables.blind),
    Block(_FIELD, "pairs", (f"field/{SHORT}", "field/landings"), tables.pairs),
    Block(_IDEAL, "landings", ("ideal/landings",), tables.landings),
    Block(
        _IDEAL,
        "positioning",
        ("ideal/positioning", "ideal/landings"),
        tables.positioning,
    ),
    Block(
        _IDEAL,
        "levelness",
        ("ideal/positioning", "ideal/landings"),
        tables.levelness,
    ),
)
_PART = r"(<!-- results {name} -->\n).*?(\n<!-- end of results -->)"


def written(text: str, page: str, record: Record) -> str:
    """``text`` of a page with its blocks as ``record`` has them. Raises UsageError where a marker
    is missing."""
    for block in (found for found in BLOCKS if found.page == page):
        parts = re.split(_PART.format(name=block.name), text, flags=re.DOTALL)
        if len(parts) != 4:
            raise UsageError(
                f"{page}: no single part from '<!-- results {block.name} -->' to "
                "'<!-- end of results -->'; restore the markers"
            )
        before, start, end, after = parts
        text = f"{before}{start}{block.text(record)}{end}{after}"
    return text


def write_pages(sets: Sequence[FlightSet], out: Path, root: Path = ROOT) -> list[Path]:
    """Writes the sets that are flown below ``out`` into the file of results, and the blocks of all
    pages. Returns the files; raises UsageError, before any is written, where rows or markers are
    missing, or where a page would be of several revisions."""
    new = {found.key: record_of(found, out / found.key) for found in sets}
    record = merged(read_record(root), new)
    texts = {root / FILE: record_text(record)} | {
        root / page: written((root / page).read_text(encoding="utf-8"), page, record)
        for page in dict.fromkeys(block.page for block in BLOCKS)
    }
    for file, text in texts.items():
        write_text(file, text)
    return list(texts)
