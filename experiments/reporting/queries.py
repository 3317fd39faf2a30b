"""Grouped queries over the rows of a report, as pyarrow group-bys.

A *cell* is a scene with a method. With ``pooled`` the scenes of a method are one group. Numbers of
a group keep the order of the rows, so that equal rows give equal figures to the last bit.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from touchdown.experiments.campaign.results_table import touched_safe_ground
from touchdown.experiments.reporting.flights import Row, number

if TYPE_CHECKING:
    import pyarrow as pa

LANDED = "LANDED"
_METHOD, _SCENE = "estimator", "scene"


class CellKey(NamedTuple):
    """A method and a scene; None for all scenes together."""

    method: str
    scene: str | None = None


class LandingCounts(NamedTuple):
    """Numbers of flights: all, landed, landed on safe ground, and with an unsafe touchdown whatever
    their outcome."""

    flights: int
    landed: int
    landed_safely: int
    unsafe: int


def outcome_counts(rows: Iterable[Row]) -> dict[str, int]:
    """Returns the number of flights by outcome, the most frequent first."""
    import pyarrow as pa

    outcomes = pa.array([row["outcome"] for row in rows], pa.string())
    return _most_frequent_first(
        (found["values"], found["counts"]) for found in outcomes.value_counts().to_pylist()
    )


def outcomes_by_cell(rows: Sequence[Row], *, pooled: bool = False) -> dict[CellKey, dict[str, int]]:
    """Returns `outcome_counts` of every cell."""
    table = _cell_table(rows, outcome=("string", [row["outcome"] for row in rows]))
    counts = _counts_by_cell(table, "outcome", pooled)
    return {key: _most_frequent_first(found.items()) for key, found in counts.items()}


def texts_by_cell(rows: Sequence[Row], column: str) -> dict[CellKey, dict[str, int]]:
    """Returns the number of flights by the text of ``column`` for every cell, in the order of their
    first flights; a missing value is "None"."""
    table = _cell_table(rows, text=("string", [str(row.get(column)) for row in rows]))
    return _counts_by_cell(table, "text", pooled=False)


def numbers_by_cell(
    rows: Sequence[Row], columns: Sequence[str], *, pooled: bool = False
) -> dict[CellKey, tuple[list[float], ...]]:
    """Returns one list of numbers per column for every cell, over the rows with a number in all
    ``columns``; a cell without such a row is left out."""
    aliases = [f"number_{index}" for index in range(len(columns))]
    table = _number_table(rows, columns, aliases).drop_null()
    groups = _groups(table, [(alias, "list") for alias in aliases], pooled)
    return {_key(group): tuple(group[f"{alias}_list"] for alias in aliases) for group in groups}


def largest_by_cell(
    rows: Sequence[Row], columns: Sequence[str], *, pooled: bool = False
) -> dict[CellKey, tuple[float | None, ...]]:
    """Returns the largest number of each column for every cell; None without a number."""
    aliases = [f"number_{index}" for index in range(len(columns))]
    table = _number_table(rows, columns, aliases)
    groups = _groups(table, [(alias, "max") for alias in aliases], pooled)
    return {_key(group): tuple(group[f"{alias}_max"] for alias in aliases) for group in groups}


def landings_by_cell(rows: Sequence[Row], *, pooled: bool = False) -> dict[CellKey, LandingCounts]:
    """Returns the counts of landings of every cell."""
    landed = [row["outcome"] == LANDED for row in rows]
    safe = [touched_safe_ground(row) for row in rows]
    columns = {
        "landed": landed,
        "landed_safely": [a and b is True for a, b in zip(landed, safe, strict=True)],
        "unsafe": [found is False for found in safe],
    }
    table = _cell_table(rows, **{name: ("bool", found) for name, found in columns.items()})
    groups = _groups(table, [([], "count_all"), *((name, "sum") for name in columns)], pooled)
    return {
        _key(group): LandingCounts(group["count_all"], *(group[f"{name}_sum"] for name in columns))
        for group in groups
    }


def count_by_method(rows: Sequence[Row]) -> dict[str, int]:
    """Returns the number of flights of every method."""
    groups = _groups(_cell_table(rows), [([], "count_all")], pooled=True)
    return {group[_METHOD]: group["count_all"] for group in groups}


def flown_cells(rows: Sequence[Row]) -> set[CellKey]:
    """Returns the cells with a flight."""
    return {_key(group) for group in _groups(_cell_table(rows), [], pooled=False)}


# ---------------------------------------------------------------------------------------- tables


def _cell_table(rows: Sequence[Row], **columns: tuple[str, Sequence[Any]]) -> pa.Table:
    """A table of method, scene and ``columns``, each a type of pyarrow and its values."""
    import pyarrow as pa

    names = {key: ("string", [row[key] for row in rows]) for key in (_METHOD, _SCENE)}
    return pa.table(
        {
            name: pa.array(found, pa.type_for_alias(kind))
            for name, (kind, found) in {**names, **columns}.items()
        }
    )


def _number_table(rows: Sequence[Row], columns: Sequence[str], aliases: Sequence[str]) -> pa.Table:
    found = {
        alias: ("float64", [number(row, column) for row in rows])
        for alias, column in zip(aliases, columns, strict=True)
    }
    return _cell_table(rows, **found)


def _groups(table: pa.Table, aggregations: Sequence[Any], pooled: bool) -> list[dict[str, Any]]:
    keys = [_METHOD] if pooled else [_METHOD, _SCENE]
    # One thread: numbers of a group keep the order of the rows.
    groups: list[dict[str, Any]] = (
        table.group_by(keys, use_threads=False).aggregate(aggregations).to_pylist()
    )
    return groups


def _key(group: dict[str, Any]) -> CellKey:
    return CellKey(group[_METHOD], group.get(_SCENE))


def _counts_by_cell(table: pa.Table, column: str, pooled: bool) -> dict[CellKey, dict[str, int]]:
    keys = [_METHOD, column] if pooled else [_METHOD, _SCENE, column]
    table = table.append_column("row", [range(table.num_rows)])
    counted = table.group_by(keys, use_threads=False).aggregate([([], "count_all"), ("row", "min")])
    found: dict[CellKey, dict[str, int]] = {}
    for group in counted.sort_by("row_min").to_pylist():
        found.setdefault(_key(group), {})[group[column]] = group["count_all"]
    return found


def _most_frequent_first(counts: Iterable[tuple[str, int]]) -> dict[str, int]:
    return dict(sorted(counts, key=lambda item: (-item[1], item[0])))
