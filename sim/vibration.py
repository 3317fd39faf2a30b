"""Vibration of the propellers at the IMU: harmonics of each rotor's speed, and a broadband part.

Levels and shapes are fitted to recorded flights of a DJI Phantom 4 with four Xsens DOT IMUs fixed
to the airframe (Hurwitz and Klein, "Quadrotor Dead Reckoning with Multiple Inertial Sensors",
2023); ``touchdown gap`` compares both. That sensor integrates at 800 Hz and hands out means
over 1/120 s, so that lines above 60 Hz appear at their aliases, weakened by the mean. The fit puts
the same mean over this model, at the rotor speeds of that vehicle, and compares what remains; the
vibration itself is in continuous time and may be sampled at any rate.
"""

import math
from typing import NamedTuple
from zlib import crc32

import numpy as np
from numba import njit

from touchdown.sim.api import ImuParams
from touchdown.sim.typing import Array

ISOLATION_CORNER_HZ = 40.0
"""frequency above which a damped mount passes ``ImuParams.vibration_isolation`` of the vibration"""

HARMONIC_RMS = np.array(
    [[0.071, 0.089, 0.018, 1.6, 1.3, 5.5], [0.036, 0.044, 0.0092, 0.81, 0.65, 3.7]]
)
"""rad/s and m/s^2, hover, gyroscope and accelerometer x, y, z: once per turn (imbalance), and twice
(two blades that pass), of all rotors together"""

MODE_HZ = np.array([13.0, 24.0, 34.0, 44.0, 57.0])
MODE_DAMPING = np.array([0.2, 0.2, 0.15, 0.1, 0.015])
"""natural frequencies and damping ratios of the broadband part: white noise through resonances"""

MODE_RMS = np.array(
    [
        [0.015, 0.016, 0.0077, 0.30, 0.24, 0.80],
        [0.027, 0.0046, 0.0, 0.31, 0.40, 1.3],
        [0.0075, 0.0, 0.0, 0.0, 0.062, 1.4],
        [0.018, 0.066, 0.0, 0.82, 0.85, 1.8],
        [0.018, 0.11, 0.082, 3.2, 0.71, 2.4],
    ]
)
"""rad/s and m/s^2, hover, of each resonance, axes as above"""

LEVELS = HARMONIC_RMS, MODE_RMS

_STATES, _BLOCK = 4, 64


class _Resonance(NamedTuple):
    """One resonance behind the isolating mount, over one sample."""

    advance: Array
    """(5, 4): the next state, and the sample, from the state"""
    root: Array
    """(5, 5) root of the covariance of what the noise adds to them"""
    stationary: Array
    """(4, 4) root of the covariance of the state"""


class PropellerVibration:
    """Vibration in samples of ``period_s`` that are means over it. ``hover_radps``: rotor speed
    that the levels belong to; they grow with the square of the speed."""

    def __init__(
        self,
        params: ImuParams,
        period_s: float,
        hover_radps: float,
        seed: int,
        levels: tuple[Array, Array] = LEVELS,
        rotors: int = 4,
    ) -> None:
        """``levels``: of harmonics (2, 6) and resonances (M, 6), instead of the fitted ones.
        ValueError: the speed in hover is not positive."""
        if not hover_radps > 0.0:
            raise ValueError(f"the rotor speed in hover must be above 0, not {hover_radps:g} rad/s")
        self._period_s, self._hover = period_s, hover_radps
        self._rng = np.random.default_rng([seed, crc32(b"imu propellers")])
        fraction = params.vibration_isolation
        self._isolation = np.array([fraction, 2.0 * math.pi * ISOLATION_CORNER_HZ])
        self._lines = params.vibration_harmonics * levels[0] * math.sqrt(2.0 / rotors)
        self._offsets = self._rng.uniform(0.0, 2.0 * math.pi, (rotors, 2, 6))
        self._phases = self._rng.uniform(0.0, 2.0 * math.pi, rotors)
        self._speeds = np.zeros(rotors)
        self._levels = params.vibration_broadband * levels[1]
        resonances = [
            _resonance(2.0 * math.pi * hz, damping, fraction, period_s)
            for hz, damping in zip(MODE_HZ, MODE_DAMPING, strict=True)
        ]
        self._advance = np.array([one.advance for one in resonances])
        self._roots = np.array([one.root for one in resonances])
        start = self._rng.standard_normal((len(resonances), 6, _STATES))
        self._state = np.array(
            [draw @ one.stationary.T for draw, one in zip(start, resonances, strict=True)]
        )
        self._normals, self._next = np.zeros((0, 0, 0, 0)), 0

    def sample(self, speeds: Array) -> Array:
        """(6,) rad/s and m/s^2: mean over the period that ends now, with the rotors at (R,)
        ``speeds`` rad/s; the speeds run linearly from one call to the next."""
        if self._next == len(self._normals):
            shape = (_BLOCK, len(MODE_HZ), 6, _STATES + 1)
            self._normals, self._next = self._rng.standard_normal(shape), 0
        normals = self._normals[self._next]
        self._next += 1
        out = np.zeros(6)
        _sample(
            self._speeds, speeds, self._phases, self._offsets, self._lines, self._hover,
            self._isolation, self._period_s, self._state, self._advance, self._roots, normals,
            self._levels, out,
        )  # fmt: skip
        return out


@njit(cache=True, error_model="numpy")
def mount_gain(rate: float, fraction: float, corner: float) -> float:
    """Fraction of a vibration of ``rate`` rad/s that a damped mount passes: of second order, 1
    below ``corner`` rad/s and ``fraction`` above it."""
    r = rate / corner
    above = (1.0 - fraction * r * r) ** 2 + 2.0 * (fraction * r) ** 2
    below = (1.0 - r * r) ** 2 + 2.0 * r * r
    return float(np.sqrt(above / below))


@njit(cache=True, error_model="numpy")
def _sample(
    before: Array,
    speeds: Array,
    phases: Array,
    offsets: Array,
    lines: Array,
    hover: float,
    isolation: Array,
    period_s: float,
    state: Array,
    advance: Array,
    roots: Array,
    normals: Array,
    levels: Array,
    out: Array,
) -> None:
    """One call for both parts, which costs less than two; ``before`` becomes ``speeds``."""
    _harmonics(before, speeds, phases, offsets, lines, hover, isolation, period_s, out)
    square = 0.0
    for i in range(speeds.shape[0]):
        square += speeds[i] * speeds[i]
        before[i] = speeds[i]
    scale = square / (speeds.shape[0] * hover * hover)
    _broadband(state, advance, roots, normals, levels, scale, out)


@njit(cache=True, error_model="numpy")
def _harmonics(
    before: Array,
    speeds: Array,
    phases: Array,
    offsets: Array,
    lines: Array,
    hover: float,
    isolation: Array,
    period_s: float,
    out: Array,
) -> None:
    """Adds (6,) means of the rotors' lines to ``out``; advances ``phases``. The mean of a cosine
    whose phase runs from a to b is (sin b - sin a) / (b - a)."""
    for i in range(speeds.shape[0]):
        speed = 0.5 * (before[i] + speeds[i])
        angle = speed * period_s
        start = phases[i]
        phases[i] = (start + angle) % (2.0 * np.pi)
        if angle < 1e-9:
            continue
        for h in range(2):
            size = (speed / hover) ** 2 * mount_gain((h + 1) * speed, isolation[0], isolation[1])
            span = (h + 1) * angle
            first = (h + 1) * start
            for k in range(6):
                a = first + offsets[i, h, k]
                out[k] += size * lines[h, k] * (np.sin(a + span) - np.sin(a)) / span


@njit(cache=True, error_model="numpy")
def _broadband(
    state: Array,
    advance: Array,
    roots: Array,
    normals: Array,
    levels: Array,
    scale: float,
    out: Array,
) -> None:
    """Advances the resonances' states (modes, 6, 4) by a sample and adds their means, times
    ``scale``, to ``out``."""
    modes, axes, states = state.shape
    following = np.empty(states + 1)
    for m in range(modes):
        for k in range(axes):
            for row in range(states + 1):
                total = 0.0
                for column in range(states):
                    total += advance[m, row, column] * state[m, k, column]
                for column in range(states + 1):
                    total += roots[m, row, column] * normals[m, k, column]
                following[row] = total
            for row in range(states):
                state[m, k, row] = following[row]
            out[k] += scale * levels[m, k] * following[states]


def _resonance(rate: float, damping: float, fraction: float, period_s: float) -> _Resonance:
    """White noise through x'' + 2 d w x' + w^2 x, of which x' has unit variance, through the mount,
    and its integral over a sample, discretised exactly (Van Loan, 1978)."""
    from scipy.linalg import expm, solve_continuous_lyapunov

    corner = 2.0 * math.pi * ISOLATION_CORNER_HZ
    motion = np.zeros((5, 5))
    motion[0, 1] = 1.0
    motion[1, :2] = -rate * rate, -2.0 * damping * rate
    motion[2, 3] = 1.0
    motion[3, 1:4] = corner * corner, -corner * corner, -math.sqrt(2.0) * corner
    motion[4, 1:3] = fraction, 1.0 - fraction
    drive = np.zeros((5, 5))
    drive[1, 1] = 4.0 * damping * rate
    blocks = np.block([[-motion, drive], [np.zeros((5, 5)), motion.T]])
    grown = expm(blocks * period_s)
    advance = grown[5:, 5:].T
    added = advance @ grown[:5, 5:]
    mean = np.array([1.0, 1.0, 1.0, 1.0, 1.0 / period_s])
    advance, added = advance * mean[:, None], added * np.outer(mean, mean)
    stationary = solve_continuous_lyapunov(motion[:4, :4], -drive[:4, :4])
    return _Resonance(advance[:, :4].copy(), _root(added), _root(stationary))


def _root(covariance: Array) -> Array:
    """A matrix R with R R^T = ``covariance``, which may be singular."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    return vectors * np.sqrt(np.maximum(values, 0.0))
