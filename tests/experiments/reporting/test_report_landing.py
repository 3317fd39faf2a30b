"""The part of a report that is about landings, on made-up flights."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchdown.experiments.reporting import published
from touchdown.experiments.reporting.figures import Picture, offsets_xy, pictures_of
from touchdown.experiments.reporting.flights import frame_of, load_flights
from touchdown.experiments.reporting.report_tables import intruder_table, landing_tables
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
    home = landing(0.0, 9.0, slope_deg=30.0, tilt_deg=50.0, bounce_m=1.0)
    refused = "the commanded site is refused: water"
    land(out, "livo", 2, outcome="ABORTED", reason=refused, landing=home)
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
    return next(found for found in landing_tables(frame_of(rows), paper=True) if found.key == key)


def lines(found: Table) -> dict[tuple[str, str], dict[str, str]]:
    """The figures by method and scene, and the title of their column; the paper's after a "+"."""
    titles = [
        f"{found.header[n - 1]}+" if title == "paper prints" else title
        for n, title in enumerate(found.header)
    ]
    return {
        (row[0].text, row[1].text): dict(zip(titles, [cell.text for cell in row], strict=True))
        for row in found.rows
    }


def test_table_5_has_the_published_figures_of_each_method(rows: list[dict[str, Any]]) -> None:
    found = table(rows, "table5")
    gps, livo = (lines(found)[f"`{method}`", "`crossroad`"] for method in ("gps", "livo"))
    assert (gps["landings"], gps["landed (%)"], gps["safe (%)"]) == ("3", "100", "100")
    assert (gps["d_L (m)"], gps["d_L (m)+"]) == ("1.00", "1.41")
    assert (gps["a_z (m/s²)+"], gps["α_L (°)+"]) == ("0.21", "3.11")
    assert "v_z (m/s) (set)" in gps and "v_z (m/s) (set)+" not in gps
    assert (livo["landings"], livo["landed (%)"], livo["safe (%)"]) == ("4", "75.0", "50.0")
    assert (livo["d_L (m)"], livo["d_L (m)+"]) == ("0.050", "–")
    assert any("v_z is set by `landing.touch" in note for note in found.notes)
    offset = found.numbers["gps"]["crossroad"]["landing.target_offset_m"]
    assert offset["value"] == pytest.approx(1.0) and offset["low"] < 1.0 < offset["high"]


def test_how_landings_went_counts_unsafe_ones_and_finds_extremes(
    rows: list[dict[str, Any]],
) -> None:
    found = table(rows, "touchdowns")
    livo, gps = (lines(found)[f"`{method}`", "`crossroad`"] for method in ("livo", "gps"))
    assert list(livo.values())[2:] == [
        "4", "ABORTED 1", "1", "0.060", "0.120", "2.00", "7.50", "2.00",
    ]  # fmt: skip
    assert livo["largest bounce (cm)"] == "2.00" and "largest v_z (m/s) (set)" in livo
    numbers = found.numbers["livo"]["crossroad"]
    assert numbers["landing.bounce_m.largest"] == pytest.approx(0.02)
    assert (gps["other outcomes"], gps["unsafe touchdowns"]) == ("–", "0")


def test_table_6_beside_the_papers(sites: list[dict[str, Any]]) -> None:
    found = table(sites, "table6")
    by_scene = {scene: list(line.values())[1:] for (_, scene), line in lines(found).items()}
    turf, bridge = by_scene["`turf`"], by_scene["`footbridge`"]
    assert turf == [
        "`turf`", "2", "2", "2", "5.00", "4.52", "2.00", "3.52", "0.120", "lawn (safe) 2",
        "Lawn (safe)",
    ]  # fmt: skip
    assert bridge[:4] == ["`footbridge`", "2", "2", "1"]
    assert bridge[-2:] == ["building (risky) 1", "Road (risky)"]
    assert list(published.SITES) == [
        "turf", "rooftop_parking", "cottage", "footbridge", "pools"
    ]  # fmt: skip


def test_offsets_are_from_the_commanded_spot(rows: list[dict[str, Any]]) -> None:
    gps = next(row for row in rows if row["estimator"] == "gps")
    chosen = gps | {"landing.commanded_xy_m": None, "landing.site_xy_m": [14.5, -33.5]}
    nowhere = gps | {"landing.touchdown_xy_m": None}
    found = offsets_xy(frame_of([gps, chosen, nowhere]))
    assert found == pytest.approx(np.array([[0.8, 0.0], [0.3, 0.0]]))


def touchdowns(rows: list[dict[str, Any]]) -> Picture:
    return next(found for found in pictures_of(frame_of(rows)) if found.name == "fig12")


def test_fig_12_shows_what_landed_and_enlarges_the_nearest(rows: list[dict[str, Any]]) -> None:
    picture = touchdowns(rows)
    assert "the commanded spot" in picture.title
    assert "3 with `livo`, 3 with `gps`" in picture.caption
    assert "the nearest, enlarged" in picture.svg
    alone = [row for row in rows if row["estimator"] == "gps"]
    assert "enlarged" not in touchdowns(alone).svg
    chosen = touchdowns([row | {"landing.commanded_xy_m": None} for row in alone])
    assert "committed at 4 m" in chosen.title


def test_who_came_is_told_apart_from_false_alarms(tmp_path: Path) -> None:
    answered = [{"time_s": 20.0, "text": "DESCEND site_not_clear: something moves: giving way"}]
    late = {"avoidable": False}
    for seed, changes in enumerate((
        {"intrusion": {"avoidable": True, "reaction_s": 0.2}, "events": answered},
        {"intrusion": {"avoidable": True, "reaction_s": 0.4}, "events": answered,
         "landing": landing(0.0, 0.1, nearest_person_m=2.9)},
        {"intrusion": {"avoidable": True, "reaction_s": 1.8}, "events": answered,
         "outcome": "NO_SITE"},
        {"intrusion": late, "outcome": "COLLIDED", "reason": "rotor touched traffic/intruder_0/g"},
        {"intrusion": late, "outcome": "COLLIDED", "reason": "rotor touched trees/trunk_0/g"},
    )):  # fmt: skip
        safe = {"landing": landing(0.0, 0.1, nearest_person_m=3.1)}
        land(tmp_path, "livo", seed, **(safe | changes))
    for seed in range(4):
        land(tmp_path, "livo", seed, "lake", landing=landing(0.0, 0.1), events=answered[seed:])
    numbers = intruder_table(frame_of(load_flights(tmp_path))).numbers["livo"]
    shares = {name: found["value"] for name, found in numbers["crossroad"].items()
              if isinstance(found, dict)}  # fmt: skip
    assert shares == {
        "descent interrupted": 0.6, "safe landings": 0.4, "hit": 0.2, "touchdowns within 3 m": 0.2,
    }  # fmt: skip
    names = ("too late to stop", "intrusion.reaction_s.median", "intrusion.reaction_s.largest")
    assert [numbers["crossroad"][name] for name in names] == [2, 0.4, 1.8]
    assert numbers["lake"]["descent interrupted"]["value"] == 0.25
    assert not set(names) & set(numbers["lake"])


def test_without_intruders_nobody_came(rows: list[dict[str, Any]]) -> None:
    assert not intruder_table(frame_of(rows)).rows
