"""Grouped queries over rows with known answers."""

from typing import Any

import pytest

from touchdown.experiments.reporting import queries
from touchdown.experiments.reporting.measures import TRAJECTORY_VARIANCE, estimates, mean_of


def row(scene: str, method: str, outcome: str = "LANDED", **more: Any) -> dict[str, Any]:
    return {"scene": scene, "estimator": method, "outcome": outcome} | more


ROWS = [
    row("lake", "gps", error=3.0, area=1.0, kind="sand"),
    row("lake", "gps", "NO_SITE", error=1.0),
    row("flat", "livo", error=0.5, area=2.0, kind="grass"),
    row("flat", "gps", error=float("nan"), area=4.0),
    row("lake", "gps", error=2.0, area=3.0, kind="grass"),
    row("lake", "gps", kind="sand"),
]
LAKE, FLAT = queries.CellKey("gps", "lake"), queries.CellKey("gps", "flat")


def test_numbers_keep_the_order_of_the_rows_without_missing_ones() -> None:
    assert queries.numbers_by_cell(ROWS, ["error"]) == {
        LAKE: ([3.0, 1.0, 2.0],),
        queries.CellKey("livo", "flat"): ([0.5],),
    }
    pooled = queries.numbers_by_cell(ROWS, ["error", "area"], pooled=True)
    assert pooled == {
        queries.CellKey("gps"): ([3.0, 2.0], [1.0, 3.0]),
        queries.CellKey("livo"): ([0.5], [2.0]),
    }


def test_counts_of_flights_and_outcomes() -> None:
    assert list(queries.outcome_counts(ROWS).items()) == [("LANDED", 5), ("NO_SITE", 1)]
    assert queries.outcomes_by_cell(ROWS)[LAKE] == {"LANDED": 3, "NO_SITE": 1}
    assert queries.outcomes_by_cell(ROWS, pooled=True)[queries.CellKey("gps")] == {
        "LANDED": 4,
        "NO_SITE": 1,
    }
    assert queries.count_by_method(ROWS) == {"gps": 5, "livo": 1}
    assert queries.flown_cells(ROWS) == {LAKE, FLAT, queries.CellKey("livo", "flat")}


def test_texts_come_in_the_order_of_their_first_rows() -> None:
    found = queries.texts_by_cell(ROWS, "kind")
    assert list(found[LAKE].items()) == [("sand", 2), ("None", 1), ("grass", 1)]
    assert found[FLAT] == {"None": 1}


def test_largest_numbers() -> None:
    assert queries.largest_by_cell(ROWS, ["error", "area"])[LAKE] == (3.0, 3.0)
    assert queries.largest_by_cell(ROWS, ["error", "area"])[FLAT] == (None, 4.0)


def test_counts_of_landings() -> None:
    judged = {"landing.judged_on": "geometry", "landing.safe": None}
    safe, unsafe = ({**judged, "landing.safe_geometry": found} for found in (True, False))
    rows = [
        row("lake", "gps", **safe), row("lake", "gps", **unsafe),
        row("lake", "gps", "TIPPED", **unsafe), row("lake", "gps", "NO_SITE"),
    ]  # fmt: skip
    counts = queries.LandingCounts(flights=4, landed=2, landed_safely=1, unsafe=2)
    assert queries.landings_by_cell(rows) == {LAKE: counts}
    assert queries.landings_by_cell(rows, pooled=True) == {queries.CellKey("gps"): counts}


def test_estimates_by_cell() -> None:
    found = estimates(ROWS, mean_of("error"))
    assert found[LAKE].value == pytest.approx(2.0) and found[LAKE].flights == 3
    assert FLAT not in found
    rows = [
        row("lake", "gps", trajectory_error_m=1.0, trajectory_variance_m2=0.5),
        row("lake", "gps", trajectory_error_m=3.0, trajectory_variance_m2=0.5),
        row("lake", "gps", trajectory_error_m=9.0),
    ]
    # 0.5 within the flights and 1 between the means of the two that have both numbers.
    assert estimates(rows, TRAJECTORY_VARIANCE)[LAKE].value == pytest.approx(1.5)
