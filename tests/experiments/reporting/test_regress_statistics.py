"""The statistics of `touchdown regress` on known answers."""

import math

import numpy as np
import pytest
from scipy.stats import norm, t

from touchdown.experiments.reporting import statistics


def test_sign_flips_by_hand() -> None:
    """Differences 1, 2, 3: of eight patterns one reaches 6, for -1, 2, 3 two reach 4."""
    assert statistics.sign_flip_p(np.array([1.0, 2.0, 3.0])) == 1 / 8
    assert statistics.sign_flip_p(np.array([-1.0, 2.0, 3.0])) == 2 / 8
    assert statistics.sign_flip_p(np.zeros(5)) == 1.0
    assert statistics.sign_flip_p(np.full(10, 0.1)) == 1 / 1024
    both = statistics.sign_flip_p(np.array([[1.0, -1.0], [2.0, -2.0], [3.0, -3.0]]))
    assert both.tolist() == [1 / 8, 1.0]


def test_many_pairs_agree_with_the_normal_limit() -> None:
    """40 pairs of unit size with mean 0.3: z = 0.3 sqrt(40) = 1.90; 26 of 40 are positive."""
    differences = np.where(np.arange(40) < 26, 1.0, -1.0)
    exact = sum(math.comb(40, k) for k in range(26, 41)) / 2**40
    assert float(statistics.sign_flip_p(differences)) == pytest.approx(exact, rel=0.1)


def test_holm_by_hand() -> None:
    assert statistics.holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert statistics.holm([0.5, 0.9]) == [1.0, 1.0] and statistics.holm([]) == []


def test_fisher_by_hand() -> None:
    """3 of 3 bad against 0 of 3: one of the 20 ways to choose them."""
    assert statistics.fisher_p(3, 3, 0, 3) == pytest.approx(1 / 20)
    assert statistics.fisher_p(0, 10, 0, 10) == 1.0


def test_two_flights_have_no_interval() -> None:
    assert statistics.mean_interval([]) is None
    for flights in (1, 2):
        found = statistics.mean_interval([0.1, 0.3][:flights])
        assert found is not None and found.low is None and found.high is None
    three = statistics.mean_interval([0.1, 0.2, 0.3])
    assert three is not None and three.low is not None and three.low == pytest.approx(0.1)


def test_wilson_by_hand() -> None:
    """10 of 10: lower end n / (n + z^2)."""
    fraction = statistics.fraction_interval(10, 10)
    assert fraction.high == pytest.approx(1.0)
    assert fraction.low == pytest.approx(10 / (10 + 1.959964**2), abs=1e-6)


def test_pooled_variance_is_that_of_all_samples_together() -> None:
    flights = np.random.default_rng(3).normal(size=(5, 400)) + np.arange(5)[:, None]
    found = statistics.variance_interval(
        flights.mean(axis=1).tolist(), flights.var(axis=1).tolist()
    )
    assert found is not None and found.value == pytest.approx(flights.var())
    assert found.low is not None and found.high is not None and found.low < found.value < found.high


def _planted(
    units: int, of_unit: int, repeats: int, between: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Normal values (repeats, flights) of mean zero that share a part by unit; units (flights,)."""
    rng = np.random.default_rng([11, units, of_unit])
    shared = rng.normal(scale=between, size=(repeats, units, 1))
    values = shared + rng.normal(size=(repeats, units, of_unit))
    return values.reshape(repeats, -1), np.repeat(np.arange(units), of_unit)


@pytest.mark.parametrize("of_unit", [1, 4])
def test_intervals_of_flights_that_share_draws_cover_as_often_as_they_say(of_unit: int) -> None:
    """25 units. Intervals over 100 flights instead of 25 units cover 0.71 of the means."""
    samples, units = _planted(25, of_unit, 500)
    means = [statistics.mean_interval(sample, units) for sample in samples]
    covered = [not found.excludes(0.0) for found in means if found is not None]
    assert 0.93 <= np.mean(covered) <= 0.97
    assert {(found.flights, found.units) for found in means if found} == {(25 * of_unit, 25)}
    if of_unit > 1:
        naive = [statistics.mean_interval(sample) for sample in samples]
        assert np.mean([not found.excludes(0.0) for found in naive if found]) < 0.85


@pytest.mark.parametrize("of_unit", [1, 4])
def test_fractions_of_flights_that_share_draws_cover_as_often_as_they_say(of_unit: int) -> None:
    """A value above the limit that 0.7 of all exceed is a hit."""
    samples, units = _planted(60, of_unit, 500)
    hits = samples > math.sqrt(2.0) * norm.ppf(0.3)
    found = [statistics.clustered_fraction(sample, units) for sample in hits]
    assert 0.93 <= np.mean([not fraction.excludes(0.7) for fraction in found]) <= 0.97


def test_units_that_all_hit_are_counted_and_not_their_flights() -> None:
    """20 of 20 flights of five seeds are five of five: the lower end is 5 / (5 + z^2)."""
    found = statistics.clustered_fraction([True] * 20, list("abcde") * 4)
    assert found.value == 1.0 and found.high == pytest.approx(1.0)
    assert found.low == pytest.approx(5 / (5 + 1.959964**2), abs=1e-6)
    assert (found.flights, found.units) == (20, 5)


def test_units_of_unequal_size_weigh_by_their_flights() -> None:
    found = statistics.mean_interval([1.0, 1.0, 1.0, 5.0, 3.0], ["a", "a", "a", "b", "c"])
    assert found is not None and found.value == pytest.approx(2.2) and found.units == 3
    assert found.low == pytest.approx(1.0) and found.high == pytest.approx(5.0)


def test_the_interval_of_a_correlation_is_of_units() -> None:
    """r = 0.5 by ranks; Fisher's z of six units: tanh(atanh 0.5 +- 1.96 / sqrt 3)."""
    a = np.arange(6.0)
    b = np.array([1.0, 3.0, 0.0, 5.0, 2.0, 4.0])
    found = statistics.rank_correlation(a, b)
    twice = statistics.rank_correlation(np.tile(a, 2), np.tile(b, 2), [*range(6)] * 2)
    assert found is not None and twice is not None and found.low is not None
    ends = np.tanh(np.arctanh(found.value) + np.array([-1.0, 1.0]) * 1.959964 / math.sqrt(3.0))
    assert [found.low, found.high] == pytest.approx(ends, abs=1e-6)
    assert twice.low == pytest.approx(found.low) and twice.units == 6
    assert statistics.rank_correlation(a, b, [0, 0, 0, 1, 1, 2]) is None


@pytest.mark.parametrize(("flights", "minimum"), [(5, 0.89), (10, 0.93), (20, 0.94)])
def test_intervals_cover_as_often_as_they_say(flights: int, minimum: float) -> None:
    """1000 normal samples. Plain percentiles cover 0.82 and 0.90 for five and ten flights; five
    flights cannot be resampled beyond their extremes."""
    samples = np.random.default_rng([9, flights]).normal(size=(1000, flights))
    found = [statistics.mean_interval(sample) for sample in samples]
    covered = [not interval.excludes(0.0) for interval in found if interval is not None]
    assert minimum <= np.mean(covered) <= 0.965


def test_detectable_effect_of_ten_pairs_by_hand() -> None:
    """At 0.04/24 all ten differences must be positive: Phi(effect)^10 = 0.8, effect = 2.01."""
    effect = statistics.detectable_paired(10, 0.04 / 24)
    assert effect == pytest.approx(norm.ppf(0.8**0.1), abs=0.06)
    assert statistics.detectable_paired(9, 0.04 / 24) is None
    assert statistics.min_pairs(0.04 / 24) == 10 and statistics.detectable_paired(1, 0.5) is None


def test_detectable_effect_of_many_flights_nears_the_normal_limit() -> None:
    """(1.645 + 0.842) / sqrt(n), and sqrt(2/n) for two samples."""
    assert statistics.detectable_paired(400, 0.05) == pytest.approx(2.486 / 20, rel=0.01)
    assert statistics.detectable_unpaired(400, 400, 0.05) == pytest.approx(
        2.486 * math.sqrt(2 / 400), rel=0.01
    )


def test_welch_by_hand() -> None:
    """Means 2 and 0, variances 1 and 4 of three values each: t = 2 / sqrt(5 / 3)."""
    new, old = np.array([1.0, 2.0, 3.0]), np.array([-2.0, 0.0, 2.0])
    freedom = (5 / 3) ** 2 / ((1 / 3) ** 2 / 2 + (4 / 3) ** 2 / 2)
    assert statistics.unpaired_p(new, old) == pytest.approx(t.sf(2 / (5 / 3) ** 0.5, freedom))
    assert statistics.unpaired_p(np.ones(3), np.ones(4)) == 1.0, "no spread, no difference"
