"""Regression test of the position error: the flights of a directory against a baseline.

The measure is the mean position error of a flight. Logarithms are compared, so that a change is a
ratio and easy and hard scenes weigh the same. A *cell* is a scene with a method.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.errors import UsageError
from touchdown.experiments.reporting.flights import Row
from touchdown.experiments.reporting.regression.baseline import (
    METRIC,
    Baseline,
    Cells,
    Figure,
    Key,
    Pairs,
    Trial,
    cell_name,
    cells_of,
    configuration_sha,
    newly_bad,
    over_scenes,
)
from touchdown.experiments.reporting.statistics import (
    detectable_paired,
    detectable_unpaired,
    difference_interval,
    exponential,
    fisher_p,
    holm,
    mean_interval,
    min_pairs,
    sign_flip_p,
    unpaired_p,
)
from touchdown.experiments.reporting.tables import markdown_lines

Array = NDArray[np.float64]

ERROR_ALPHA, OUTCOME_ALPHA = 0.04, 0.01
"""Parts of the 5 % of false alarms of a whole comparison: most for errors, where exact tests of
ten pairs can reach it in up to 40 cells, the rest on outcomes."""
_ERROR = Figure("position error (m)", METRIC, 1e-4)
MIN_FLIGHTS = 2


@dataclass(frozen=True, kw_only=True, slots=True)
class CellResult:
    """``ratio`` is new over old; ``detectable`` the smallest ratio that would have been found with
    80 % power, None where no change could have been; ``spread`` names the source of the spread."""

    scene: str
    method: str
    variant: str
    test: str
    flights: int
    error_m: float
    error_before_m: float
    ratio: float
    ratio_low: float | None
    ratio_high: float | None
    p: float
    p_adjusted: float
    detectable: float | None
    spread: str
    worse: bool

    @property
    def name(self) -> str:
        return cell_name((self.scene, self.method, self.variant))

    def ratio_text(self, unit: str = "") -> str:
        interval = ""
        if self.ratio_low is not None and self.ratio_high is not None:
            interval = f" [{self.ratio_low:.3g}, {self.ratio_high:.3g}]"
        return f"{self.ratio:.3g}{unit}{interval}"

    @property
    def detectable_text(self) -> str:
        """The detectable ratio; an upper bound where the pairs are equal."""
        if self.detectable is None:
            return "–"
        return ("at most " if self.spread == "seeds, at most" else "") + f"{self.detectable:.3g}"


@dataclass(frozen=True, slots=True)
class OutcomeResult:
    """Unsuccessful flights, now (``bad``) and in the baseline."""

    name: str
    bad: int
    flights: int
    bad_before: int
    flights_before: int
    p: float
    p_adjusted: float
    worse: bool


@dataclass(frozen=True, kw_only=True, slots=True)
class Comparison:
    cells: list[CellResult]
    outcomes: list[OutcomeResult]
    vanished: list[str]
    """cells that count as worse without a test, see `_vanished`"""
    newly_bad: list[str]
    missing: list[str]
    """cells and seeds of the baseline that the directory lacks"""
    added: list[str]
    """cells and seeds of the directory that the baseline lacks"""
    warnings: list[str]
    margin: float
    baseline_revision: str | None

    @property
    def regressed(self) -> bool:
        worse = [one.worse for one in self.cells] + [one.worse for one in self.outcomes]
        return bool(self.vanished) or any(worse)

    @property
    def blind(self) -> list[str]:
        """Cells with too few flights to find any change."""
        return [cell.name for cell in self.cells if cell.detectable is None]

    def failed(self, require_power: bool = False) -> bool:
        """True if something got worse or nothing was compared; with ``require_power`` also
        if a cell has too few flights to find any change."""
        return self.regressed or not self.cells or (require_power and bool(self.blind))

    def as_json(self) -> dict[str, Any]:
        found = asdict(self) | {"compared": len(self.cells), "blind": self.blind}
        found["alpha"] = {"errors": ERROR_ALPHA, "outcomes": OUTCOME_ALPHA}
        return found | {"regressed": self.regressed}


def compare(rows: Sequence[Row], baseline: Baseline, margin: float = 0.0) -> Comparison:
    """Compares flights with the baseline: worse beyond chance and by more than ``margin``.

    ``margin`` is a fraction: 0.1 asks whether errors grew by more than 10 %. Raises UsageError when
    the two have no cell in common.
    """
    new, old = cells_of(rows), baseline.cells
    pairs = {key: (new[key], old[key]) for key in sorted(new.keys() & old.keys())}
    if not pairs:
        raise UsageError(f"the baseline has no cell of these flights; it has {baseline.some_cells}")
    samples = [found for key in pairs if (found := _sample(key, *pairs[key])) is not None]
    gone = _vanished(pairs)
    measured = {sample.key for sample in samples} | gone.keys()
    warnings = [
        f"{cell_name(key)}: too few flights with an error to compare"
        for key in pairs
        if key not in measured
    ]
    if configuration_sha(rows) != baseline.config_sha:
        warnings.append(
            "configurations or the set of runs differ from the baseline's: a change may come from "
            "them"
        )
    return Comparison(
        cells=_test([*samples, *_over_scenes(samples)], margin),
        outcomes=_compare_outcomes(pairs),
        vanished=[f"{cell_name(key)}: {why}" for key, why in gone.items()],
        newly_bad=newly_bad(pairs),
        missing=_absent(old, new),
        added=_absent(new, old),
        warnings=warnings,
        margin=margin,
        baseline_revision=baseline.git_revision,
    )


# ------------------------------------------------------------------------------------------ errors


@dataclass(frozen=True, slots=True)
class _Sample:
    """Logarithms of the errors of a cell, new and old; element by element of equal seeds when
    ``paired``."""

    key: Key
    new: Array
    old: Array
    paired: bool


def _sample(key: Key, new: Mapping[int, Trial], old: Mapping[int, Trial]) -> _Sample | None:
    """None with too few flights. Seeds pair up when at least half of the smaller side has them."""
    a, b = _logarithms(new), _logarithms(old)
    seeds = sorted(a.keys() & b.keys())
    smaller = min(len(a), len(b))
    if len(seeds) >= MIN_FLIGHTS and 2 * len(seeds) >= smaller:
        x, y = (np.array([logs[seed] for seed in seeds]) for logs in (a, b))
        return _Sample(key, x, y, True)
    if smaller < MIN_FLIGHTS:
        return None
    return _Sample(key, np.array(list(a.values())), np.array(list(b.values())), False)


def _logarithms(trials: Mapping[int, Trial]) -> dict[int, float]:
    logs = {seed: _ERROR.log_of(trial) for seed, trial in sorted(trials.items())}
    return {seed: log for seed, log in logs.items() if log is not None}


def _over_scenes(samples: Sequence[_Sample]) -> list[_Sample]:
    """One sample of all pairs for every method with several paired cells: it is the most sensitive
    to a change that all scenes share."""
    by_key = {sample.key: sample for sample in samples}
    found = []
    for total, keys in over_scenes(by_key).items():
        own = [by_key[key] for key in keys]
        if all(sample.paired for sample in own):
            new, old = (np.concatenate([getattr(s, side) for s in own]) for side in ("new", "old"))
            found.append(_Sample(total, new, old, True))
    return found


def _test(samples: Sequence[_Sample], margin: float) -> list[CellResult]:
    """Tests every sample and corrects over all of them."""
    raw = [_p_value(sample, math.log1p(margin)) for sample in samples]
    alpha = ERROR_ALPHA / max(1, len(samples))
    return [
        _result(sample, p, adjusted, alpha, margin)
        for sample, p, adjusted in zip(samples, raw, holm(raw), strict=True)
    ]


def _p_value(sample: _Sample, shift: float) -> float:
    """One-sided p that the new errors are larger by more than ``shift``, of their logarithms."""
    new = sample.new - shift
    return float(sign_flip_p(new - sample.old) if sample.paired else unpaired_p(new, sample.old))


def _result(sample: _Sample, p: float, adjusted: float, alpha: float, margin: float) -> CellResult:
    x, y = sample.new, sample.old
    change = mean_interval(x - y) if sample.paired else difference_interval(x, y)
    assert change is not None
    ratio = exponential(change)
    effect, deviation, spread = _power(sample, alpha)
    scene, method, variant = sample.key
    return CellResult(
        scene=scene,
        method=method,
        variant=variant,
        test="paired" if sample.paired else "unpaired",
        flights=min(len(x), len(y)),
        error_m=float(np.exp(x).mean()),
        error_before_m=float(np.exp(y).mean()),
        ratio=ratio.value,
        ratio_low=ratio.low,
        ratio_high=ratio.high,
        p=p,
        p_adjusted=adjusted,
        detectable=None if effect is None else (1.0 + margin) * math.exp(effect * deviation),
        spread=spread,
        worse=adjusted <= ERROR_ALPHA,
    )


def _power(sample: _Sample, alpha: float) -> tuple[float | None, float, str]:
    """Detectable effect in standard deviations, the standard deviation, and its source."""
    x, y = sample.new, sample.old
    freedom = max(1, len(x) + len(y) - 2)
    pooled = math.sqrt((x.var() * len(x) + y.var() * len(y)) / freedom)
    if not sample.paired:
        return detectable_unpaired(len(x), len(y), alpha), pooled, "seeds"
    deviation, spread = float(np.std(x - y, ddof=1)), "pairs"
    if deviation < 1e-9:
        # Equal flights have no spread; that between seeds is an upper bound.
        deviation, spread = math.sqrt(2.0) * pooled, "seeds, at most"
    return detectable_paired(len(x), alpha), deviation, spread


# ---------------------------------------------------------------------------------------- outcomes


def _compare_outcomes(pairs: Pairs) -> list[OutcomeResult]:
    """Fisher's test per cell, and per method over all its cells where it has several."""
    counts = {key: _outcome_counts(*both) for key, both in pairs.items()}
    for total, keys in over_scenes(pairs).items():
        own = [counts[key] for key in keys]
        counts[total] = {name: sum(one[name] for one in own) for name in own[0]}
    raw = [fisher_p(**counted) for counted in counts.values()]
    return [
        OutcomeResult(
            name=cell_name(key), **counted, p=p, p_adjusted=adjusted,
            worse=adjusted <= OUTCOME_ALPHA,
        )
        for (key, counted), p, adjusted in zip(counts.items(), raw, holm(raw), strict=True)
    ]  # fmt: skip


def _outcome_counts(new: Mapping[int, Trial], old: Mapping[int, Trial]) -> dict[str, int]:
    """Unsuccessful and all flights, now and in the baseline, as `fisher_p` takes them."""
    bad, bad_before = (sum(trial.bad for trial in trials.values()) for trials in (new, old))
    return {"bad": bad, "flights": len(new), "bad_before": bad_before, "flights_before": len(old)}


def _absent(these: Cells, those: Cells) -> list[str]:
    """Cells, and seeds of common cells, of ``these`` that ``those`` lack."""
    lines = []
    for key, trials in sorted(these.items()):
        seeds = sorted(trials.keys() - those.get(key, {}).keys())
        if key not in those:
            lines.append(cell_name(key))
        elif seeds:
            lines.append(f"{cell_name(key)}: seed {', '.join(map(str, seeds))}")
    return lines


def _vanished(pairs: Pairs) -> dict[Key, str]:
    """Returns the cells that are worse without a test, each with the reason.

    Either no flight has a position error and some had one in the baseline, or more than half of the
    successful flights with an error are lost. Equal seeds are compared; without any, the fractions.
    """
    found = {}
    for key, (new, old) in pairs.items():
        seeds = new.keys() & old.keys()
        now = [new[seed] for seed in seeds] or list(new.values())
        before = [old[seed] for seed in seeds] or list(old.values())
        had, has = (sum(METRIC in t.figures for t in trials) for trials in (before, now))
        successes, kept = (
            sum(METRIC in t.figures and not t.bad for t in trials) for trials in (before, now)
        )
        if had and not has:
            found[key] = (
                f"no flight comes to a position error, {had} of {len(before)} did in the baseline"
            )
        elif 2 * kept * len(before) < successes * len(now):
            found[key] = (
                f"{kept} of {len(now)} flights end as they should, "
                f"{successes} of {len(before)} did in the baseline"
            )
    return found


# ------------------------------------------------------------------------------------------- words


def verdict_sentences(found: Comparison) -> list[str]:
    """Returns one line per regression with its size and p; the last line states the cells without
    power."""
    lines = [f"WORSE  {line}" for line in found.vanished]
    lines += [
        f"WORSE  {cell.name}: position error {cell.error_m:.4g} m, was "
        f"{cell.error_before_m:.4g} m: {cell.ratio_text(' times')}, "
        f"adjusted p = {cell.p_adjusted:.2g}, {cell.flights} flights, {cell.test}"
        for cell in found.cells
        if cell.worse
    ]
    lines += [
        f"WORSE  {one.name}: {one.bad} of {one.flights} flights did not end as they should, was "
        f"{one.bad_before} of {one.flights_before}, adjusted p = {one.p_adjusted:.2g}"
        for one in found.outcomes
        if one.worse
    ]
    if not lines and found.cells:
        limit = f" by more than {100 * found.margin:g} %" if found.margin else ""
        lines.append(f"Nothing got worse{limit} beyond chance in {_comparisons(len(found.cells))}.")
    lines += _power_sentences(found)
    lines += [f"newly lost: {line}" for line in found.newly_bad]
    lines += [f"missing: {line}" for line in found.missing]
    lines += [f"not in the baseline: {line}" for line in found.added]
    lines += [f"note: {line}" for line in found.warnings]
    return lines + _blind_sentences(found)


def _power_sentences(found: Comparison) -> list[str]:
    """The smallest and the largest detectable change of the cells."""
    seen = sorted(
        (cell for cell in found.cells if cell.detectable is not None),
        key=lambda cell: cell.detectable or 0.0,
    )
    if not seen:
        return []
    ends = dict.fromkeys(f"{c.detectable_text} times in {c.name}" for c in (seen[0], seen[-1]))
    return [f"Smallest change that would have been found with 80 % power: {', '.join(ends)}."]


def _blind_sentences(found: Comparison) -> list[str]:
    """The last line: cells with too few flights to find any change, and the number needed."""
    needed = min_pairs(ERROR_ALPHA / max(1, len(found.cells)))
    if not found.cells:
        return [
            f"Nothing was compared: no scene and method has {MIN_FLIGHTS} flights with a position "
            f"error both here and in the baseline; fly at least {needed} equal seeds."
        ]
    blind = found.blind
    if not blind:
        return []
    return [
        f"No change could have been found in {len(blind)} of {_comparisons(len(found.cells))} "
        f"({', '.join(blind[:4])}{', ...' if len(blind) > 4 else ''}): one needs {needed} equal "
        "seeds."
    ]


def _comparisons(count: int) -> str:
    return f"{count} comparison{'s' * (count != 1)}"


def table_lines(found: Comparison) -> list[str]:
    """Returns a Markdown table with one line per cell, the smallest p first."""
    header = ["scene, method", "error (m)", "was (m)", "ratio", "adjusted p", "detectable ratio",
              "test"]  # fmt: skip
    rows = [
        [cell.name, f"{cell.error_m:.4g}", f"{cell.error_before_m:.4g}", cell.ratio_text(),
         f"{cell.p_adjusted:.2g}", cell.detectable_text, f"{cell.test}, {cell.flights}"]
        for cell in sorted(found.cells, key=lambda cell: (cell.p_adjusted, -cell.ratio))
    ]  # fmt: skip
    return markdown_lines(header, rows)
