"""Tables of flights: lines are groups of a frame, columns are figures of the flights of a line."""

import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from numbers import Integral
from typing import Any

import numpy as np
import pandas as pd

from touchdown.experiments.errors import visible
from touchdown.experiments.reporting.flights import ordered, values, values_and_units
from touchdown.experiments.reporting.measures import (
    SET_MARK,
    YES_OR_NO,
    is_marked,
    measure_of,
    setting_notes,
    titled,
)
from touchdown.experiments.reporting.statistics import (
    Estimate,
    clustered_fraction,
    mean_interval,
    variance_interval,
)

MISSING = "–"
ALL_SCENES = "all scenes"
PRINTED = "paper prints"
MAX_COLUMNS = 6
"""of a table that is read without scrolling 900 pixels"""
_NAMES = {"estimator": "method"}
"""Titles of the columns that name a line, where they are not called as those of the rows."""


@dataclass(frozen=True, slots=True)
class Cell:
    """A figure and, smaller, its interval. ``kind``: "", "best", "published" or "name"."""

    text: str
    detail: str = ""
    kind: str = ""

    @property
    def markdown(self) -> str:
        text = (
            f"**{markdown_cell(self.text)}**" if self.kind == "best" else markdown_cell(self.text)
        )
        return f"{text} {markdown_cell(self.detail)}".rstrip()


@dataclass(slots=True)
class Table:
    """``numbers`` are the figures behind the cells, by the names of their line and the key of
    their column, for ``--json``."""

    key: str
    title: str
    header: list[str]
    rows: list[list[Cell]]
    notes: list[str] = field(default_factory=list)
    numbers: dict[str, Any] = field(default_factory=dict)

    @property
    def lines(self) -> list[str]:
        """The Markdown table without title and notes."""
        return markdown_lines(self.header, [[cell.markdown for cell in row] for row in self.rows])


def plain_title(title: str) -> str:
    """A title without the number of the paper's table or figure."""
    found = re.sub(r"^(Table|Fig\.) [^:]*: ", "", title)
    return found[:1].upper() + found[1:]


def narrowed(table: Table) -> list[Table]:
    """The table as several of at most `MAX_COLUMNS` columns, which all name their lines."""
    names = sum(cell.kind == "name" for cell in table.rows[0]) if table.rows else 0
    room, width = MAX_COLUMNS - names, len(table.header)
    if width <= MAX_COLUMNS:
        return [table]
    parts = []
    for start in range(names, width, room):
        own = [*range(names), *range(start, min(start + room, width))]
        rows = [[row[n] for n in own] for row in table.rows]
        parts.append(replace(table, header=[table.header[n] for n in own], rows=rows, notes=[]))
    parts[-1].notes = table.notes
    for number, part in enumerate(parts[1:], start=2):
        part.key, part.title, part.numbers = f"{table.key}_{number}", "", {}
    return parts


def markdown_lines(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """A Markdown table of texts whose cells are Markdown already."""
    head = f"| {' | '.join(map(markdown_cell, header))} |"
    return [head, "|" + "---|" * len(header), *(f"| {' | '.join(row)} |" for row in rows)]


@dataclass(frozen=True, kw_only=True, slots=True)
class Column:
    """A column of a table. ``of``: makes the figure of a line of its flights; ``column``: of the
    rows, which tells whether the figure is set; ``plain``: title without symbols; ``printed``: the
    paper's figure by method and scene; ``best``: the smallest of several methods is marked."""

    key: str
    title: str
    of: Callable[[pd.DataFrame], Any]
    column: str = ""
    plain: str = ""
    scale: float = 1.0
    printed: Callable[[str, str], Any] | None = None
    best: bool = False


def _of_measure(column: str, kind: str, title: str, of: Callable[..., Any], **more: Any) -> Column:
    found = measure_of(column)
    name, plain = (
        titled(title or f"{kind} {own}".strip(), column) for own in (found.title, found.plain)
    )
    key = f"{column}.{kind}" if kind else column
    return Column(key=key, title=name, of=of, column=column, plain=plain, scale=found.scale, **more)


def mean(column: str, title: str = "", **more: Any) -> Column:
    """Mean of a column of the rows with its interval, Wilson's of a share of flights."""

    def of(own: pd.DataFrame) -> Estimate | None:
        found, units = values_and_units(own, column)
        if column in YES_OR_NO and len(found):
            return clustered_fraction(found, units)
        return mean_interval(found, units)

    return _of_measure(column, "", title, of, **more)


def largest(column: str, title: str = "", **more: Any) -> Column:
    """Largest value of a column of the rows."""

    def of(own: pd.DataFrame) -> float | None:
        found = values(own, column)
        return float(found.max()) if found.size else None

    return _of_measure(column, "largest", title, of, **more)


def median(column: str) -> Column:
    """Median of a column of the rows."""

    def of(own: pd.DataFrame) -> float | None:
        found = values(own, column)
        return float(np.median(found)) if found.size else None

    return _of_measure(column, "median", "", of)


def value(column: str, title: str = "") -> Column:
    """The value of the one flight of a line."""
    return _of_measure(
        column, "", title, lambda own: own[column].iloc[0] if column in own else None
    )


def pooled_variance(column: str, means: str, **more: Any) -> Column:
    """Variance of all samples of all flights, of the variances in ``column`` and ``means``."""

    def of(own: pd.DataFrame) -> Estimate | None:
        both = [column, means]
        if not set(both) <= set(own.columns):
            return None
        known = own.dropna(subset=both)
        return variance_interval(known[means], known[column], known["unit"])

    return _of_measure(column, "", "", of, **more)


def count(title: str, hits: Callable[[pd.DataFrame], Any] = len) -> Column:
    """Number of flights, or of those for which ``hits`` gives True."""
    return Column(key=title, title=title, of=lambda own: int(np.sum(hits(own))))


INDEPENDENT = Column(key="independent", title="independent", of=lambda own: own["unit"].nunique())
"""Number of independent units among the flights of a line; left out where all of them are."""


def fraction(title: str, hits: Callable[[pd.DataFrame], Any]) -> Column:
    """Percentage of the flights for which ``hits`` gives True, with Wilson's interval."""

    def of(own: pd.DataFrame) -> Estimate | None:
        return clustered_fraction(hits(own), own["unit"]) if len(own) else None

    return Column(key=title, title=f"{title} (%)", of=of, scale=100.0)


def counts(title: str, column: str, leave: str = "") -> Column:
    """Number of flights by the text of a column, but for ``leave``: "LANDED 3, TIPPED 1"."""

    def of(own: pd.DataFrame) -> str | None:
        if column not in own:
            return None
        found = own[column].dropna()
        number = found[found != leave].value_counts()  # the most frequent first
        return ", ".join(f"{name} {n}" for name, n in number.items()) or None

    return Column(key=title, title=title, of=of)


def groups(
    frame: pd.DataFrame, by: Sequence[str]
) -> Iterator[tuple[tuple[str, ...], pd.DataFrame]]:
    """Names and flights of each line: nested groups by the columns ``by`` in their usual order, and
    after several scenes all of them together."""
    if not by:
        yield (), frame
        return
    first, *rest = by
    found = [(name, frame[frame[first] == name]) for name in ordered(frame, first)]
    if first == "scene" and len(found) > 1:
        found.append((ALL_SCENES, frame))
    for name, own in found:
        for names, flights in groups(own, rest):
            yield (name, *names), flights


BY_CELL = ("condition", "estimator", "scene")


def make_table(
    frame: pd.DataFrame,
    key: str,
    title: str,
    columns: Sequence[Column],
    by: Sequence[str] = BY_CELL,
    *,
    notes: Sequence[str] = (),
    names: Sequence[str] = (),
    plain: bool = False,
) -> Table:
    """Returns a table with a line for each group of flights. A single condition is not named, and
    columns without any figure are left out. ``names``: titles of the columns that name a line;
    ``plain``: without the paper's figures, symbols and numbers of tables, and without the name of a
    single method or scene."""
    shown = [name for name in by if name != "condition" or frame["condition"].nunique() > 1]
    lines = list(groups(frame, shown))
    every = {column.key: [column.of(own) for _, own in lines] for column in columns}
    if every.get(INDEPENDENT.key) == [len(own) for _, own in lines]:
        del every[INDEPENDENT.key]
    kept = [column for column in columns if any(map(_is_known, every.get(column.key, ())))]
    told = [n for n, name in enumerate(shown) if not plain or frame[name].nunique() > 1]
    told = told or list(range(len(shown)))[-1:]
    cells = [[_name(n[at], shown[at]) for at in told] for n, _ in lines]
    header = list(names) or [_NAMES.get(shown[at], shown[at]) for at in told]
    for column in kept:
        header.append((plain and column.plain) or column.title)
        best = set()
        if column.best and "estimator" in shown:
            best = _best(shown, lines, every[column.key], column)
        for line, (_, own) in enumerate(lines):
            marked = is_marked(column.column, own["estimator"].unique())
            kind = "best" if line in best else ""
            cells[line].append(
                cell(every[column.key][line], scale=column.scale, kind=kind, marked=marked)
            )
        if column.printed is not None and not plain:
            _add_printed(column, header, cells, shown, lines)
    title = plain_title(title) if plain else title
    table = Table(key, title, header, cells if kept else [])
    for line, (own_names, _) in enumerate(lines):
        numbers = table.numbers
        for name in own_names:
            numbers = numbers.setdefault(name or "all", {})
        numbers |= {c.key: _as_json(found) for c in kept if _is_known(found := every[c.key][line])}
    settings = setting_notes((column.column for column in kept), frame["estimator"].unique())
    table.notes = [*notes, *settings]
    return table


_Line = tuple[tuple[str, ...], pd.DataFrame]


def _best(
    by: Sequence[str], lines: Sequence[_Line], figures: Sequence[Any], column: Column
) -> set[int]:
    """The lines of the smallest figure among several methods in all else equal; the oracle and
    methods whose figures are set do not compete."""
    at = by.index("estimator")
    rivals: dict[tuple[str, ...], list[int]] = {}
    for line, (names, _) in enumerate(lines):
        measured = _is_known(figures[line]) and not is_marked(column.column, [names[at]])
        if measured and names[at] != "oracle":
            rivals.setdefault(names[:at] + names[at + 1 :], []).append(line)

    def size(line: int) -> float:
        return float(getattr(figures[line], "value", figures[line]))

    return {min(own, key=size) for own in rivals.values() if len(own) > 1}


def _add_printed(
    column: Column,
    header: list[str],
    cells: Sequence[list[Cell]],
    by: Sequence[str],
    lines: Sequence[_Line],
) -> None:
    """Adds the paper's figures beside those of ``column``, where it prints any of them."""
    assert column.printed is not None
    found = []
    for names, own in lines:
        named = dict(zip(by, names, strict=True))
        method = named.get("estimator", own["estimator"].iloc[0])
        is_free = not is_marked(column.column, [method])
        found.append(column.printed(method, named.get("scene", "")) if is_free else None)
    if any(figure is not None for figure in found):
        header.append(PRINTED)
        for line, figure in zip(cells, found, strict=True):
            text = f"{figure:g}" if isinstance(figure, float) else figure or MISSING
            line.append(Cell(text, kind="published"))


def cell(figure: Any, *, scale: float = 1.0, kind: str = "", marked: bool = False) -> Cell:
    """The cell of a figure; ``marked``: the configuration sets it."""
    if not _is_known(figure):
        return Cell(MISSING)
    mark = SET_MARK if marked else ""
    if isinstance(figure, Estimate):
        detail = f"{interval_text(figure, scale)} {mark}".strip()
        return Cell(digits(scale * figure.value), detail, kind)
    if isinstance(figure, bool | np.bool_):
        return Cell("yes" if figure else "no")
    if isinstance(figure, str | Integral):
        return Cell(str(figure), mark, kind)
    return Cell(digits(scale * float(figure)), mark, kind)


def name_cell(name: str) -> Cell:
    return Cell(f"`{name}`", kind="name")


def _name(name: str, kind: str) -> Cell:
    """The cell of a name; scenes, methods and conditions are set as code."""
    is_code = kind in BY_CELL and name not in (ALL_SCENES, "")
    return name_cell(name) if is_code else Cell(name or MISSING, kind="name")


def digits(value: float) -> str:
    """Three figures, at most four decimals; powers of ten below that, 0 below a millionth."""
    size = abs(value)
    for limit, decimals in ((100.0, 0), (10.0, 1), (1.0, 2), (0.01, 3)):
        if size >= limit:
            return f"{value:.{decimals}f}"
    if size >= 5e-5:
        return f"{value:.4f}"
    return f"{value:.0e}" if size >= 1e-6 else "0"


def interval_text(estimate: Estimate, scale: float = 1.0) -> str:
    """ "[low, high]"; empty without an interval."""
    if estimate.low is None or estimate.high is None:
        return ""
    return f"[{digits(scale * estimate.low)}, {digits(scale * estimate.high)}]"


def with_notes(table: Table) -> list[str]:
    """Lines of Markdown: the table and its notes as a list."""
    return [*table.lines, "", *(f"- {markdown_text(note)}" for note in table.notes)]


def _is_known(figure: Any) -> bool:
    return figure is not None and not (isinstance(figure, float) and math.isnan(figure))


def _as_json(figure: Any) -> Any:
    if isinstance(figure, Estimate):
        return figure.as_json()
    return figure.item() if isinstance(figure, np.generic) else figure


# Names of scenes, methods and files come from outside: nothing of them but `code` becomes markup.

_MARKUP = re.compile(
    r"[\\*~$]"  # escapes, emphasis, strike-through, formulas
    r"|<(?=[A-Za-z/!?])"  # tags, comments, addresses
    r"|&(?=#?\w+;)"  # entities
    r"|\](?=[(\[:])"  # links, images, definitions
    r"|(?<![^\W_])_|_(?![^\W_])"  # emphasis, but within words
)


def markdown_text(text: str) -> str:
    """One line of text whose `code` stays code; all other markup in it is escaped."""
    line = visible(text)
    parts = line.split("`")
    if len(parts) % 2 == 0 or "" in parts[1::2]:  # stray backticks are no code
        return _begun(_plain(line).replace("`", "\\`"))
    shown = [part if n % 2 else _plain(part) for n, part in enumerate(parts)]
    return _begun("`".join(shown))


def markdown_cell(text: str) -> str:
    """`markdown_text` in the cell of a table."""
    return markdown_text(text).replace("|", "\\|")


def fenced(text: str) -> list[str]:
    """Lines of a block of code, in a fence that the text cannot close."""
    longest = max((len(run) for run in re.findall(r"`+", text)), default=0)
    fence = "`" * max(3, longest + 1)
    return [fence, visible(text.strip(), keep="\n\t"), fence]


def _plain(text: str) -> str:
    return _MARKUP.sub(lambda found: f"\\{found[0]}", text)


def _begun(line: str) -> str:
    """A line that begins no list, heading, quotation or table."""
    number = re.match(r"(\s*\d+)([.)])(?=\s|$)", line)
    if number:
        return f"{number[1]}\\{line[len(number[1]) :]}"
    return re.sub(r"^(\s*)(?=[-+=#>])", r"\1\\", line)
