"""A survey that rises with the ground.

A survey is planned at one height above the take-off spot. Where the map so far shows ground that
rises by more than a fifth of that height, the path is lifted by the rest. Over lower ground nothing
changes, to the bit. The lift follows as a critically damped oscillator of bounded rate.
"""

import numpy as np

from touchdown.estimator.api import MapView
from touchdown.landing.mission.trajectory import PiecewiseTrajectory, Sample
from touchdown.sim.typing import Array

SLACK = 0.2
"""Rise of the ground that needs no lift, of the height of the survey"""
_RADIUS_M = 8.0
"""around the vehicle, about as far as the LIDAR looks ahead"""
_LEAST_KNOWN = 0.2
"""of the cells there"""
_PERIOD_S = 0.25
_NATURAL_RADPS = 0.8
_MAX_RATE_MPS, _MAX_ACCEL_MPS2 = 2.0, 0.8


def ground_around(map_view: MapView, xy_odom: Array) -> float:
    """Median of the lowest returns of the cells around a point (2,), odom frame: the ground, if
    less than half of it is under something; NaN where too little is mapped."""
    grid = map_view.coarse
    reach = round(_RADIUS_M / grid.cell_m)
    col, row = np.floor((xy_odom - grid.origin_xy_m) / grid.cell_m).astype(int)
    rows = slice(max(row - reach, 0), max(row + reach + 1, 0))
    cols = slice(max(col - reach, 0), max(col + reach + 1, 0))
    near = grid.min_height_m[rows, cols]
    known = near[np.isfinite(near)]
    return float(np.median(known)) if known.size > _LEAST_KNOWN * (2 * reach + 1) ** 2 else np.nan


class Lift:
    """Metres by which a path is lifted, 0 at first."""

    def __init__(self, height_m: float) -> None:
        """``height_m``: of the survey above the take-off ground."""
        self._slack = SLACK * height_m
        self._wanted = self._next_s = 0.0
        self._last_s: float | None = None
        self.height_m = self.rate_mps = self.accel_mps2 = 0.0

    def update(self, map_view: MapView, xy_odom: Array, level_odom: float, now_s: float) -> None:
        """Moves on to the time ``now_s``. ``xy_odom`` (2,): the reference; ``level_odom``: height
        of the ground at the take-off spot, odom frame."""
        if now_s >= self._next_s:
            self._next_s = now_s + _PERIOD_S
            rise = ground_around(map_view, xy_odom) - level_odom
            if np.isfinite(rise):
                self._wanted = max(0.0, rise - self._slack)
        step = 0.0 if self._last_s is None else now_s - self._last_s
        self._last_s = now_s
        pull = _NATURAL_RADPS * (
            _NATURAL_RADPS * (self._wanted - self.height_m) - 2 * self.rate_mps
        )
        self.accel_mps2 = float(np.clip(pull, -_MAX_ACCEL_MPS2, _MAX_ACCEL_MPS2))
        rate = self.rate_mps + step * self.accel_mps2
        self.rate_mps = float(np.clip(rate, -_MAX_RATE_MPS, _MAX_RATE_MPS))
        self.height_m += step * self.rate_mps


class LiftedTrajectory(PiecewiseTrajectory):
    """A trajectory over a changing lift."""

    def __init__(self, path: PiecewiseTrajectory, lift: Lift) -> None:
        self._starts, self._coefficients = path.breaks_s, path.coefficients
        self._lift = lift

    def sample(self, t: float) -> Sample:
        """As of the path, with the present lift."""
        sample, lift = super().sample(t), self._lift
        state = (lift.height_m, lift.rate_mps, lift.accel_mps2)
        if not any(state):
            return sample
        position, velocity, acceleration = (
            value + np.array([0.0, 0.0, extra]) for value, extra in zip(sample, state, strict=True)
        )
        return position, velocity, acceleration
