"""The table of conditions: groups, means, worst flights, and ratios to the first condition."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from touchdown.experiments.reporting.conditions import condition_of, condition_table
from touchdown.experiments.reporting.statistics import ratio_interval


def row(condition: str, scene: str, seed: int, error: float, **more: Any) -> dict[str, Any]:
    name = f"{scene}-livo-s{seed}"
    return {
        "run_id": f"{name}-{condition}" if condition else name, "scene": scene, "seed": seed,
        "estimator": "livo", "outcome": "COMPLETED", "position_error_m.mean": error,
        "position_error_m.max": 2.0 * error, "nees.below_14_2": 0.9,
    } | more  # fmt: skip


def test_conditions_are_what_names_hold_beside_scene_method_and_seed() -> None:
    assert condition_of(row("field-none", "lake", 1, 0.1)) == "field-none"
    assert condition_of(row("", "lake", 12, 0.1)) == ""
    assert condition_of(row("w40", "scenes/my.xml", 3, 0.1) | {"run_id": "my-livo-s3-w40"}) == "w40"
    assert condition_of(row("w40", "lake", 1, 0.1) | {"run_id": "study/other"}) == ""


def test_figures_of_each_condition_and_their_ratio() -> None:
    rows = [row("a", "lake", seed, 0.1 * (seed + 1)) for seed in range(3)]
    rows += [row("b", "lake", seed, 0.3 * (seed + 1), outcome="DIVERGED") for seed in range(2)]
    rows += [row("a", "forest", 0, 0.5, **{"landing.estimate_error_at_contact_m": 0.07})]
    table = condition_table(rows, "a")
    numbers = table.numbers
    lake = numbers["a"]["livo"]["lake"]
    assert (lake["flights"], lake["successful"], lake["diverged"]) == (3, 3, 0)
    assert lake["position_error_m.mean"]["value"] == pytest.approx(0.2)
    assert lake["position_error_m.mean.worst"]["value"] == pytest.approx(0.3)
    assert lake["position_error_m.max.worst"]["value"] == pytest.approx(0.6)
    assert lake["nees.below_14_2"]["value"] == pytest.approx(90.0)
    other = numbers["b"]["livo"]["lake"]
    assert (other["successful"], other["diverged"]) == (0, 2)
    assert other["error_ratio"]["value"] == pytest.approx(3.0)  # over seeds 0 and 1, not 2
    assert lake["error_ratio"]["value"] == pytest.approx(1.0)
    every = numbers["a"]["livo"]["all scenes"]
    assert every["flights"] == 4
    assert every["landing.estimate_error_at_contact_m"]["value"] == pytest.approx(0.07)
    assert table.header[-1] == "mean error over that of a"
    assert len({len(line) for line in table.rows} | {len(table.header)}) == 1
    assert [line[0].text for line in table.rows] == ["a", "a", "a", "b"]


def test_one_condition_has_no_ratio(tmp_path: Path) -> None:
    table = condition_table([row("", "lake", 0, 0.1)])
    assert table.header[-1] == "NEES below 14.2 (%)"


def test_ratios_are_of_means_of_pairs() -> None:
    found = ratio_interval([(2.0, 1.0), (4.0, 2.0), (6.0, 3.0)])
    assert found is not None and found.low is not None
    assert (found.value, found.flights) == (2.0, 3) and found.low == pytest.approx(2.0)
    assert ratio_interval([]) is None and ratio_interval([(1.0, 0.0)]) is None
