"""README and the results pages: their tables, written between markers that nobody else writes
between, from the rows of `edition`."""

import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.run_directory import write_text
from touchdown.experiments.io.untrusted import read_object
from touchdown.experiments.reporting.flights import frame_of
from touchdown.experiments.reproduce.parts import REPORT
from touchdown.experiments.results_tables import tables
from touchdown.experiments.results_tables.edition import (
    PAPER,
    ROOT,
    FlightSet,
    Record,
    merged,
    read_record,
    record_of,
    write_record,
)


@dataclass(frozen=True, slots=True)
class Block:
    """A part of a page: ``<!-- results NAME -->`` to ``<!-- end of results -->``. ``lines`` makes
    it of the frames of ``sets``, or of the figures in ``file``; ``pictures``: the way from the page
    to the folder of the picture below it, empty without one."""

    page: str
    name: str
    sets: tuple[str, ...]
    lines: Callable[..., Sequence[str]]
    pictures: str = ""
    file: str = ""

    def text(self, record: Record, root: Path) -> str:
        """The lines between the markers."""
        if self.file:
            return self._measured(root)
        if missing := [name for name in self.sets if name not in record]:
            return f"Not flown yet: `make results` flies `configs/{missing[0]}.toml`."
        lines = self.lines(*(frame_of(record[name]["rows"]) for name in self.sets))
        key = "landing.roughness_m"
        if self.pictures and any(key in row for row in record["landing"]["rows"]):
            lines = [*lines, "", f"![{_GROUND_TITLE}]({self.pictures}/{_GROUND})"]
        return "\n".join([*lines, "", _origin(self.sets, record)])

    def _measured(self, root: Path) -> str:
        if not (root / self.file).is_file():
            return f"Not measured yet: `touchdown results --part {self.name}` does."
        tree = read_object(root / self.file)
        origin = f"*Measured at revision `{tree['revision'][:12]}`, {tree['date']}.*"
        return "\n".join([*self.lines(tree["figures"]), "", origin])


@dataclass(frozen=True, slots=True)
class Tunings(Block):
    """The block of the files of `touchdown bench tune` in the folder ``file``."""

    def text(self, _record: Record, root: Path) -> str:
        found = [read_object(file) for file in sorted((root / self.file).glob("*.json"))]
        revisions = dict.fromkeys(f"`{tree['revision'][:12]}`" for tree in found)
        origin = f"*By `touchdown bench tune`, at {', '.join(revisions)}.*"
        return "\n".join([*self.lines(found), "", origin])


def _origin(names: Sequence[str], record: Record) -> str:
    """The revision and the plans of the flights of a table."""
    entries = [record[name] for name in names]
    plans = "`make results`: " + ", ".join(f"`configs/{name}.toml`" for name in names)
    hours = sum(entry["core_hours"] for entry in entries)
    return (
        f"*Flown at revision `{entries[0]['revision'][:12]}`, "
        f"{max(entry['date'] for entry in entries)}, by {plans}, {hours:.1f} core-hours.*"
    )


_FIELD = "docs/results/field.md"
BLOCKS = (
    Block("README.md", "summary", ("landing", "positioning"), tables.summary, "docs/images"),
    Block(_FIELD, "landings", ("landing",), tables.landings, "../images"),
    Block(_FIELD, "paper", ("landing",), tables.paper_landings),
    Block(_FIELD, "positioning", ("positioning", "landing"), tables.positioning),
    Block(_FIELD, "levelness", ("positioning", "landing"), tables.levelness),
    Block(_FIELD, "ideal", ("landing",), partial(tables.landings, profile="ideal")),
    Block(_FIELD, "zou2024", ("zou2024",), tables.conditions),
    Block(_FIELD, "one sensor", ("one_sensor",), tables.conditions),
    Block(_FIELD, "light", ("field_light",), tables.conditions),
    Block(_FIELD, "harsh", ("field_harsh",), tables.conditions),
    Block(_FIELD, "wind", ("wind",), tables.conditions),
    Block(_FIELD, "pairs", ("short", "landing"), tables.pairs),
    Block(_FIELD, "cost", (), tables.cost, file="docs/results/cost.json"),
    Tunings("docs/results/estimators.md", "tuning", (), tables.tunings, file="docs/results/tuning"),
    Block("docs/results/estimators.md", "limit", (), tables.limit, file="docs/results/limit.json"),
    Block("docs/results/beliefs.md", "beliefs", ("wrong_beliefs",), tables.beliefs),
)
_PART = r"(<!-- results {name} -->\n).*?(\n<!-- end of results -->)"
_GROUND = "chosen_ground.svg"
_GROUND_TITLE = "True ground at the touchdowns: slope of the plane within 0.5 m, deviation from it"
_REPORT = "docs/results/reproduction"


def written(text: str, page: str, record: Record, root: Path = ROOT) -> str:
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
        text = f"{before}{start}{block.text(record, root)}{end}{after}"
    return text


def write_pages(
    sets: Sequence[FlightSet], out: Path, measured: Sequence[Path] = (), root: Path = ROOT
) -> list[Path]:
    """Writes the rows of sets that are flown below ``out``, the files ``measured``, the blocks of
    all pages, and the report of the reproduction where it is among the sets. Returns the files;
    raises UsageError, before any page is written, where rows or markers are missing, or where the
    rows would be of several revisions."""
    record = merged(read_record(root), {found.name: record_of(found, out) for found in sets})
    copies = [root / "docs" / "results" / file.name for file in measured]
    for file, copy in zip(measured, copies, strict=True):
        write_text(copy, file.read_text(encoding="utf-8"))
    texts = {
        root / page: written((root / page).read_text(encoding="utf-8"), page, record, root)
        for page in dict.fromkeys(block.page for block in BLOCKS)
    }
    files = [write_record(record, root), *copies]
    if any(found.name == "landing" for found in sets):
        picture = tables.chosen_ground(frame_of(record["landing"]["rows"]))
        texts[root / "docs" / "images" / _GROUND] = picture.svg
    for file, text in texts.items():
        write_text(file, text)
    if any(found.of_paper for found in sets):
        files += _copied_report(out / PAPER / REPORT, root / _REPORT)
    return [*files, *texts]


def _copied_report(source: Path, target: Path) -> list[Path]:
    """The report on the paper with its drawn figures; other pages have the renderings. Older
    figures go."""
    shutil.rmtree(target, ignore_errors=True)
    (target / "figures").mkdir(parents=True)
    text, files = (source / "report.md").read_text(encoding="utf-8"), [target / "report.md"]
    for figure in sorted((source / "figures").glob("*.svg")):
        svg = figure.read_text(encoding="utf-8")
        if "data:image" in svg:
            shown = rf"!\[[^\n]*\]\(figures/{re.escape(figure.name)}\)\n\n[^\n]*\n\n"
            text = re.sub(shown, "", text)
        else:
            files.append(target / "figures" / figure.name)
            write_text(files[-1], svg)
    write_text(files[0], text)
    return files
