"""Probability of an event against a dial: logistic fits of flights in independent units.

The fit maximises the likelihood with Firth's penalty, which stays finite where the dial separates
hits from misses (D. Firth, Biometrika 80(1), 1993; G. Heinze and M. Schemper, Statistics in
Medicine 21, 2002). The covariance is that of the model, times the design effect of units whose
flights are alike (Kish, Survey Sampling, 1965). The interval of the dial at which a level is
crossed is that in which the level is within the pointwise band (Fieller's).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from touchdown.experiments.reporting.statistics import CONFIDENCE, Estimate
from touchdown.sim.typing import Array

_STEPS, _LONGEST = 60, 2.0
"""Newton steps, and the longest of them in log odds over half of the range"""
_GRID = 2001


@dataclass(frozen=True, slots=True)
class LogisticFit:
    """``coefficients``: (2,) log odds at the middle of the dial's range from ``low`` to ``high``,
    and what half of the range adds; ``covariance``: theirs; ``influence``: (2,) what each unit adds
    to them, by its name."""

    low: float
    high: float
    coefficients: Array
    covariance: Array
    influence: dict[str, Array]
    flights: int

    def band(self, dial: Array) -> tuple[Array, Array, Array]:
        """The probability at (N,) values of the dial, and the ends of its 95 % interval."""
        design = np.stack([np.ones(len(dial)), _scaled(dial, self.low, self.high)])
        logit = self.coefficients @ design
        variance = np.einsum("in,ij,jn->n", design, self.covariance, design)
        half = _student(len(self.influence)) * np.sqrt(variance)
        return _expit(logit), _expit(logit - half), _expit(logit + half)

    @property
    def falls(self) -> bool:
        """True if the probability gets less along the dial."""
        return bool(self.coefficients[1] < 0.0)

    def crossing(self, level: float) -> Estimate | None:
        """The dial at which the probability is ``level``, with its interval, whose ends are
        infinite beyond the range; None where the fit does not pass it in the range."""
        grid = np.linspace(self.low, self.high, _GRID)
        value, low, high = self.band(grid)
        if not min(value[0], value[-1]) < level < max(value[0], value[-1]):
            return None
        inside = np.flatnonzero((low <= level) & (level <= high))
        ends = grid[inside[[0, -1]]]
        ends = np.where([inside[0] == 0, inside[-1] == _GRID - 1], [-np.inf, np.inf], ends)
        sign = -1.0 if self.falls else 1.0
        at = float(np.interp(sign * level, sign * value, grid))
        return Estimate(at, float(ends[0]), float(ends[1]), self.flights, len(self.influence))

    def changes(self) -> bool:
        """True if the interval of the slope excludes none."""
        half = _student(len(self.influence)) * np.sqrt(self.covariance[1, 1])
        return bool(abs(self.coefficients[1]) > half)


def fit_logistic(
    dial: Sequence[float] | Array, hits: Sequence[bool] | Array, units: Sequence[Any]
) -> LogisticFit:
    """Fits the probability of ``hits`` (N,) to ``dial`` (N,), of two or more values; flights of one
    of ``units`` (N,) share random draws."""
    values, y = np.asarray(dial, np.float64), np.asarray(hits, np.float64)
    low, high = float(values.min()), float(values.max())
    design = np.stack([np.ones_like(values), _scaled(values, low, high)])
    b = np.zeros(2)
    for _ in range(_STEPS):
        p = _expit(b @ design)
        weight = p * (1.0 - p)
        inverse = np.linalg.inv((design * weight) @ design.T)
        leverage = weight * np.einsum("in,ij,jn->n", design, inverse, design)
        step = inverse @ (design @ (y - p + leverage * (0.5 - p)))
        b += np.clip(step, -_LONGEST, _LONGEST)
        if np.abs(step).max() < 1e-9:
            break
    names, codes = np.unique(np.asarray(units, str), return_inverse=True)
    parts = np.zeros((len(names), 2))
    np.add.at(parts, codes, (design * (y - p)).T)
    influence = parts @ inverse
    k = len(names)
    robust = influence.T @ influence * k / max(k - 1, 1)
    effect = float(np.trace(robust @ np.linalg.inv(inverse))) / 2.0 if k < len(y) else 1.0
    by_unit = dict(zip(names.tolist(), influence, strict=True))
    covariance = np.asarray(inverse * max(1.0, effect), np.float64)
    return LogisticFit(low, high, b, covariance, by_unit, len(y))


def crossing_difference(a: LogisticFit, b: LogisticFit, level: float) -> Estimate | None:
    """How much later along the dial ``b`` passes ``level`` than ``a``, with its interval: units
    that both have flown count as pairs (delta method). None where one of them does not pass it in
    the range, or one falls and the other rises."""
    if a.falls != b.falls:
        return None
    found = []
    for fit in (a, b):
        if (at := fit.crossing(level)) is None:
            return None
        x = _scaled(at.value, fit.low, fit.high)
        slope = -0.5 * (fit.high - fit.low) / fit.coefficients[1] * np.array([1.0, x])
        found.append((at.value, {name: float(slope @ psi) for name, psi in fit.influence.items()}))
    (first, before), (second, after) = found
    names = before.keys() | after.keys()
    k = len(before.keys() & after.keys()) or min(len(before), len(after))
    spread = [after.get(name, 0.0) - before.get(name, 0.0) for name in names]
    error = float(np.sqrt(np.sum(np.square(spread)) * len(names) / max(len(names) - 1, 1)))
    value, half = second - first, _student(k) * error
    return Estimate(value, value - half, value + half, min(a.flights, b.flights), k)


def _scaled(dial: Any, low: float, high: float) -> Any:
    """-1 at ``low`` to 1 at ``high``."""
    return (2.0 * dial - low - high) / (high - low)


def _student(units: int) -> float:
    return float(stats.t.ppf(0.5 + 0.5 * CONFIDENCE, max(units - 2, 1)))


def _expit(x: Array) -> Array:
    return 1.0 / (1.0 + np.exp(-np.clip(x, -500.0, 500.0)))
