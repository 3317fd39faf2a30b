"""Text of the verdict of `touchdown regress`, and the table of its comparisons."""

from __future__ import annotations

from touchdown.experiments.reporting.regression.compare import (
    ERROR_ALPHA,
    MIN_FLIGHTS,
    CellResult,
    Comparison,
)
from touchdown.experiments.reporting.statistics import min_pairs


def verdict_sentences(found: Comparison) -> list[str]:
    """Returns one line per regression with its size and p; the last line states the cells without
    power."""
    lines = [f"WORSE  {line}" for line in found.vanished]
    for cell in (cell for cell in found.cells if cell.worse):
        interval = _interval(cell)
        lines.append(
            f"WORSE  {cell.name}: position error {cell.error_m:.4g} m, was "
            f"{cell.error_before_m:.4g} m: {cell.ratio:.3g} times{interval}, "
            f"adjusted p = {cell.p_adjusted:.2g}, {cell.flights} flights, {cell.test}"
        )
    for outcome in (outcome for outcome in found.outcomes if outcome.worse):
        lines.append(
            f"WORSE  {outcome.name}: {outcome.bad} of {outcome.flights} flights did not end as "
            f"they should, was {outcome.bad_before} of {outcome.flights_before}, adjusted p = "
            f"{outcome.p_adjusted:.2g}"
        )
    if not lines and found.cells:
        limit = f" by more than {100 * found.margin:g} %" if found.margin else ""
        lines.append(f"Nothing got worse{limit} beyond chance in {_comparisons(len(found.cells))}.")
    lines += _power_sentences(found)
    lines += [f"newly lost: {line}" for line in found.newly_bad]
    lines += [f"missing: {line}" for line in found.missing]
    lines += [f"not in the baseline: {line}" for line in found.added]
    lines += [f"note: {line}" for line in found.warnings]
    return lines + _blind_sentences(found)


def _interval(cell: CellResult) -> str:
    if cell.ratio_low is None or cell.ratio_high is None:
        return ""
    return f" [{cell.ratio_low:.3g}, {cell.ratio_high:.3g}]"


def _comparisons(count: int) -> str:
    return f"{count} comparison{'s' * (count != 1)}"


def _power_sentences(found: Comparison) -> list[str]:
    """The smallest and the largest detectable change of the cells."""
    seen = [cell for cell in found.cells if cell.detectable is not None]
    if not seen:
        return []
    best, worst = min(seen, key=_size), max(seen, key=_size)
    return [
        "Smallest change that would have been found with 80 % power: "
        f"{_detectable(best)} times in {best.name}"
        + (f", {_detectable(worst)} times in {worst.name}." if worst is not best else ".")
    ]


def _blind_sentences(found: Comparison) -> list[str]:
    """The last line: cells with too few flights to find any change, and the number needed."""
    needed = min_pairs(ERROR_ALPHA / max(1, len(found.cells)))
    if not found.cells:
        return [
            f"Nothing was compared: no scene and method has {MIN_FLIGHTS} flights with a position "
            f"error both here and in the baseline; fly at least {needed} equal seeds."
        ]
    blind, compared = found.blind, _comparisons(len(found.cells))
    if len(blind) == len(found.cells):
        pairs = max(cell.flights if cell.test == "paired" else 0 for cell in found.cells)
        return [
            f"No change could have been found at all: {compared} "
            f"need{'s' * (len(blind) == 1)} {needed} equal seeds, and there are {pairs}."
        ]
    if not blind:
        return []
    return [
        f"No change could have been found in {_comparisons(len(blind))} with too few flights "
        f"({', '.join(blind[:4])}{', ...' if len(blind) > 4 else ''}): "
        f"among {compared} one needs {needed} equal seeds."
    ]


def _size(cell: CellResult) -> float:
    return cell.detectable or 0.0


def _detectable(cell: CellResult) -> str:
    """The detectable ratio; an upper bound where the pairs are equal."""
    if cell.detectable is None:
        return "–"
    return ("at most " if cell.spread == "seeds, at most" else "") + f"{cell.detectable:.3g}"


def table_lines(found: Comparison) -> list[str]:
    """Returns a Markdown table with one line per cell, the smallest p first."""
    lines = [
        "| scene, method | error (m) | was (m) | ratio | adjusted p | detectable ratio | test |",
        "|---|---|---|---|---|---|---|",
    ]
    for cell in sorted(found.cells, key=lambda cell: (cell.p_adjusted, -cell.ratio)):
        lines.append(
            f"| {cell.name} | {cell.error_m:.4g} | {cell.error_before_m:.4g} | "
            f"{cell.ratio:.3g}{_interval(cell)} | {cell.p_adjusted:.2g} | {_detectable(cell)} | "
            f"{cell.test}, {cell.flights} |"
        )
    return lines
