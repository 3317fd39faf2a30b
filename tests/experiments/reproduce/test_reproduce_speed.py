"""Table 7 with the reference implementation, and without its libraries."""

import importlib.util
from pathlib import Path
from typing import Any

import pytest

from touchdown.experiments.reproduce.plans import Extent
from touchdown.experiments.reproduce.steps import Job, part_named
from touchdown.experiments.reproduce.tables import speed_table

STEPS = ("down_sampling", "flatness", "smoothness", "distance", "clustering", "selection")
OURS: dict[str, Any] = {
    "scene": "crossroad", "cells": [300, 400], "stage_ms": dict.fromkeys(STEPS, 1.5),
}  # fmt: skip


@pytest.mark.parametrize("there", [True, False])
def test_the_comparison_is_left_out_where_its_library_is_missing(
    there: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    asked: list[bool] = []

    def bench(rounds: int, threads: int, reference: bool) -> dict[str, Any]:
        asked.append(reference)
        return OURS

    find = importlib.util.find_spec
    spec = find("json") if there else None
    monkeypatch.setattr("touchdown.experiments.benchmarks.site_selection_time.bench_landing", bench)
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: spec if name == "skimage" else find(name)
    )
    job = Job(folder=tmp_path, extent=Extent(quick=True), jobs=1)
    assert part_named("speed").run(job).figures == OURS
    assert asked == [there]


def test_table_7_gives_the_reason_of_an_empty_column() -> None:
    alone = speed_table(OURS)
    assert "needs scikit-image (extra `bench`)" in alone.notes[0]
    both = speed_table({**OURS, "reference_ms": dict.fromkeys(STEPS, 30.0)})
    assert "uses Open3D, SciPy and scikit-image" in both.notes[0]
    column = [row[2].text for row in both.rows]
    assert column[1] == "30.0" and alone.rows[1][2].text != "30.0"
