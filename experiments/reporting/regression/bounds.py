"""Several figures of few flights, each against a bound from the spread between repetitions.

The tests of `compare` find no change in four flights. Here the spread is that of the baseline,
which holds repetitions of its flights in a wind that differs by a thousandth: rounding, on another
machine too, and a change that means nothing make flights of equal seeds differ as much.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy import stats

from touchdown.experiments.errors import UsageError
from touchdown.experiments.reporting.flights import Row
from touchdown.experiments.reporting.regression.baseline import (
    FIGURES,
    REPEATED,
    Baseline,
    Figure,
    Key,
    Pairs,
    Trials,
    cell_name,
    cells_of,
    newly_bad,
    over_scenes,
)
from touchdown.experiments.reporting.tables import markdown_lines

ALPHA = 0.01
"""Fraction of false alarms of a whole comparison, where equal seeds differ as repetitions do."""
_LEAST = math.log(1.03)
"""Least margin: a figure that repeats to a thousandth may move by more."""
POWER = 0.8
"""of a comparison against the change that it is said to see"""
_ROUNDING = 1e-9


@dataclass(frozen=True, kw_only=True, slots=True)
class BoundedFigure:
    """A figure over the flights of a cell, or of all cells of a method. ``now``, ``before``,
    ``minimum`` (None: no bound) and ``maximum`` are geometric means; ``spread`` is the standard
    deviation of the logarithm between repetitions; ``sees``: the ratio that is found with the
    probability `POWER`."""

    name: str
    figure: str
    flights: int
    now: float
    before: float
    minimum: float | None
    maximum: float
    spread: float
    sees: float
    worse: bool

    @property
    def bounds(self) -> str:
        lower = "" if self.minimum is None else f"{self.minimum:.4g} to "
        return f"{lower}{self.maximum:.4g}"


@dataclass(frozen=True, kw_only=True, slots=True)
class BoundsVerdict:
    """``lost``: flights that were successful, or had a figure, in the baseline and are so no
    longer."""

    figures: list[BoundedFigure]
    lost: list[str]
    baseline_revision: str | None

    @property
    def failed(self) -> bool:
        return bool(self.lost) or any(figure.worse for figure in self.figures)

    def as_json(self) -> dict[str, Any]:
        return asdict(self) | {"failed": self.failed, "alpha": ALPHA}


def check_bounds(rows: Sequence[Row], baseline: Baseline) -> BoundsVerdict:
    """Compares the flights of ``rows`` with those of equal seeds of the baseline.

    A figure is worse where the mean of its logarithm exceeds that of the baseline, or departs from
    it to either side, by more than 3 % and t s sqrt(2 / n): s the standard deviation between the
    repetitions of a flight, pooled over the baseline's flights with the method, n the flights, t
    the quantile of Student's distribution for `ALPHA` over all figures and cells (Bonferroni).
    Raises UsageError where nothing can be compared.
    """
    pairs = _equal_seeds(cells_of(rows), baseline)
    groups = {key: [key] for key in pairs} | over_scenes(pairs)
    alpha = ALPHA / (len(groups) * len(FIGURES))
    figures, lost = [], newly_bad(pairs)
    for figure in FIGURES:
        for total, keys in groups.items():
            name = cell_name(total)
            values = [
                (figure.log_of(new[seed].figures), figure.log_of(old[seed].figures))
                for new, old in (pairs[key] for key in keys)
                for seed in old
            ]
            both = [(x, y) for x, y in values if x is not None and y is not None]
            gone = sum(x is None and y is not None for x, y in values)
            if gone and len(keys) == 1:
                lost.append(f"{name}: {gone} of {len(values)} flights have no {figure.title}")
            if both:
                spread, freedom = _spread(figure, baseline.trials, total)
                t = float(stats.t.ppf(1.0 - alpha / (1 + figure.both_sides), freedom))
                error = spread * math.sqrt(2.0 / len(both))
                margin, power = t * error, float(stats.t.ppf(POWER, freedom)) * error
                margin = max(margin, _LEAST)
                now, before = np.mean(both, axis=0).tolist()
                low = before - margin if figure.both_sides else -math.inf
                figures.append(
                    BoundedFigure(
                        name=name,
                        figure=figure.title,
                        flights=len(both),
                        now=math.exp(now),
                        before=math.exp(before),
                        minimum=math.exp(low) if figure.both_sides else None,
                        maximum=math.exp(before + margin),
                        spread=spread,
                        sees=math.exp(margin + power),
                        worse=not low - _ROUNDING <= now <= before + margin + _ROUNDING,
                    )
                )
    return BoundsVerdict(figures=figures, lost=lost, baseline_revision=baseline.git_revision)


def _equal_seeds(new: Mapping[Key, Trials], baseline: Baseline) -> Pairs:
    """Flights of equal seeds by cell, new and old."""
    old = baseline.trials
    pairs = {}
    for key in sorted(new.keys() & old.keys()):
        seeds = sorted(new[key].keys() & old[key].keys())
        if seeds:
            pairs[key] = {s: new[key][s] for s in seeds}, {s: old[key][s] for s in seeds}
    if not pairs:
        raise UsageError(
            "the baseline has no flight of equal scene, method, preset and seed; it has "
            f"{baseline.some_cells}"
        )
    return pairs


def _spread(figure: Figure, cells: Mapping[Key, Trials], total: Key) -> tuple[float, int]:
    """The standard deviation between repetitions, pooled over the flights of the method and variant
    of ``total``, and its degrees of freedom."""
    freedom, squares = 0, 0.0
    trials = (one for key, own in cells.items() if key[1:] == total[1:] for one in own.values())
    for trial in trials:
        found = map(figure.log_of, (trial.figures, *trial.repeats))
        logs = [x for x in found if x is not None]
        if len(logs) > 1:
            freedom += len(logs) - 1
            squares += float(np.var(logs)) * len(logs)
    if not freedom:
        raise UsageError(
            f"the baseline has no spread of the {figure.title}: write it from a campaign with "
            f'variants of each flight that are called "{REPEATED}..."'
        )
    return math.sqrt(squares / freedom), freedom


def bounds_lines(found: BoundsVerdict) -> list[str]:
    """A Markdown table of each figure against its bound, and a line for everything worse."""
    header = ["figure", "scene, method", "now", "was", "bound", "sees", "flights", ""]  # fmt: skip
    rows = [
        [one.figure, one.name, f"{one.now:.4g}", f"{one.before:.4g}", one.bounds,
         f"{one.sees:.2f} times", str(one.flights), "WORSE" * one.worse]
        for one in found.figures
    ]  # fmt: skip
    lines = [*markdown_lines(header, rows), "", *(f"LOST   {line}" for line in found.lost)]
    lines += [
        f"WORSE  {one.name}: {one.figure} {one.now:.4g}, was {one.before:.4g}: "
        f"{one.now / one.before:.3g} times; bound {one.bounds}"
        for one in found.figures
        if one.worse
    ]
    if not found.failed:
        lines.append(f"All {len(found.figures)} figures are within their bounds.")
    return lines
