"""Intervals, tests and power over flights; everything is seeded.

Flights that share random draws are not independent: with ``units``, the number or name of what each
flight shares its draws with, intervals are over units (clusters) and not over flights. Wilson's
interval, Welch's and Fisher's tests are of scipy, the power of t tests is of statsmodels.
Resampling is one matrix product over all cells of equally many flights: on ten flights
`scipy.stats.bootstrap` takes 9 times as long, `permutation_test` 1000 times (40 cells, exact).
"""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any
from zlib import crc32

import numpy as np
from scipy import stats

from touchdown.sim.typing import Array

CONFIDENCE = 0.95
RESAMPLES = 10_000
EXACT_PAIRS = 12
"""up to this many pairs every pattern of signs is tried"""
POWER = 0.8

INTERVAL = (
    "95 % bootstrap interval over independent units (flights that share random draws count as "
    "one), percentiles widened for small samples (Hesterberg 2015)"
)


def _rng(name: str, *numbers: int) -> np.random.Generator:
    return np.random.default_rng([0, crc32(name.encode()), *numbers])


@functools.lru_cache(maxsize=64)
def bootstrap_weights(flights: int, stream: str = "bootstrap") -> Array:
    """(RESAMPLES, flights): number of draws of each flight over the number of flights.

    Different values of ``stream`` give independent draws; equal ones give equal draws.
    """
    even = np.full(flights, 1.0 / flights)
    counts = _rng(stream, flights).multinomial(flights, even, size=RESAMPLES)
    return counts / flights


def _tail(flights: int) -> float:
    """Lower quantile of the bootstrap distribution that gives the width of Student's interval.

    Plain percentiles are too narrow by sqrt((n-1)/n) and by normal against Student quantiles; the
    widened ones put both right (T. Hesterberg, What teachers should know about the bootstrap,
    The American Statistician 69(4), 2015, section 4.2).
    """
    student = float(stats.t.ppf(0.5 + CONFIDENCE / 2.0, flights - 1))
    return float(stats.norm.cdf(-math.sqrt(flights / (flights - 1)) * student))


@dataclass(frozen=True, slots=True)
class Estimate:
    """A figure over ``flights`` flights of ``units`` independent units; ``low`` and ``high`` are
    None for fewer than three units: of two, resampling draws nothing but the two and their mean."""

    value: float
    low: float | None
    high: float | None
    flights: int
    units: int

    def excludes(self, other: float) -> bool:
        """True if ``other`` lies outside of the interval; False without an interval."""
        if self.low is None or self.high is None:
            return False
        return not self.low <= other <= self.high

    def as_json(self) -> dict[str, float | int | None]:
        return asdict(self)


def mean_interval(
    values: Sequence[float] | Array, units: Sequence[Any] | None = None
) -> Estimate | None:
    """Mean over flights with its interval; None without a value."""
    return _resampled(np.asarray(values, dtype=np.float64), lambda mean: mean, units)


def ratio_interval(
    pairs: Sequence[tuple[float, float]] | Array, units: Sequence[Any] | None = None
) -> Estimate | None:
    """Ratio of the means of paired values, the first over the second, pairs resampled together;
    None without a pair or with a second value that is not positive."""
    sample = np.asarray(pairs, dtype=np.float64).reshape(-1, 2)
    if not (sample[:, 1] > 0.0).all():
        return None
    return _resampled(sample, lambda mean: mean[..., 0] / mean[..., 1], units)


def variance_interval(
    means: Sequence[float] | Array,
    variances: Sequence[float] | Array,
    units: Sequence[Any] | None = None,
) -> Estimate | None:
    """Pooled variance with equal weights of flights: mean of their variances plus variance of their
    means."""
    mean, within = np.asarray(means, dtype=np.float64), np.asarray(variances, dtype=np.float64)
    moments = np.column_stack([within + mean**2, mean])
    return _resampled(moments, lambda m: np.maximum(m[..., 0] - m[..., 1] ** 2, 0.0), units)


def difference_interval(new: Array, old: Array) -> Estimate:
    """Difference of the means of two independent samples, each resampled on its own."""
    drawn = bootstrap_weights(len(new), "new") @ new - bootstrap_weights(len(old), "old") @ old
    flights = min(len(new), len(old))
    return _interval(float(new.mean() - old.mean()), drawn, flights, flights)


def _resampled(
    sample: Array, figure: Callable[[Array], Any], units: Sequence[Any] | None = None
) -> Estimate | None:
    """``figure`` of the means over flights of a sample (flights,) or (flights, columns), of arrays
    of which it takes the last axis; None without a flight. Units are drawn with all their
    flights."""
    if not len(sample):
        return None
    value = float(figure(sample.mean(axis=0)))
    sums, sizes = _by_unit(sample, units)
    drawn = bootstrap_weights(len(sizes)) @ sums
    if len(sizes) < len(sample):
        drawn = (drawn.T / (bootstrap_weights(len(sizes)) @ sizes)).T
    return _interval(value, figure(drawn), len(sample), len(sizes))


def _by_unit(sample: Array, units: Sequence[Any] | None) -> tuple[Array, Array]:
    """The sums (units,) or (units, columns) of a sample, and the number of flights (units,)."""
    if units is None:
        return sample, np.ones(len(sample))
    _, codes = np.unique(np.asarray(units, dtype=str), return_inverse=True)
    sums = np.zeros((codes.max() + 1, *sample.shape[1:]))
    np.add.at(sums, codes, sample)
    return sums, np.bincount(codes).astype(np.float64)


def _interval(value: float, drawn: Array, flights: int, units: int) -> Estimate:
    if units < 3:
        return Estimate(value, None, None, flights, units)
    tail = _tail(units)
    low, high = np.quantile(drawn, (tail, 1.0 - tail))
    return Estimate(value, float(low), float(high), flights, units)


def fraction_interval(hits: int, flights: int) -> Estimate:
    """A fraction with Wilson's score interval (JASA 22, 1927)."""
    interval = stats.binomtest(hits, flights).proportion_ci(CONFIDENCE, method="wilson")
    return Estimate(hits / flights, float(interval.low), float(interval.high), flights, flights)


def clustered_fraction(hits: Sequence[bool] | Array, units: Sequence[Any]) -> Estimate:
    """The fraction of the flights that ``hits`` names, with Wilson's interval of the effective
    number of flights: that whose binomial variance is the variance between units (Kish, Survey
    Sampling, 1965, section 8.2), from the number of units to that of flights. Where no two units
    differ it is that of units."""
    sample = np.asarray(hits, dtype=np.float64)
    sums, sizes = _by_unit(sample, units)
    flights, k, value = len(sample), len(sizes), float(sample.mean())
    if k == flights:
        return fraction_interval(int(sample.sum()), flights)
    between = k / max(k - 1, 1) * float(np.sum((sums - value * sizes) ** 2)) / flights**2
    effective = value * (1.0 - value) / between if between > 0.0 else 0.0
    from statsmodels.stats.proportion import proportion_confint

    number = min(max(effective, k), flights)
    low, high = proportion_confint(value * number, number, 1.0 - CONFIDENCE, method="wilson")
    return Estimate(value, float(low), float(high), flights, k)


def geometric_ratio(
    over: Array, under: Array, units: Sequence[Any] | None = None
) -> Estimate | None:
    """Ratio of the geometric means of pairs (n,); None where a value is not positive."""
    if not (np.all(over > 0.0) and np.all(under > 0.0)):
        return None
    found = mean_interval(np.log(over / under), units)
    return None if found is None else exponential(found)


def exponential(log: Estimate) -> Estimate:
    """The estimate of a figure of that of its logarithm."""
    low, high = (None if end is None else math.exp(end) for end in (log.low, log.high))
    return Estimate(math.exp(log.value), low, high, log.flights, log.units)


def student_interval(values: Sequence[float]) -> Estimate:
    """Mean of at least two values with Student's interval."""
    low, high = stats.ttest_1samp(values, 0.0).confidence_interval(CONFIDENCE)
    return Estimate(float(np.mean(values)), float(low), float(high), len(values), len(values))


def rank_correlation(a: Array, b: Array, units: Sequence[Any] | None = None) -> Estimate | None:
    """Spearman's correlation of pairs (n,) with the interval by Fisher's z of as many pairs as
    there are units; None where one side does not vary or units are fewer than five."""
    independent = len(a) if units is None else len(set(units))
    if independent < 5 or np.ptp(a) == 0.0 or np.ptp(b) == 0.0:
        return None
    value = float(stats.spearmanr(a, b).statistic)
    half = float(stats.norm.ppf(0.5 + CONFIDENCE / 2.0)) / math.sqrt(independent - 3)
    with np.errstate(divide="ignore"):  # perfect correlation has no width
        low, high = np.tanh(np.arctanh(value) + np.array([-half, half]))
    return Estimate(value, float(low), float(high), len(a), independent)


@functools.lru_cache(maxsize=64)
def _signs(pairs: int) -> tuple[Array, bool]:
    """(flips, pairs) of -1 and 1; True with all existing patterns."""
    if pairs <= EXACT_PAIRS:
        codes = np.arange(2**pairs)[:, None] >> np.arange(pairs)
        return np.where(codes & 1, -1.0, 1.0), True
    drawn = _rng("signs", pairs).integers(0, 2, size=(2 * RESAMPLES, pairs))
    return np.where(drawn, -1.0, 1.0), False


def sign_flip_p(differences: Array) -> Any:
    """One-sided p of "the differences are symmetric about zero" against "greater".

    ``differences`` is (pairs,) or (pairs, cells); the answer a number or (cells,). The statistic is
    the mean. Exact for at most ``EXACT_PAIRS`` pairs, otherwise over 20 000 seeded patterns of
    signs, the observed one counted in.
    """
    signs, exact = _signs(differences.shape[0])
    observed = differences.sum(axis=0)
    # Rounding must not make the observed pattern, or ties with it, look smaller than it is.
    slack = 1e-9 * np.abs(differences).sum(axis=0) + 1e-300
    reached = (signs @ differences >= observed - slack).sum(axis=0)
    return reached / len(signs) if exact else (reached + 1) / (len(signs) + 1)


def unpaired_p(new: Array, old: Array) -> float:
    """One-sided p of Welch's t test of "two independent samples have one mean" against "new is
    greater on average"."""
    sides = [figure for s in (new, old) for figure in (s.mean(), s.std(ddof=1), len(s))]
    p = stats.ttest_ind_from_stats(*sides, equal_var=False, alternative="greater").pvalue
    return 1.0 if math.isnan(p) else float(p)  # neither varies, and both are equal


def fisher_p(bad: int, flights: int, bad_before: int, flights_before: int) -> float:
    """One-sided p of Fisher's exact test that the fraction of bad flights has grown."""
    table = [[bad, flights - bad], [bad_before, flights_before - bad_before]]
    return float(stats.fisher_exact(table, alternative="greater")[1])


def holm(p_values: Sequence[float]) -> list[float]:
    """Holm's adjusted p (Scandinavian Journal of Statistics 6, 1979), in the order given."""
    # `statsmodels.stats.multitest.multipletests` takes 48 ms a call, 1000 times as long.
    p = np.asarray(p_values, dtype=np.float64)
    order = np.argsort(p, kind="stable")
    steps = np.maximum.accumulate(p[order] * np.arange(p.size, 0, -1)) if p.size else p
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(steps, 1.0)
    return [float(value) for value in adjusted]


def min_pairs(alpha: float) -> int:
    """Fewest pairs with which the one-sided sign-flip test can reach ``alpha``."""
    return math.ceil(-math.log2(alpha))


@functools.lru_cache(maxsize=64)
def detectable_paired(pairs: int, alpha: float) -> float | None:
    """Smallest mean difference, in standard deviations of the differences, that the sign-flip test
    finds with 80 % power at level ``alpha`` (normal differences); None where it never can."""
    if pairs < 2 or 0.5**pairs > alpha:
        return None
    if pairs > EXACT_PAIRS:
        from statsmodels.stats.power import TTestPower

        found = TTestPower().solve_power(nobs=pairs, alpha=alpha, power=POWER, alternative="larger")
        return float(found)
    noise = _rng("power", pairs).standard_normal((pairs, 2000))
    low, high = 0.0, 10.0
    for _ in range(9):
        middle = 0.5 * (low + high)
        found = float((sign_flip_p(noise + middle) <= alpha).mean())
        low, high = (low, middle) if found >= POWER else (middle, high)
    return high


@functools.lru_cache(maxsize=64)
def detectable_unpaired(flights: int, flights_before: int, alpha: float) -> float | None:
    """The same for two independent samples, in standard deviations of one of them."""
    if min(flights, flights_before) < 2:
        return None
    from statsmodels.stats.power import TTestIndPower

    found = TTestIndPower().solve_power(
        nobs1=flights,
        ratio=flights_before / flights,
        alpha=alpha,
        power=POWER,
        alternative="larger",
    )
    return float(found)
