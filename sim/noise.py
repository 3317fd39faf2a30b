"""Random processes that several sensors share."""

import math
from zlib import crc32

import numpy as np

from touchdown.sim.typing import Array


def world_seed(seed: int, scene: str) -> int:
    """The seed of all random draws of a flight over ``scene``: flights of one seed over two scenes
    share none of them, those of several methods over one scene share all."""
    return int(
        np.random.SeedSequence([seed, crc32(scene.encode())]).generate_state(1, np.uint64)[0]
    )


def random_stream(seed: int, component: str) -> np.random.Generator:
    """The random numbers of one component, independent of other components and of their order."""
    return np.random.default_rng([seed, crc32(component.encode())])


class GaussMarkov:
    """A stationary first-order Gauss-Markov process of independent components, sampled every
    ``period_s``: autocorrelation sigma^2 exp(-|lag| / tau).

    The first value is drawn from the stationary distribution, so there is no run-in. The recursion
    x' = a x + sigma sqrt(1 - a^2) w with a = exp(-T / tau) is exact for every T (Gelb, "Applied
    Optimal Estimation", 1974, section 3.8). ``tau_s`` may be infinite: a constant, random offset.

    sigma: (K,) standard deviations.
    """

    def __init__(
        self, sigma: Array, tau_s: float, period_s: float, rng: np.random.Generator
    ) -> None:
        self._rng = rng
        self._keep = math.exp(-period_s / tau_s)
        self._sigma = np.asarray(sigma, dtype=np.float64)
        self._drive = self._sigma * math.sqrt(-math.expm1(-2.0 * period_s / tau_s))
        self._value = self._sigma * rng.standard_normal(self._sigma.shape)

    def step(self) -> Array:
        """(K,) present value; the process then advances by one period."""
        value = self._value
        self._value = self._keep * value + self._drive * self._rng.standard_normal(value.shape)
        return value
