"""Regression test of the position error: the flights of a directory against a baseline.

The measure is the mean position error of a flight. Logarithms are compared, so that a change is a
ratio and easy and hard scenes weigh the same. A *cell* is a scene with a method.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.errors import UsageError
from touchdown.experiments.reporting.flights import Row
from touchdown.experiments.reporting.regression.baseline import (
    Baseline,
    Key,
    Trial,
    cell_name,
    cells_of,
    configuration_sha,
)
from touchdown.experiments.reporting.regression.missing_runs import (
    Pairs,
    absent,
    newly_bad,
    vanished,
)
from touchdown.experiments.reporting.statistics import (
    Estimate,
    detectable_paired,
    detectable_unpaired,
    difference_interval,
    fisher_p,
    holm,
    mean_interval,
    sign_flip_p,
    unpaired_p,
)

Array = NDArray[np.float64]

ERROR_ALPHA, OUTCOME_ALPHA = 0.04, 0.01
"""Shares of the 5 % of false alarms of a whole comparison: most for errors, where exact tests of
ten pairs can reach it in up to 40 cells, the rest on outcomes."""
ERROR_FLOOR_M = 1e-4
"""Smaller errors count as a tenth of a millimetre, so that logarithms stay finite."""
FEWEST = 2
ALL_SCENES = "all scenes"


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
    """cells that count as worse without a test, see
    `experiments.reporting.regression.missing_runs.vanished`"""
    newly_bad: list[str]
    missing: list[str]
    """cells and seeds of the baseline that the directory lacks"""
    added: list[str]
    """cells and seeds of the directory that the baseline lacks"""
    warnings: list[str]
    margin: float
    baseline_revision: str | None
    regressed: bool = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(
            self,
            "regressed",
            bool(self.vanished)
            or any(cell.worse for cell in self.cells)
            or any(o.worse for o in self.outcomes),
        )

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
        return found


# --------------------------------------------------------------------------------- the comparison


def compare(rows: Sequence[Row], baseline: Baseline, margin: float = 0.0) -> Comparison:
    """Compares flights with the baseline: worse beyond chance and by more than ``margin``.

    ``margin`` is a share: 0.1 asks whether errors grew by more than 10 %. Raises UsageError when
    the two have no cell in common.
    """
    new, old = cells_of(rows), baseline.cells
    common = sorted(new.keys() & old.keys())
    if not common:
        raise UsageError(
            f"the baseline has no cell of these flights; it has "
            f"{'; '.join(cell_name(key) for key in sorted(old)[:6]) or 'none'}"
        )
    samples = [found for key in common if (found := _sample(key, new[key], old[key])) is not None]
    cells = _test([*samples, *_over_scenes(samples)], margin)
    pairs = {key: (new[key], old[key]) for key in common}
    gone = vanished(pairs)
    measured = {sample.key for sample in samples} | gone.keys()
    warnings = [
        f"{cell_name(key)}: too few flights with an error to compare"
        for key in common
        if key not in measured
    ]
    if configuration_sha(rows) != baseline.config_sha:
        warnings.append(
            "configurations or the set of runs differ from the baseline's: a change may come from "
            "them"
        )
    return Comparison(
        cells=cells,
        outcomes=_compare_outcomes(pairs),
        vanished=[f"{cell_name(key)}: {why}" for key, why in gone.items()],
        newly_bad=newly_bad(pairs),
        missing=absent(old, new),
        added=absent(new, old),
        warnings=warnings,
        margin=margin,
        baseline_revision=baseline.git_revision,
    )


def _errors(trials: Mapping[int, Trial]) -> dict[int, float]:
    return {
        seed: math.log(max(trial.error_m, ERROR_FLOOR_M))
        for seed, trial in sorted(trials.items())
        if trial.error_m is not None
    }


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
    a, b = _errors(new), _errors(old)
    seeds = sorted(a.keys() & b.keys())
    fewest = min(len(a), len(b))
    if len(seeds) >= FEWEST and 2 * len(seeds) >= fewest:
        x, y = (np.array([logs[seed] for seed in seeds]) for logs in (a, b))
        return _Sample(key, x, y, True)
    if fewest < FEWEST:
        return None
    return _Sample(key, np.array(list(a.values())), np.array(list(b.values())), False)


def _over_scenes(samples: Sequence[_Sample]) -> list[_Sample]:
    """One sample of all pairs for every method with several paired cells: it is the most sensitive
    to a change that all scenes share."""
    found = []
    for method in sorted({sample.key[1] for sample in samples}):
        own = [sample for sample in samples if sample.key[1] == method]
        if len(own) > 1 and all(sample.paired for sample in own):
            x, y = (
                np.concatenate(side) for side in zip(*((s.new, s.old) for s in own), strict=True)
            )
            found.append(_Sample((ALL_SCENES, method, ""), x, y, True))
    return found


def _test(samples: Sequence[_Sample], margin: float) -> list[CellResult]:
    """Tests every sample and corrects over all of them."""
    raw = _p_values(samples, math.log1p(margin))
    alpha = ERROR_ALPHA / max(1, len(samples))
    return [
        _result(sample, p, adjusted, alpha, margin)
        for sample, p, adjusted in zip(samples, raw, holm(raw), strict=True)
    ]


def _p_values(samples: Sequence[_Sample], shift: float) -> list[float]:
    """One p per sample; samples of equal shape are tested by one matrix product."""
    groups: dict[tuple[bool, int, int], list[int]] = {}
    for index, sample in enumerate(samples):
        shape = (sample.paired, len(sample.new), len(sample.old))
        groups.setdefault(shape, []).append(index)
    found = np.ones(len(samples))
    for (paired, _, _), members in groups.items():
        new = np.column_stack([samples[index].new for index in members]) - shift
        old = np.column_stack([samples[index].old for index in members])
        found[members] = sign_flip_p(new - old) if paired else unpaired_p(new, old)
    return [float(p) for p in found]


def _result(sample: _Sample, p: float, adjusted: float, alpha: float, margin: float) -> CellResult:
    x, y = sample.new, sample.old
    change = mean_interval(x - y) if sample.paired else difference_interval(x, y)
    assert change is not None
    effect, deviation, spread = _power(sample, alpha)
    scene, method, variant = sample.key
    return CellResult(
        scene=scene,
        method=method,
        variant=variant,
        test="paired" if sample.paired else "unpaired",
        flights=len(x) if sample.paired else min(len(x), len(y)),
        error_m=float(np.exp(x).mean()),
        error_before_m=float(np.exp(y).mean()),
        **_as_ratio(change),
        p=p,
        p_adjusted=adjusted,
        detectable=None if effect is None else (1.0 + margin) * math.exp(effect * deviation),
        spread=spread,
        worse=adjusted <= ERROR_ALPHA,
    )


def _power(sample: _Sample, alpha: float) -> tuple[float | None, float, str]:
    """Detectable effect in standard deviations, the standard deviation, and its source."""
    x, y = sample.new, sample.old
    if not sample.paired:
        return detectable_unpaired(len(x), len(y), alpha), _pooled_deviation(x, y), "seeds"
    deviation, spread = float(np.std(x - y, ddof=1)), "pairs"
    if deviation < 1e-9:
        # Equal flights have no spread; that between seeds is an upper bound.
        deviation, spread = math.sqrt(2.0) * _pooled_deviation(x, y), "seeds, at most"
    return detectable_paired(len(x), alpha), deviation, spread


def _pooled_deviation(x: Array, y: Array) -> float:
    freedom = max(1, len(x) + len(y) - 2)
    return math.sqrt((x.var() * len(x) + y.var() * len(y)) / freedom)


def _as_ratio(change: Estimate) -> dict[str, Any]:
    low, high = change.low, change.high
    return {
        "ratio": math.exp(change.value),
        "ratio_low": None if low is None else math.exp(low),
        "ratio_high": None if high is None else math.exp(high),
    }


# ------------------------------------------------------------------------------------- outcomes


class _OutcomeCounts(NamedTuple):
    """Unsuccessful and all flights, now and in the baseline, in the order of `fisher_p`."""

    bad: int
    flights: int
    bad_before: int
    flights_before: int


def _compare_outcomes(pairs: Pairs) -> list[OutcomeResult]:
    """Fisher's test per cell, and per method over all its cells where it has several."""
    by_cell = {key: _outcome_counts(new, old) for key, (new, old) in pairs.items()}
    counts = {cell_name(key): found for key, found in by_cell.items()}
    counts |= _counts_over_scenes(by_cell)
    raw = [fisher_p(*found) for found in counts.values()]
    return [
        OutcomeResult(
            name=name, **found._asdict(), p=p, p_adjusted=adjusted, worse=adjusted <= OUTCOME_ALPHA
        )
        for (name, found), p, adjusted in zip(counts.items(), raw, holm(raw), strict=True)
    ]


def _outcome_counts(new: Mapping[int, Trial], old: Mapping[int, Trial]) -> _OutcomeCounts:
    bad, bad_before = (sum(trial.bad for trial in trials.values()) for trials in (new, old))
    return _OutcomeCounts(bad, len(new), bad_before, len(old))


def _counts_over_scenes(by_cell: Mapping[Key, _OutcomeCounts]) -> dict[str, _OutcomeCounts]:
    """Sums by method, of the methods with several cells."""
    import pyarrow as pa

    rows = [
        {"row": row, "method": method, **found._asdict()}
        for row, ((_, method, _), found) in enumerate(by_cell.items())
    ]
    sums = [(name, "sum") for name in _OutcomeCounts._fields]
    groups = pa.Table.from_pylist(rows).group_by("method", use_threads=False)
    totals = groups.aggregate([("row", "count"), ("row", "min"), *sums]).sort_by("row_min")
    return {
        cell_name((ALL_SCENES, total["method"], "")): _OutcomeCounts(
            **{name: total[f"{name}_sum"] for name in _OutcomeCounts._fields}
        )
        for total in totals.to_pylist()
        if total["row_count"] > 1
    }
