"""Reliability diagrams: the share of right predictions by the probability that they claim."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.io.run_directory import whole_file
from touchdown.experiments.reporting.statistics import fraction_interval
from touchdown.landing.classification.scores import calibration, probabilities

BINS = 10
_PANEL_IN = 3.2
_DPI = 110


def reliability(scores: NDArray[np.float32], labels: NDArray[np.int64]) -> list[dict[str, Any]]:
    """Returns a row for each bin of the probability of the best class that holds an image: mean
    probability, share that is right with its interval, number."""
    chance = probabilities(scores)
    right = chance.argmax(axis=1) == labels
    rows = []
    for mean, share, number in calibration(chance.max(axis=1).astype(np.float32), right, BINS)[1]:
        interval = fraction_interval(round(share * number), number)
        bounds = [interval.low, interval.high]
        rows.append({"mean": mean, "right": share, "interval": bounds, "pictures": number})
    return rows


def draw_reliability(path: Path, panels: Mapping[str, Sequence[Mapping[str, Any]]]) -> None:
    """Writes a diagram for each name of ``panels``, rows as of `reliability`, side by side."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(_PANEL_IN * len(panels), 1.1 * _PANEL_IN), dpi=_DPI)
    for number, (name, rows) in enumerate(panels.items(), 1):
        axes = figure.add_subplot(1, len(panels), number)
        mean, right = ([row[key] for row in rows] for key in ("mean", "right"))
        low, high = ([abs(row["interval"][side] - row["right"]) for row in rows] for side in (0, 1))
        axes.plot([0, 1], [0, 1], color="0.6", linewidth=1)
        axes.errorbar(mean, right, yerr=[low, high], fmt="o-", markersize=4, capsize=2)
        for row in rows:
            axes.annotate(
                str(row["pictures"]), (row["mean"], row["right"]), fontsize=7,
                textcoords="offset points", xytext=(4, -9),
            )  # fmt: skip
        axes.set(xlim=(0, 1.02), ylim=(0, 1.02), aspect="equal", title=name)
        axes.set(xlabel="probability claimed", ylabel="share that is right" if number == 1 else "")
    figure.tight_layout()
    with whole_file(path) as partial:
        figure.savefig(partial, format="png")
