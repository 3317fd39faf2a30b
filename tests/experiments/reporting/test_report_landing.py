"""The part of a report that is about landings, on made-up flights."""

from pathlib import Path
from typing import Any

import pytest

from touchdown.experiments.reporting import published
from touchdown.experiments.reporting.flights import load_flights
from touchdown.experiments.reporting.landing_figure import landing_pictures
from touchdown.experiments.reporting.landings import landing_tables, offset_xy
from touchdown.experiments.reporting.tables import Table

from support.report_support import LANDING, write_run

SPOT = [14.0, -33.5]


def landing(east: float, north: float, **changes: Any) -> dict[str, Any]:
    """A touchdown ``east`` and ``north`` of the spot."""
    return LANDING | {
        "commanded_xy_m": SPOT, "site_xy_m": SPOT,
        "touchdown_xy_m": [SPOT[0] + east, SPOT[1] + north],
        "target_offset_m": (east**2 + north**2) ** 0.5, "bounce_m": 0.004, "impact_peak_mps2": 3.0,
        "obstacle_distance_m": 6.0, "class_true": "field", **changes,
    }  # fmt: skip


def land(directory: Path, method: str, seed: int, scene: str = "crossroad", **changes: Any) -> None:
    write_run(directory, scene, method, seed, **({"outcome": "LANDED", "landing": None} | changes))


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    """gps 1 m east on average, livo 5 cm; one livo refused its site and one touched the unsafe."""
    out = tmp_path_factory.mktemp("landings")
    for seed, east in enumerate((0.8, 1.0, 1.2)):
        land(out, "gps", seed, landing=landing(east, 0.0))
    for seed, north in enumerate((0.04, 0.06)):
        land(out, "livo", seed, landing=landing(0.0, north, bounce_m=0.01 * (seed + 1)))
    land(out, "livo", 2, outcome="ABORTED", reason="the commanded site is refused: water")
    unsafe = landing(0.03, 0.04, safe_geometry=False, impact_peak_mps2=7.5, class_true="road")
    land(out, "livo", 3, landing=unsafe)
    return load_flights(out)


@pytest.fixture(scope="module")
def sites(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    out = tmp_path_factory.mktemp("sites")
    for seed, (distance, slope) in enumerate(((4.0, 1.0), (6.0, 3.0))):
        found = landing(0.0, 0.02, obstacle_distance_m=distance, slope_deg=slope, class_true="lawn")
        land(out, "livo", seed, "turf", landing=found)
    land(out, "livo", 0, "footbridge", landing=landing(0.0, 0.02, class_true="building"))
    land(out, "livo", 1, "footbridge", outcome="NO_SITE", reason="no safe site found")
    land(out, "livo", 0, "forest", landing=landing(0.0, 0.02))
    return load_flights(out)


def table(rows: list[dict[str, Any]], key: str) -> Table:
    return next(found for found in landing_tables(rows) if found.key == key)


def lines(found: Table) -> dict[tuple[str, str], list[str]]:
    return {(row[0].text, row[1].text): [c.text for c in row[2:]] for row in found.rows}


def test_table_5_has_every_method_of_the_paper(rows: list[dict[str, Any]]) -> None:
    found = lines(table(rows, "landing"))
    assert found["`gps`", "paper prints"] == ["–", "–", "–", "1.41", "–", "0.21", "3.11", "–"]
    assert "v_z (m/s) (set)" in table(rows, "landing").header
    assert "largest v_z (m/s) (set)" in table(rows, "touchdowns").header
    assert any("v_z is set by `landing.touch" in n for n in table(rows, "landing").notes)
    assert found["`gps`", "crossroad"][:4] == ["3", "100 %", "100 %", "1.00"]
    assert found["`livo`", "crossroad"][:4] == ["4", "75 %", "50 %", "0.050"]
    # Not flown, but printed: to be compared with.
    assert found["`zou2024`", "paper prints"][3:7] == ["0.41", "–", "0.04", "1.99"]
    assert ("`zou2024`", "crossroad") not in found


def test_numbers_of_table_5_have_intervals(rows: list[dict[str, Any]]) -> None:
    offset = table(rows, "landing").numbers["gps"]["crossroad"]["landing.target_offset_m"]
    assert offset["value"] == pytest.approx(1.0) and offset["low"] < 1.0 < offset["high"]


def test_how_landings_went_counts_unsafe_ones_and_finds_extremes(
    rows: list[dict[str, Any]],
) -> None:
    found = table(rows, "touchdowns")
    assert lines(found)["`livo`", "crossroad"] == [
        "4", "3", "ABORTED 1", "1", "0.060", "0.120", "2.00", "7.50", "2.00",
    ]  # fmt: skip
    assert found.numbers["livo"]["crossroad"]["largest landing.bounce_m"] == pytest.approx(0.02)
    assert found.numbers["livo"]["crossroad"]["otherwise"] == {"ABORTED": 1}
    assert lines(found)["`gps`", "crossroad"][2:4] == ["–", "0"]


def test_table_6_beside_the_papers(sites: list[dict[str, Any]]) -> None:
    found = table(sites, "table6_livo")
    assert [row[0].text for row in found.rows] == ["`turf`", "`footbridge`"]
    turf, bridge = ([c.text for c in row[1:]] for row in found.rows)
    assert turf == [
        "2 of 2", "5.00", "4.52", "2.00", "3.52", "0.120", "lawn (safe) 2", "Lawn (safe)",
    ]  # fmt: skip
    assert bridge[0] == "1 of 2" and bridge[-2:] == ["building (risky) 1", "Road (risky)"]
    assert found.numbers["turf"]["classes"] == {"lawn": 2}
    assert list(published.SITES) == [
        "turf", "rooftop_parking", "cottage", "footbridge", "pools"
    ]  # fmt: skip


def test_offsets_are_from_the_commanded_spot(rows: list[dict[str, Any]]) -> None:
    gps = [row for row in rows if row["estimator"] == "gps"]
    assert offset_xy(gps[0]) == pytest.approx((0.8, 0.0))
    chosen = gps[0] | {"landing.commanded_xy_m": None, "landing.site_xy_m": [14.5, -33.5]}
    assert offset_xy(chosen) == pytest.approx((0.3, 0.0))
    assert offset_xy(gps[0] | {"landing.touchdown_xy_m": None}) is None


def test_fig_12_shows_what_landed_and_enlarges_the_nearest(rows: list[dict[str, Any]]) -> None:
    (picture,) = landing_pictures(rows)
    assert picture.name == "fig12" and "the commanded spot" in picture.title
    assert "3 with `livo`, 3 with `gps`" in picture.caption
    assert "the nearest, enlarged" in picture.svg
    alone = [row for row in rows if row["estimator"] == "gps"]
    assert "enlarged" not in landing_pictures(alone)[0].svg
    (chosen,) = landing_pictures([row | {"landing.commanded_xy_m": None} for row in alone])
    assert "committed at 4 m" in chosen.title and landing_pictures([]) == []
