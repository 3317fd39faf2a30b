"""A vector PID: every axis with its own gains and limits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class PidGains:
    """Gains and limits of n axes, each (n,): output = kp e + integral of (ki e) - kd rate."""

    kp: Array
    ki: Array
    kd: Array
    integral_limit: Array
    """bound on the magnitude of the integral's share of the output"""


class VectorPid:
    """PID whose derivative acts on a given rate, so that a step of the reference does not kick.

    One control step is ``output`` followed by ``settle``, which integrates: the
    saturation is known only after the actuators were commanded. Anti-windup by back-calculation:
    the undelivered output enters the integral at the rate ``ki / kp``, the time constant of the
    integral itself (Astrom and Hagglund, 1995, section 3.5).
    """

    def __init__(self, gains: PidGains, step_s: float) -> None:
        self.gains = gains
        self._step_s = step_s
        self._tracking = np.where(gains.kp > 0.0, gains.ki / np.where(gains.kp > 0, gains.kp, 1), 0)
        self.reset()

    def reset(self) -> None:
        """Forgets the integral."""
        size = self.gains.kp.size
        self.integral = np.zeros(size)
        self._error = np.zeros(size)

    def output(self, error: Array, rate: Array) -> Array:
        """(n,) demand for the ``error`` (n,) and the ``rate`` (n,) at which it is being removed."""
        gains = self.gains
        self._error = error
        return _pid_output(error, rate, self.integral, gains.kp, gains.kd)

    def settle(self, missing: Array) -> None:
        """Integrates one step; ``missing`` (n,): delivered output less demanded output."""
        gains = self.gains
        self.integral = _pid_integral(
            self.integral,
            self._error,
            missing,
            gains.ki,
            self._tracking,
            gains.integral_limit,
            self._step_s,
        )


@njit(cache=True, error_model="numpy")
def _pid_output(error: Array, rate: Array, integral: Array, kp: Array, kd: Array) -> Array:
    return kp * error + integral - kd * rate


@njit(cache=True, error_model="numpy")
def _pid_integral(
    integral: Array,
    error: Array,
    missing: Array,
    ki: Array,
    tracking: Array,
    limit: Array,
    step_s: float,
) -> Array:
    grown = integral + step_s * (ki * error + tracking * missing)
    return np.minimum(np.maximum(grown, -limit), limit)
