"""Regression test of the position error: the flights of a directory against a baseline.

Logarithms are compared, so that a change is a ratio and easy and hard scenes weigh the same.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np

from touchdown.experiments.config.settings import difference_text
from touchdown.experiments.errors import UsageError
from touchdown.experiments.reporting import statistics
from touchdown.experiments.reporting.flights import Row
from touchdown.experiments.reporting.regression.baseline import (
    ERROR,
    METRIC,
    Baseline,
    Key,
    Pairs,
    Trials,
    cell_name,
    cells_of,
    common_config,
    configuration_sha,
    newly_bad,
    over_scenes,
)
from touchdown.experiments.reporting.tables import markdown_lines
from touchdown.sim.typing import Array

ERROR_ALPHA, OUTCOME_ALPHA = 0.04, 0.01
"""Parts of the 5 % of false alarms of a whole comparison: most for errors, where exact tests of
ten pairs can reach it in up to 40 cells, the rest on outcomes."""
MIN_FLIGHTS = 2


@dataclass(frozen=True, kw_only=True, slots=True)
class CellResult:
    """The position error of a cell. ``ratio`` is new over old; ``detectable`` the smallest ratio
    that would have been found with 80 % power, None where no change could have been, with
    ``at_most`` an upper bound of it, since the flights are equal."""

    name: str
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
    at_most: bool
    worse: bool

    def ratio_text(self, unit: str = "") -> str:
        interval = ""
        if self.ratio_low is not None and self.ratio_high is not None:
            interval = f" [{self.ratio_low:.3g}, {self.ratio_high:.3g}]"
        return f"{self.ratio:.3g}{unit}{interval}"

    @property
    def detectable_text(self) -> str:
        if self.detectable is None:
            return "–"
        return f"{'at most ' * self.at_most}{self.detectable:.3g}"


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
    """``vanished``: cells that count as worse without a test, see `_why_vanished`; ``missing``:
    cells and seeds of the baseline that the directory lacks; ``added``: the reverse."""

    cells: list[CellResult]
    outcomes: list[OutcomeResult]
    vanished: list[str]
    newly_bad: list[str]
    missing: list[str]
    added: list[str]
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
        return found | {"regressed": self.regressed, "words": verdict_sentences(self)}


def compare(rows: Sequence[Row], baseline: Baseline, margin: float = 0.0) -> Comparison:
    """Compares flights with the baseline: worse beyond chance and by more than ``margin``.

    ``margin`` is a fraction: 0.1 asks whether errors grew by more than 10 %. Raises UsageError when
    the two have no cell in common.
    """
    new, old = cells_of(rows), baseline.trials
    pairs = {key: (new[key], old[key]) for key in sorted(new.keys() & old.keys())}
    if not pairs:
        raise UsageError(f"the baseline has no cell of these flights; it has {baseline.some_cells}")
    samples = {key: found for key, both in pairs.items() if (found := _sample(*both)) is not None}
    gone = {key: why for key, both in pairs.items() if (why := _why_vanished(*both))}
    warnings = [
        f"{cell_name(key)}: too few flights with an error to compare"
        for key in pairs
        if key not in samples and key not in gone
    ]
    if configuration_sha(rows) != baseline.config_sha:
        now = common_config(rows)
        before = {key: value for key, value in baseline.config.items() if key in now}
        apart = difference_text(before, {key: now[key] for key in before})
        what = f"configurations ({apart})" if apart else "configurations or the set of runs"
        warnings.append(f"{what} differ from the baseline's: a change may come from them")
    return Comparison(
        cells=_test(samples | _pooled(samples), margin),
        outcomes=_compare_outcomes(pairs),
        vanished=[f"{cell_name(key)}: {why}" for key, why in gone.items()],
        newly_bad=newly_bad(pairs),
        missing=_absent(old, new),
        added=_absent(new, old),
        warnings=warnings,
        margin=margin,
        baseline_revision=baseline.git_revision,
    )


class _Sample(NamedTuple):
    """Logarithms of the errors of a cell, new and old; element by element of equal seeds when
    ``paired``."""

    new: Array
    old: Array
    paired: bool


def _sample(new: Trials, old: Trials) -> _Sample | None:
    """None with too few flights. Seeds pair up when at least half of the smaller side has them."""
    a, b = (
        {
            seed: log
            for seed, t in sorted(ts.items())
            if (log := ERROR.log_of(t.figures)) is not None
        }
        for ts in (new, old)
    )
    seeds = sorted(a.keys() & b.keys())
    smaller = min(len(a), len(b))
    paired = len(seeds) >= MIN_FLIGHTS and 2 * len(seeds) >= smaller
    if not paired and smaller < MIN_FLIGHTS:
        return None
    x, y = (np.array([logs[seed] for seed in (seeds if paired else logs)]) for logs in (a, b))
    return _Sample(x, y, paired)


def _pooled(samples: Mapping[Key, _Sample]) -> dict[Key, _Sample]:
    """One sample of all pairs for every method with several paired cells: it is the most sensitive
    to a change that all scenes share."""
    found = {}
    for total, keys in over_scenes(samples).items():
        own = [samples[key] for key in keys]
        if all(sample.paired for sample in own):
            new, old, _ = zip(*own, strict=True)
            found[total] = _Sample(np.concatenate(new), np.concatenate(old), True)
    return found


def _test(samples: Mapping[Key, _Sample], margin: float) -> list[CellResult]:
    """Tests every sample and corrects over all of them."""
    raw = [_p_value(sample, math.log1p(margin)) for sample in samples.values()]
    alpha = ERROR_ALPHA / max(1, len(samples))
    found = []
    for (key, sample), p, adjusted in zip(samples.items(), raw, statistics.holm(raw), strict=True):
        x, y, paired = sample
        change = statistics.mean_interval(x - y) if paired else statistics.difference_interval(x, y)
        assert change is not None
        ratio = statistics.exponential(change)
        detectable, at_most = _detectable(sample, alpha)
        found.append(
            CellResult(
                name=cell_name(key),
                test="paired" if paired else "unpaired",
                flights=min(len(x), len(y)),
                error_m=float(np.exp(x).mean()),
                error_before_m=float(np.exp(y).mean()),
                ratio=ratio.value,
                ratio_low=ratio.low,
                ratio_high=ratio.high,
                p=p,
                p_adjusted=adjusted,
                detectable=None if detectable is None else (1.0 + margin) * detectable,
                at_most=at_most,
                worse=adjusted <= ERROR_ALPHA,
            )
        )
    return found


def _p_value(sample: _Sample, shift: float) -> float:
    """One-sided p that the new errors are larger by more than ``shift``, of their logarithms."""
    new, old = sample.new - shift, sample.old
    return statistics.sign_flip_p(new - old) if sample.paired else statistics.unpaired_p(new, old)


def _detectable(sample: _Sample, alpha: float) -> tuple[float | None, bool]:
    """The detectable ratio, and whether it is an upper bound: equal flights have no spread, and
    that between seeds stands for it."""
    x, y, paired = sample
    freedom = max(1, len(x) + len(y) - 2)
    spread = math.sqrt((x.var() * len(x) + y.var() * len(y)) / freedom)
    if paired:
        effect = statistics.detectable_paired(len(x), alpha)
        of_pairs = float(np.std(x - y, ddof=1))
        at_most = of_pairs < 1e-9
        spread = math.sqrt(2.0) * spread if at_most else of_pairs
    else:
        effect, at_most = statistics.detectable_unpaired(len(x), len(y), alpha), False
    return (None if effect is None else math.exp(effect * spread)), at_most


def _compare_outcomes(pairs: Pairs) -> list[OutcomeResult]:
    """Fisher's test per cell, and per method over all its cells where it has several."""
    counts = {key: np.array([*_bad(new), *_bad(old)]) for key, (new, old) in pairs.items()}
    for total, keys in over_scenes(pairs).items():
        counts[total] = np.sum([counts[key] for key in keys], axis=0)
    raw = [statistics.fisher_p(*counted) for counted in counts.values()]
    adjusted = statistics.holm(raw)
    found = []
    for (key, counted), p, corrected in zip(counts.items(), raw, adjusted, strict=True):
        bad, flights, bad_before, flights_before = map(int, counted)
        worse = corrected <= OUTCOME_ALPHA
        found.append(
            OutcomeResult(
                cell_name(key), bad, flights, bad_before, flights_before, p, corrected, worse
            )
        )
    return found


def _bad(trials: Trials) -> tuple[int, int]:
    """Numbers of unsuccessful and of all flights."""
    return sum(trial.bad for trial in trials.values()), len(trials)


def _absent(these: Mapping[Key, Trials], those: Mapping[Key, Trials]) -> list[str]:
    """Cells, and seeds of common cells, of ``these`` that ``those`` lack."""
    lines = []
    for key, trials in sorted(these.items()):
        seeds = sorted(trials.keys() - those.get(key, {}).keys())
        if key not in those:
            lines.append(cell_name(key))
        elif seeds:
            lines.append(f"{cell_name(key)}: seed {', '.join(map(str, seeds))}")
    return lines


def _why_vanished(new: Trials, old: Trials) -> str:
    """Why a cell is worse without a test; empty where it is not.

    Either no flight has a position error and some had one in the baseline, or more than half of the
    successful flights with an error are lost. Equal seeds are compared; without any, the fractions.
    """
    seeds = new.keys() & old.keys()
    now = [new[seed] for seed in seeds] or list(new.values())
    before = [old[seed] for seed in seeds] or list(old.values())
    had, has = (sum(METRIC in t.figures for t in trials) for trials in (before, now))
    successes, kept = (
        sum(METRIC in t.figures and not t.bad for t in trials) for trials in (before, now)
    )
    if had and not has:
        return f"no flight comes to a position error, {had} of {len(before)} did in the baseline"
    if 2 * kept * len(before) < successes * len(now):
        return (
            f"{kept} of {len(now)} flights end as they should, "
            f"{successes} of {len(before)} did in the baseline"
        )
    return ""


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
    compared = f"{len(found.cells)} comparison{'s' * (len(found.cells) != 1)}"
    if not lines and found.cells:
        limit = f" by more than {100 * found.margin:g} %" if found.margin else ""
        lines.append(f"Nothing got worse{limit} beyond chance in {compared}.")
    seen = [cell for cell in found.cells if cell.detectable is not None]
    if seen:
        seen.sort(key=lambda cell: cell.detectable or 0.0)
        ends = dict.fromkeys(f"{c.detectable_text} times in {c.name}" for c in (seen[0], seen[-1]))
        lines.append(f"Smallest change that would have been found with 80 % power: "
                     f"{', '.join(ends)}.")  # fmt: skip
    lines += [f"newly lost: {line}" for line in found.newly_bad]
    lines += [f"missing: {line}" for line in found.missing]
    lines += [f"not in the baseline: {line}" for line in found.added]
    lines += [f"note: {line}" for line in found.warnings]
    needed = statistics.min_pairs(ERROR_ALPHA / max(1, len(found.cells)))
    if not found.cells:
        lines.append(
            f"Nothing was compared: no scene and method has {MIN_FLIGHTS} flights with a position "
            f"error both here and in the baseline; fly at least {needed} equal seeds."
        )
    elif blind := found.blind:
        named = ", ".join([*blind[:4], *["..."] * (len(blind) > 4)])
        lines.append(
            f"No change could have been found in {len(blind)} of {compared} ({named}): one needs "
            f"{needed} equal seeds."
        )
    return lines


def comparison_lines(found: Comparison) -> list[str]:
    """A Markdown table with one line per cell, the smallest p first, and `verdict_sentences`."""
    header = ["scene, method", "error (m)", "was (m)", "ratio", "adjusted p", "detectable ratio",
              "test"]  # fmt: skip
    rows = [
        [cell.name, f"{cell.error_m:.4g}", f"{cell.error_before_m:.4g}", cell.ratio_text(),
         f"{cell.p_adjusted:.2g}", cell.detectable_text, f"{cell.test}, {cell.flights}"]
        for cell in sorted(found.cells, key=lambda cell: (cell.p_adjusted, -cell.ratio))
    ]  # fmt: skip
    table = [*markdown_lines(header, rows), ""] if rows else []
    return [*table, *verdict_sentences(found)]
