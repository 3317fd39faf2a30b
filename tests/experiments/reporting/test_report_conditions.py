"""The table of conditions: groups, means, worst flights, and ratios to the first condition."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

from touchdown.experiments.reporting.flights import (
    condition_of,
    frame_of,
    label_conditions,
    load_flights,
)
from touchdown.experiments.reporting.report import as_json, make_report, markdown, page
from touchdown.experiments.reporting.report_tables import summary
from touchdown.experiments.reporting.statistics import ratio_interval

from support.report_support import write_run


def row(condition: str, scene: str, seed: int, error: float, **more: Any) -> dict[str, Any]:
    name = f"{scene}-livo-s{seed}"
    return {
        "run_id": f"{name}-{condition}" if condition else name, "scene": scene, "seed": seed,
        "estimator": "livo", "outcome": "COMPLETED", "position_error_m.mean": error,
        "success": more.get("outcome") != "DIVERGED",
        "position_error_m.max": 2.0 * error, "nees.below_14_2": 0.9,
    } | more  # fmt: skip


def test_conditions_are_what_names_hold_beside_scene_method_and_seed() -> None:
    assert condition_of(row("field-none", "lake", 1, 0.1)) == "field-none"
    assert condition_of(row("", "lake", 12, 0.1)) == ""
    assert condition_of(row("w40", "scenes/my.xml", 3, 0.1) | {"run_id": "my-livo-s3-w40"}) == "w40"
    assert condition_of(row("w40", "lake", 1, 0.1) | {"run_id": "study/other"}) == ""


def test_ratios_are_of_means_of_pairs() -> None:
    found = ratio_interval([(2.0, 1.0), (4.0, 2.0), (6.0, 3.0)])
    assert found is not None and found.low is not None
    assert (found.value, found.flights) == (2.0, 3) and found.low == pytest.approx(2.0)
    assert ratio_interval([]) is None and ratio_interval([(1.0, 0.0)]) is None


def flown(directory: Path, profile: str, seed: int, error: float, **config: Any) -> None:
    """A survey with the profile in its result, and with a ``config.json`` where keys are given."""
    changes = {"trajectory_error_m": error, "map": {
        "duration_s": 18.0, "density_per_m2": 900.0,
        "levelness_error_deg": {"mean": 10.0 * error, "max": 20.0 * error, "places": 10},
    }}  # fmt: skip
    run = write_run(directory, "crossroad", "zou2024", seed, profile=profile, **changes)
    if config:
        (run / "config.json").write_text(json.dumps({"profile": profile, "seed": seed} | config))


def test_no_figure_is_over_two_profiles(tmp_path: Path) -> None:
    """Errors of 0.06 m in `ideal` and 0.24 m in `field`: never their mean, 0.150 m."""
    for seed in range(3):
        flown(tmp_path / "a", "ideal", seed, 0.06)
        flown(tmp_path / "b", "field", seed, 0.24)
    report = make_report(load_flights(tmp_path), title="two profiles", first="ideal")
    text = markdown(report) + re.sub(r"<svg.*?</svg>", "", page(report), flags=re.DOTALL)
    assert "0.150" not in text and "1.50 [" not in text
    tables = {table.key: table for section in report.sections for table in section.tables}
    found = tables["table2"]
    assert found.header[0] == "condition"
    assert {row[0].text: row[1].text for row in found.rows} == {
        "`ideal`": "0.060", "`field`": "0.240",
    }  # fmt: skip
    assert "2 conditions: `ideal`, `field`. No figure is over several" in text
    pictures = {picture.name: picture.title for s in report.sections for picture in s.pictures}
    assert {"fig10b_ideal", "fig10b_field"} <= set(pictures)
    assert all(title.endswith(("`ideal`", "`field`")) for title in pictures.values())
    numbers = as_json(report, load_flights(tmp_path))["tables"]["table2"]
    error = numbers["field"]["zou2024"]["crossroad"]["trajectory_error_m"]
    assert error["value"] == pytest.approx(0.24)


def test_conditions_outside_of_a_campaign_are_of_the_configurations(tmp_path: Path) -> None:
    wind = {"mean_kmh": 12.0}
    flown(tmp_path / "a", "field", 0, 0.1, light="day", wind=wind, scene="x", record=True)
    flown(tmp_path / "b", "field", 1, 0.1, light="night", wind=wind, camera={"gain": 9.0})
    flown(tmp_path / "c", "field", 2, 0.1, light="day", wind={"mean_kmh": 30.0})
    rows = load_flights(tmp_path)
    label_conditions(rows)
    assert [row["condition"] for row in sorted(rows, key=lambda row: row["seed"])] == [
        "day, wind.mean_kmh=12.0", "night, wind.mean_kmh=12.0", "day, wind.mean_kmh=30.0",
    ]  # fmt: skip


def test_means_are_by_method_and_condition(tmp_path: Path) -> None:
    flown(tmp_path / "a", "ideal", 0, 0.06)
    flown(tmp_path / "b", "field", 0, 0.24)
    rows = load_flights(tmp_path)
    label_conditions(rows)
    means = summary(frame_of(rows))["means"]
    assert {name: own["trajectory_error_m"] for name, own in means.items()} == {
        "zou2024, ideal": 0.06, "zou2024, field": 0.24,
    }  # fmt: skip
