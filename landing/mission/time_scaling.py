"""Time scaling of the reference: how fast its clock runs in the wind that the vehicle feels.

A trajectory p(s) is flown along s(t). The rate ds/dt lies within [0, 1]; it and its derivative are
bounded and the derivative is continuous, so that the velocity ``p' s_dot`` and the acceleration
``p'' s_dot^2 + p' s_ddot`` that are handed to the controller belong to the positions. In a wind
that leaves the vehicle its margin the rate is 1 exactly, and the trajectory the one that was set.
"""

import numpy as np
from numba import njit

from touchdown.landing.api import LandingParams
from touchdown.landing.mission.quintics import sample_quintics
from touchdown.landing.mission.thrust_need import FASTEST, air_coefficients, rotor_need
from touchdown.landing.mission.trajectory import PiecewiseTrajectory, Sample
from touchdown.sim.api import VehicleModel
from touchdown.sim.typing import Array

BRAKE_PER_S = 0.30
"""largest fall of the rate per second: 2.3 m/s^2 at the survey's 7.8 m/s"""
SPEED_UP_PER_S = 0.15
JERK_PER_S2 = 1.0
"""largest change of the rate's derivative per second"""
_APPROACH_S = 0.4
_PERIOD_S = 0.05
"""time between two looks ahead"""
_PLANNED_PER_S = 0.2
"""fall of the rate that looking ahead counts on; the rest covers its delay"""
_AHEAD_S, _AHEAD_POINTS = 2.5, 14
"""span and number of points of a look ahead: after 1 / (2 * _PLANNED_PER_S) seconds of the path,
nothing limits the rate now"""
_BISECTIONS = 5
_SPARE = 0.02
"""load beyond the hover's that a motion may take where the hover has no margin left itself"""
_BEHIND_M, _STOP_BEHIND_M = 0.7, 2.0
"""distances of the vehicle from the reference at which the clock begins to slow, and stops"""
_STOPPED = 0.05
_HALTED = 1e-3
"""rate from which the last of the way to a halt, 8 mm/s at most, is dropped"""
_LEARNED_S = 2.0
_MAX_LEARNED = 1.25


class TimeScaling:
    """Chooses the rate of the clock. ``rate`` and ``change`` are ds/dt and d2s/dt2."""

    def __init__(self, vehicle: VehicleModel, params: LandingParams) -> None:
        self._coefficients = air_coefficients(vehicle)
        self._limits = np.array(
            [params.wind_thrust_fraction, np.tan(np.radians(params.wind_tilt_deg))]
        )
        self._gusts = 1.0 + params.wind_gust_fraction
        self._enabled = params.slow_in_wind
        self._learned = 1.0
        self._next_s = 0.0
        self._target = 1.0
        self.rate, self.change = 1.0, 0.0
        self.lost_s = 0.0
        """time by which the present trajectory is late"""
        self.stopped_s = 0.0
        """time for which the clock has stood still"""

    def begin(self, path: PiecewiseTrajectory, wind: Array) -> None:
        """Starts a trajectory that begins at rest, at the rate that its first seconds allow."""
        self.lost_s = self.stopped_s = self._next_s = 0.0
        self._target = self._look(path, 0.0, wind)
        self.rate, self.change = self._target, 0.0

    def advance(
        self,
        path: PiecewiseTrajectory,
        at_s: float,
        step_s: float,
        wind: Array,
        behind_m: float,
        *,
        stop: bool = False,
        min_rate: float = 0.0,
    ) -> None:
        """Moves the clock on by a control step of ``step_s``.

        at_s: time on the path; wind (3,) m/s in its frame; behind_m: distance of the vehicle from
        the reference. ``stop`` lets the clock run out; ``min_rate`` is a rate that it keeps."""
        if not self._enabled:
            return
        self._next_s -= step_s
        if self._next_s <= 0.0:
            self._next_s = _PERIOD_S
            self._target = self._look(path, at_s, wind)
        fraction = (_STOP_BEHIND_M - behind_m) / (_STOP_BEHIND_M - _BEHIND_M)
        target = min(self._target, min(max(fraction, 0.0), 1.0))
        target = 0.0 if stop else max(target, min_rate)
        before = self.rate
        self.rate, self.change = next_rate(self.rate, self.change, target, step_s)
        self.lost_s += step_s * (1.0 - 0.5 * (before + self.rate))
        self.stopped_s = self.stopped_s + step_s if self.rate < _STOPPED else 0.0

    def hover_load(self, wind: Array, *, gusts: bool = True) -> float:
        """Need of a hover over what is allowed, ``gusts`` added to the wind or in it; above 1 there
        is no margin."""
        velocity = -(self._gusts if gusts else 1.0) * wind
        return float(self._learned * _load(velocity, np.zeros(3), self._coefficients, self._limits))

    def learn(
        self, through_air: Array, acceleration: Array, speed_mean: float, step_s: float
    ) -> None:
        """Compares the model with the rotor speed that the present motion takes, ``speed_mean``
        rad/s: a heavy vehicle, weak rotors or a low battery leave less than the model says."""
        fraction, _ = rotor_need(through_air, acceleration, self._coefficients)
        ratio = speed_mean / (fraction * self._coefficients[FASTEST])
        self._learned += min(step_s / _LEARNED_S, 1.0) * (ratio - self._learned)
        self._learned = min(max(self._learned, 1.0), _MAX_LEARNED)

    def _look(self, path: PiecewiseTrajectory, at_s: float, wind: Array) -> float:
        if not self._enabled:
            return 1.0
        return float(
            allowed_rate(
                path.breaks_s,
                path.coefficients,
                at_s,
                self._gusts * wind,
                self._coefficients,
                self._limits / self._learned,
            )
        )


def scaled(sample: Sample, rate: float, change: float) -> Sample:
    """Returns position, velocity and acceleration in time of a sample over the path's own time."""
    if rate == 1.0 and change == 0.0:
        return sample
    position, velocity, acceleration = sample
    return position, rate * velocity, rate**2 * acceleration + change * velocity


@njit(cache=True, error_model="numpy")
def next_rate(rate: float, change: float, target: float, step_s: float) -> tuple[float, float]:
    """The rate and its derivative one step later, on the way to ``target``; reached exactly
    where it is 0 or 1."""
    if target == 1.0 and rate == 1.0:
        return 1.0, 0.0
    wanted = min(max((target - rate) / _APPROACH_S, -BRAKE_PER_S), SPEED_UP_PER_S)
    maximum = JERK_PER_S2 * step_s
    following = change + min(max(wanted - change, -maximum), maximum)
    moved = rate + 0.5 * step_s * (change + following)
    if target == 1.0 and moved > 1.0 - 1e-4 and abs(following) < 1e-3:
        return 1.0, 0.0
    if target == 0.0 and moved < _HALTED:
        return 0.0, 0.0
    if moved >= 1.0:
        return 1.0, min(following, 0.0)
    if moved <= 0.0:
        return 0.0, max(following, 0.0)
    return moved, following


@njit(cache=True, error_model="numpy")
def _load(velocity: Array, acceleration: Array, coefficients: Array, limits: Array) -> float:
    """The larger of rotor speed and tilt that a motion needs, each over its limit."""
    fraction, tilt = rotor_need(velocity, acceleration, coefficients)
    return max(fraction / limits[0], np.tan(min(tilt, 1.5)) / limits[1])


@njit(cache=True, error_model="numpy")
def allowed_rate(
    starts: Array, quintics: Array, at_s: float, wind: Array, coefficients: Array, limits: Array
) -> float:
    """The largest rate now from which every point of the next seconds is reached at a rate that it
    allows, braking on the way.

    A point allows the rates whose load stays below 1, or a little above that of the hover where the
    hover itself is above."""
    maximum = max(1.0, _load(-wind, np.zeros(3), coefficients, limits) + _SPARE)
    best = 1.0
    end = starts[starts.size - 1]
    for k in range(_AHEAD_POINTS):
        ahead = k * (_AHEAD_S / (_AHEAD_POINTS - 1))
        if k > 0 and at_s + ahead > end:
            break
        _, velocity, acceleration = sample_quintics(starts, quintics, at_s + ahead)
        rate = 1.0
        if _load(velocity - wind, acceleration, coefficients, limits) > maximum:
            low, high = 0.0, 1.0
            for _ in range(_BISECTIONS):
                middle = 0.5 * (low + high)
                load = _load(
                    middle * velocity - wind, middle**2 * acceleration, coefficients, limits
                )
                low, high = (low, middle) if load > maximum else (middle, high)
            rate = low
        best = min(best, np.sqrt(rate * rate + 2.0 * _PLANNED_PER_S * ahead))
    return best
