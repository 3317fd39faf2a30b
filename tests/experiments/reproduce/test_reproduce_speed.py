"""Table 7 with the reference implementation, and without its libraries."""

from typing import Any

from touchdown.experiments.reproduce.tables import speed_table

STEPS = ("down_sampling", "flatness", "smoothness", "distance", "clustering", "selection")
OURS: dict[str, Any] = {
    "scene": "crossroad", "cells": [300, 400], "stage_ms": dict.fromkeys(STEPS, 1.5),
}  # fmt: skip


def test_table_7_gives_the_reason_of_an_empty_column() -> None:
    alone = speed_table(OURS)
    assert "needs scikit-image (extra `bench`)" in alone.notes[0]
    both = speed_table({**OURS, "reference_ms": dict.fromkeys(STEPS, 30.0)})
    assert "uses Open3D, SciPy and scikit-image" in both.notes[0]
    column = [row[2].text for row in both.rows]
    assert column[1] == "30.0" and alone.rows[1][2].text != "30.0"
