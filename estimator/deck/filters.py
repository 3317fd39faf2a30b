"""Kalman filters of a deck: its site on a course, its heave and tilt as damped oscillations."""

import numpy as np

from touchdown.estimator.api import SWAY, Array, DeckTrack, swayed
from touchdown.estimator.deck.surfaces import PlaneFit

_ACCELERATION = 0.4
"""m/s^2, root Hz: of the site across the sea, by gusts on the estimate and by roll"""
_LEAN_MPS2, _LEANING = 0.3, 0.02
"""standard deviation of the acceleration that a tilted odom frame lends to all, and how fast it
changes, m/s^3, root Hz"""
_DRIFT = 0.03
"""the same of the mean level, which drifts with the estimate"""
_HEAVE_MPS, _TILT_RADPS = 0.4, 0.07
"""standard deviations of the rates of heave and slope that waves are expected to make"""
_LEVEL_SIGMA_M, _SLOPE_SIGMA = 0.02, 0.01
_AT_REST = np.zeros(2)
_FIRST_MPS = 3.0
"""standard deviation of the speed of a deck that was just found"""
_GATE = 5.0

_COURSE = np.eye(3, k=1)
_PLACE = np.array([1.0, 0.0, 0.0])


class Linear:
    """A linear Kalman filter: state (n,), dynamics (n, n), density of white noise (n,)."""

    def __init__(self, state: Array, sigma: Array, dynamics: Array, noise: Array) -> None:
        self.state, self.covariance = state, np.diag(sigma**2)
        self._dynamics, self._noise = dynamics, np.diag(noise)

    def predict(self, step_s: float) -> None:
        move = self._dynamics * step_s
        transition = np.eye(len(move)) + move + 0.5 * move @ move
        self.state = transition @ self.state
        self.covariance = transition @ self.covariance @ transition.T + self._noise * step_s

    def correct(self, seen: float, row: Array, sigma: float) -> bool:
        """Takes the measurement ``row`` (n,) times the state; False where it is too far off."""
        gap = seen - float(row @ self.state)
        variance = float(row @ self.covariance @ row) + sigma**2
        if gap * gap > _GATE**2 * variance:
            return False
        gain = self.covariance @ row / variance
        self.state = self.state + gain * gap
        self.covariance = self.covariance - np.outer(gain, row @ self.covariance)
        return True


def _sway_noise(rate_sigma: float) -> float:
    """Density that keeps an oscillation of `SWAY` at a standard deviation of its rate."""
    return -2.0 * SWAY[1, 1] * rate_sigma**2


class DeckFilter:
    """The site of a deck in the odom frame. Measurements come in any order within a fraction of a
    second; the filter stands at the newest."""

    def __init__(
        self, time_s: float, site_odom: Array, slopes: Array, velocity: Array = _AT_REST
    ) -> None:
        """``velocity`` (2,): across, as far as it is known."""
        self.time_s = self.seen_s = time_s
        course = np.array([0.0, _ACCELERATION**2, _LEANING**2])
        self._xy = [
            Linear(np.array([site_odom[axis], velocity[axis], 0.0]),
                   np.array([0.3, _FIRST_MPS, _LEAN_MPS2]), _COURSE, course)
            for axis in (0, 1)
        ]  # fmt: skip
        dynamics = np.zeros((4, 4))
        dynamics[:2, :2], dynamics[2:, 2:] = _COURSE[:2, :2], SWAY
        noise = np.array([0.0, _DRIFT**2, 0.0, _sway_noise(_HEAVE_MPS)])
        self._z = Linear(np.array([site_odom[2], 0.0, 0.0, 0.0]),
                         np.array([0.3, 0.3, 0.3, _HEAVE_MPS]), dynamics, noise)  # fmt: skip
        tilting = np.array([0.0, _sway_noise(_TILT_RADPS)])
        self._slopes = [
            Linear(np.array([slope, 0.0]), np.array([0.1, _TILT_RADPS]), SWAY, tilting)
            for slope in slopes
        ]

    def _advance(self, time_s: float) -> float:
        """Predicts up to ``time_s``; returns by how much it is late for an older measurement."""
        late = max(self.time_s - time_s, 0.0)
        if time_s > self.time_s:
            for one in (*self._xy, self._z, *self._slopes):
                one.predict(time_s - self.time_s)
            self.time_s = time_s
        return late

    @property
    def velocity(self) -> Array:
        """(3,) of the site, odom frame."""
        across = [axis.state[1] for axis in self._xy]
        return np.array([*across, self._z.state[1] + self._z.state[3]])

    def surface(self, time_s: float) -> tuple[Array, Array]:
        """The site (3,) and the slopes (2,) of the deck at ``time_s``, near the present."""
        place = [axis.state[0] for axis in self._xy]
        site = np.array([*place, self._z.state[0] + self._z.state[2]])
        slopes = np.array([axis.state[0] for axis in self._slopes])
        return site + (time_s - self.time_s) * self.velocity, slopes

    def see_height(self, time_s: float, height: float, sigma_m: float = _LEVEL_SIGMA_M) -> None:
        """Takes the height of the site."""
        late = self._advance(time_s)
        row = np.array([1.0, 0.0, 1.0, 0.0])
        if self._z.correct(height + late * self.velocity[2], row, sigma_m):
            self.seen_s = self.time_s

    def see_plane(self, time_s: float, plane: PlaneFit) -> None:
        """Takes a plane: its slopes, and its height where it was seen, from which tilt leads to the
        site."""
        late, sure = self._advance(time_s), max(plane.slope_sigma, _SLOPE_SIGMA)
        for one, slope in zip(self._slopes, plane.slopes, strict=True):
            one.correct(slope + late * one.state[1], np.array([1.0, 0.0]), sure)
        site, slopes = self.surface(time_s)
        way = site[:2] - plane.middle[:2]
        tilt = np.sqrt(max(axis.covariance[0, 0] for axis in self._slopes))
        sigma = float(np.hypot(_LEVEL_SIGMA_M, tilt * np.linalg.norm(way)))
        self.see_height(time_s, float(plane.middle[2] + way @ slopes), sigma)

    def see_place(self, time_s: float, xy: Array, sigma_m: float) -> None:
        """Takes the place of the site (2,)."""
        late = self._advance(time_s)
        for axis, one in enumerate(self._xy):
            one.correct(float(xy[axis]) + late * one.state[1], _PLACE, sigma_m)

    def track(self, time_s: float) -> DeckTrack:
        """What is known, at ``time_s``."""
        ahead = max(time_s - self.time_s, 0.0)
        heave = swayed(self._z.state[2:], ahead)
        slopes = [swayed(axis.state, ahead) for axis in self._slopes]
        xy = [axis.state + ahead * _COURSE @ axis.state for axis in self._xy]
        level = self._z.state[0] + ahead * self._z.state[1]
        return DeckTrack(
            site_odom=np.array([xy[0][0], xy[1][0], level + heave[0]]),
            velocity_odom=np.array([xy[0][1], xy[1][1], self._z.state[1] + heave[1]]),
            acceleration_odom=np.array([xy[0][2], xy[1][2], float(SWAY[1] @ heave)]),
            heave=heave,
            slopes=np.array(slopes),
            seen_s=self.seen_s,
            sigma_m=float(np.sqrt(max(axis.covariance[0, 0] for axis in self._xy))),
            sigma_mps=float(np.sqrt(max(axis.covariance[1, 1] for axis in self._xy))),
        )
