"""Short flights beside whole ones of equal scene, method and seed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from touchdown.experiments.reporting.flights import number
from touchdown.experiments.reporting.statistics import Estimate, mean_interval
from touchdown.experiments.reporting.tables import MISSING, digits, interval_text

Row = Mapping[str, Any]
FIGURES = (
    ("position error (m)", "position_error_m.mean"),
    ("largest position error (m)", "position_error_m.max"),
    ("error at the commit (m)", "landing.estimate_error_at_commit_m"),
    ("NEES below 14.2 (share)", "nees.below_14_2"),
    ("E_tra (m)", "trajectory_error_m"),
    ("d_L (m)", "landing.target_offset_m"),
    ("a_z (m/s²)", "landing.vertical_accel_mps2"),
    ("levelness (°)", "map.levelness_error_deg.mean"),
    ("CPU time (s)", "cpu_s"),
)
"""Title and column of each line of the table."""


def pairs(short: Sequence[Row], whole: Sequence[Row]) -> list[str]:
    """A line for each figure: means, ratio and rank correlation over the pairs."""
    by_key = {_key(row): row for row in whole}
    both = [(row, by_key[_key(row)]) for row in short if _key(row) in by_key]
    lines = [
        "| figure | pairs | whole, mean | short, mean | short over whole | rank correlation |",
        "|---|---|---|---|---|---|",
        *(_line(title, column, both) for title, column in FIGURES),
        "",
        f"- {_outcomes(both)} Ratio of the geometric means, with its 95 % interval over pairs "
        "(bootstrap); Spearman's correlation, with its 95 % interval (Fisher's z).",
    ]
    return lines


def _key(row: Row) -> tuple[object, ...]:
    return row["scene"], row["estimator"], row["seed"]


def _line(title: str, column: str, both: Sequence[tuple[Row, Row]]) -> str:
    found = [(number(a, column), number(b, column)) for a, b in both]
    values = np.array([(a, b) for a, b in found if a is not None and b is not None])
    if len(values) < 2:
        return f"| {title} | {len(values)} | – | – | – | – |"
    short, whole = values.T
    ratio = MISSING
    if np.all(values > 0.0) and (mean := mean_interval(np.log(short / whole))) is not None:
        low, high = (None if end is None else math.exp(end) for end in (mean.low, mean.high))
        estimate = Estimate(math.exp(mean.value), low, high, mean.flights)
        ratio = f"{digits(estimate.value)} {interval_text(estimate)}".strip()
    means = f"{digits(float(whole.mean()))} | {digits(float(short.mean()))}"
    return f"| {title} | {len(values)} | {means} | {ratio} | {_correlation(short, whole)} |"


def _correlation(short: NDArray[np.float64], whole: NDArray[np.float64]) -> str:
    """Spearman's correlation with its interval; `MISSING` where one side does not vary or pairs are
    too few."""
    if len(short) < 5 or np.ptp(short) == 0.0 or np.ptp(whole) == 0.0:
        return MISSING
    rank = float(stats.spearmanr(short, whole).statistic)
    half = float(stats.norm.ppf(0.975)) / math.sqrt(len(short) - 3)
    center = math.atanh(min(max(rank, -0.9999), 0.9999))
    return f"{rank:.2f} [{math.tanh(center - half):.2f}, {math.tanh(center + half):.2f}]"


def _outcomes(both: Sequence[tuple[Row, Row]]) -> str:
    landed = [sum(row["outcome"] == "LANDED" for row in side) for side in zip(*both, strict=True)]
    short, whole = landed or (0, 0)
    return f"Landed: {short} of {len(both)} short flights, {whole} of {len(both)} whole ones."
