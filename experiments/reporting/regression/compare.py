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
    ALL_SCENES,
    Baseline,
    Cells,
    Key,
    Pairs,
    Trial,
    cell_name,
    cells_of,
    configuration_sha,
    newly_bad,
)
from touchdown.experiments.reporting.statistics import (
    detectable_paired,
    detectable_unpaired,
    difference_interval,
    exponential,
    fisher_p,
    holm,
    mean_interval,
    sign_flip_p,
    unpaired_p,
)

Array = NDArray[np.float64]

ERROR_ALPHA, OUTCOME_ALPHA = 0.04, 0.01
"""Parts of the 5 % of false alarms of a whole comparison: most for errors, where exact tests of
ten pairs can reach it in up to 40 cells, the rest on outcomes."""
ERROR_FLOOR_M = 1e-4
"""Smaller errors count as a tenth of a millimetre, so that logarithms stay finite."""
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


@dataclass(frozen=True, kw_only=True, slots=True)
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
    return {
        seed: math.log(max(trial.error_m, ERROR_FLOOR_M))
        for seed, trial in sorted(trials.items())
        if trial.error_m is not None
    }


def _over_scenes(samples: Sequence[_Sample]) -> list[_Sample]:
    """One sample of all pairs for every method with several paired cells: it is the most sensitive
    to a change that all scenes share."""
    found = []
    for method in sorted({sample.key[1] for sample in samples}):
        own = [sample for sample in samples if sample.key[1] == method]
        if len(own) > 1 and all(sample.paired for sample in own):
            new, old = (np.concatenate([getattr(s, side) for s in own]) for side in ("new", "old"))
            found.append(_Sample((ALL_SCENES, method, ""), new, old, True))
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
    counts = {cell_name(key): _outcome_counts(*both) for key, both in pairs.items()}
    for method in dict.fromkeys(key[1] for key in pairs):
        own = [_outcome_counts(*both) for key, both in pairs.items() if key[1] == method]
        if len(own) > 1:
            total = [sum(column) for column in zip(*own, strict=True)]
            counts[cell_name((ALL_SCENES, method, ""))] = (total[0], total[1], total[2], total[3])
    raw = [fisher_p(*found) for found in counts.values()]
    return [
        OutcomeResult(
            name=name,
            bad=bad,
            flights=flights,
            bad_before=bad_before,
            flights_before=flights_before,
            p=p,
            p_adjusted=adjusted,
            worse=adjusted <= OUTCOME_ALPHA,
        )
        for (name, (bad, flights, bad_before, flights_before)), p, adjusted in zip(
            counts.items(), raw, holm(raw), strict=True
        )
    ]


def _outcome_counts(
    new: Mapping[int, Trial], old: Mapping[int, Trial]
) -> tuple[int, int, int, int]:
    """Unsuccessful and all flights, now and in the baseline, in the order of `fisher_p`."""
    bad, bad_before = (sum(trial.bad for trial in trials.values()) for trials in (new, old))
    return bad, len(new), bad_before, len(old)


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
        had, has = (sum(t.error_m is not None for t in trials) for trials in (before, now))
        successes, kept = (
            sum(t.error_m is not None and not t.bad for t in trials) for trials in (before, now)
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
