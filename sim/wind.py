"""Wind: a mean flow with a logarithmic profile, and Dryden turbulence for low altitude.

Turbulence after MIL-F-8785C, section 3.7.2 and 3.7.3.4, below 1000 ft. With h the height in feet
(never below 10), W20 the mean wind at 20 ft and V the airspeed:

    sigma_w = 0.1 W20,    sigma_u = sigma_v = sigma_w / (0.177 + 0.000823 h)^0.4
    L_w = h,              L_u = L_v = h / (0.177 + 0.000823 h)^1.2
    H_u(s) = sigma_u sqrt(2 L_u / pi V) / (1 + L_u s / V)
    H_v(s) = sigma_v sqrt(L_v / pi V) (1 + sqrt(3) L_v s / V) / (1 + L_v s / V)^2,   H_w alike

u is along the mean wind, v to its left, w up. The filters run on states of unit variance, so that
height and airspeed may change from step to step, and are discretised exactly for the step's length.

With ``short_waves`` each of u, v, w is a sum of five first-order lags instead, of scales L, L / 3,
... L / 81, each with 3^(2/3) times the variance of the next (Kolmogorov's cascade); together they
have sigma^2. Scales and their number come nearest to Kaimal's spectrum at 30 m.

Rotational gusts after section 3.7.3.2 of the same, with b the span: a rotation of the air about the
vehicle, whose rolling share has a noise of its own, and whose others follow w and v,

    H_p(s) = sigma_w sqrt(0.8 / V) (pi / 4 b)^(1/6) / (L_w^(1/3) (1 + 4 b / (pi V) s))
    H_q(s) = (s / V) / (1 + 4 b / (pi V) s) H_w(s)
    H_r(s) = (s / V) / (1 + 3 b / (pi V) s) H_v(s)
"""

from zlib import crc32

import numpy as np
from numba import njit

from touchdown.sim.api import WindParams
from touchdown.sim.typing import Array

FOOT_M = 0.3048
REFERENCE_HEIGHT_M = 20.0 * FOOT_M
MIN_HEIGHT_FT = 10.0
MAX_HEIGHT_FT = 1000.0
MIN_AIRSPEED_MPS = 1.0
"""Airspeed below which V / L no longer describes how fast turbulence passes the vehicle."""

_SQRT3 = np.sqrt(3.0)
_SCALES, _STEP = 5, 3.0


class Wind:
    """The air's velocity at the vehicle. ``mean_direction`` (3,) is horizontal and of unit norm.
    ``span_m`` is the vehicle's, for rotational gusts."""

    def __init__(self, params: WindParams, seed: int, span_m: float = 1.0) -> None:
        self._rng = np.random.default_rng([seed, crc32(b"wind")])
        seeded_direction = self._rng.uniform(-np.pi, np.pi)
        direction = (
            seeded_direction
            if params.direction_deg is None
            else float(np.radians(params.direction_deg))
        )
        self.mean_direction = np.array([np.cos(direction), np.sin(direction), 0.0])
        self._w20 = params.mean_kmh / 3.6
        self._roughness = params.roughness_length_m
        self._turbulent = params.turbulence and self._w20 > 0.0
        self._noise = np.empty(5)
        self._state = _stationary_state(self._rng.standard_normal(5))
        self._velocity = np.zeros(3)
        self._gust = np.zeros(3)
        self._cascade: Array | None = None
        if params.short_waves and self._turbulent:
            self._cascade_rng = np.random.default_rng([seed, crc32(b"wind.short_waves")])
            self._cascade = self._cascade_rng.standard_normal((3, _SCALES))
        self._span = span_m
        self.rotational = params.rotational and self._turbulent
        if self.rotational:
            self._rotation_rng = np.random.default_rng([seed, crc32(b"wind.rotational")])
            self._rotation_state = np.array([self._rotation_rng.standard_normal(), 0.0, 0.0])
            self._rates = np.zeros(3)

    @property
    def friction(self) -> float:
        """Speed of the mean wind over the logarithm of height / roughness length, m/s."""
        return float(self._w20 / np.log(REFERENCE_HEIGHT_M / self._roughness))

    def mean_speed(self, height_m: float) -> float:
        """Mean wind speed in m/s at a height over the ground; 0 at the roughness length."""
        height = max(height_m, self._roughness)
        profile = np.log(height / self._roughness) / np.log(REFERENCE_HEIGHT_M / self._roughness)
        return float(self._w20 * profile)

    def step(self, dt_s: float, height_m: float, airspeed_mps: float) -> Array:
        """Advances by ``dt_s`` and returns the wind, (3,) m/s in the world frame (valid until the
        next call).

        height_m: over the ground; airspeed_mps: of the vehicle relative to the mean flow.
        """
        along = self.mean_speed(height_m)
        if not self._turbulent:
            np.multiply(self.mean_direction, along, out=self._velocity)
            return self._velocity
        place = dt_s, height_m / FOOT_M, max(airspeed_mps, MIN_AIRSPEED_MPS), self._w20
        if self._cascade is None:
            self._rng.standard_normal(out=self._noise)
            _advance(self._state, self._noise, *place, self._gust)
        else:
            noise = self._cascade_rng.standard_normal((3, _SCALES))
            _advance_cascade(self._cascade, noise, *place, self._gust)
        u, v = along + self._gust[0], self._gust[1]
        east, north = self.mean_direction[:2]
        self._velocity[:] = u * east - v * north, u * north + v * east, self._gust[2]
        return self._velocity

    def rotation(self, dt_s: float, height_m: float, airspeed_mps: float) -> Array:
        """Angular velocity of the air about the vehicle, (3,) rad/s in the world frame (valid until
        the next call); called once after each ``step``, where ``rotational`` is true."""
        _advance_rotation(
            self._rotation_state,
            self._gust,
            float(self._rotation_rng.standard_normal()),
            dt_s,
            height_m / FOOT_M,
            max(airspeed_mps, MIN_AIRSPEED_MPS),
            self._w20,
            self._span,
            self.mean_direction,
            self._rates,
        )
        return self._rates


@njit(cache=True, error_model="numpy")
def dryden_scales(height_ft: float, w20_mps: float) -> tuple[float, float, float, float]:
    """``sigma_uv`` and ``sigma_w`` in m/s, ``L_uv`` and ``L_w`` in metres."""
    height = min(max(height_ft, MIN_HEIGHT_FT), MAX_HEIGHT_FT)
    shape = 0.177 + 0.000823 * height
    sigma_w = 0.1 * w20_mps
    return sigma_w / shape**0.4, sigma_w, height / shape**1.2 * FOOT_M, height * FOOT_M


def _stationary_state(noise: Array) -> Array:
    """(5,) standard normal -> a draw of (u, a_v, b_v, a_w, b_w) in steady state. The pair (a, b)
    has the covariance [[1/2, 1/4], [1/4, 1/4]]."""
    state = np.empty(5)
    state[0] = noise[0]
    for i in (1, 3):
        state[i] = np.sqrt(0.5) * noise[i]
        state[i + 1] = 0.5 * state[i] + np.sqrt(0.125) * noise[i + 1]
    return state


@njit(cache=True, error_model="numpy")
def _advance(
    state: Array,
    noise: Array,
    dt: float,
    height_ft: float,
    airspeed: float,
    w20: float,
    gust: Array,
) -> None:
    """Fills ``gust`` (3,): u, v, w in m/s."""
    sigma_uv, sigma_w, scale_uv, scale_w = dryden_scales(height_ft, w20)
    steps_uv = dt * airspeed / scale_uv
    steps_w = dt * airspeed / scale_w
    state[0] = np.exp(-steps_uv) * state[0] + np.sqrt(-np.expm1(-2.0 * steps_uv)) * noise[0]
    _advance_pair(state[1:3], noise[1:3], steps_uv)
    _advance_pair(state[3:5], noise[3:5], steps_w)
    gust[0] = sigma_uv * state[0]
    gust[1] = sigma_uv * (_SQRT3 * state[1] + (1.0 - _SQRT3) * state[2])
    gust[2] = sigma_w * (_SQRT3 * state[3] + (1.0 - _SQRT3) * state[4])


@njit(cache=True, error_model="numpy")
def _advance_cascade(
    state: Array,
    noise: Array,
    dt: float,
    height_ft: float,
    airspeed: float,
    w20: float,
    gust: Array,
) -> None:
    """As `_advance`, of ``state`` (3, `_SCALES`) of unit variance."""
    sigma_uv, sigma_w, scale_uv, scale_w = dryden_scales(height_ft, w20)
    for axis in range(3):
        sigma, scale = (sigma_w, scale_w) if axis == 2 else (sigma_uv, scale_uv)
        share, steps, total, gust[axis] = 1.0, dt * airspeed / scale, 0.0, 0.0
        for k in range(_SCALES):
            keep = np.exp(-steps)
            fresh = np.sqrt(-np.expm1(-2.0 * steps)) * noise[axis, k]
            state[axis, k] = keep * state[axis, k] + fresh
            gust[axis] += np.sqrt(share) * state[axis, k]
            total += share
            share, steps = share * _STEP ** (-2.0 / 3.0), steps * _STEP
        gust[axis] *= sigma / np.sqrt(total)


@njit(cache=True, error_model="numpy")
def rolling_gust_sigma(sigma_w: float, scale_w: float, span: float) -> float:
    """Standard deviation of p, rad/s: that of H_p driven by white noise of unit one-sided density.
    Independent of the airspeed, as turbulence is frozen."""
    corner = np.pi / (4.0 * span)
    density = 0.8 * sigma_w**2 * corner ** (1.0 / 3.0) / scale_w ** (2.0 / 3.0)
    return np.sqrt(density * corner * np.pi / 2.0)


@njit(cache=True, error_model="numpy")
def _advance_rotation(
    state: Array,
    gust: Array,
    noise: float,
    dt: float,
    height_ft: float,
    airspeed: float,
    w20: float,
    span: float,
    direction: Array,
    rates: Array,
) -> None:
    """``state``: p of unit variance, and w and v behind the filters' lags."""
    _, sigma_w, _, scale_w = dryden_scales(height_ft, w20)
    v, w = gust[1], gust[2]
    corner_q, corner_r = np.pi / (4.0 * span), np.pi / (3.0 * span)
    decay = np.exp(-dt * airspeed * corner_q)
    state[0] = decay * state[0] + np.sqrt(1.0 - decay * decay) * noise
    # (s / V) / (1 + T s) with T = 1 / (corner V) is corner (1 - 1 / (1 + T s)). The lagged value of
    # the middle of the step makes it exact to second order.
    lagged_w, lagged_v = state[1], state[2]
    state[1] += (1.0 - decay) * (w - state[1])
    state[2] += (1.0 - np.exp(-dt * airspeed * corner_r)) * (v - state[2])
    p = rolling_gust_sigma(sigma_w, scale_w, span) * state[0]
    q = corner_q * (w - 0.5 * (lagged_w + state[1]))
    rates[0] = p * direction[0] - q * direction[1]
    rates[1] = p * direction[1] + q * direction[0]
    rates[2] = corner_r * (v - 0.5 * (lagged_v + state[2]))


@njit(cache=True, error_model="numpy")
def _advance_pair(pair: Array, noise: Array, steps: float) -> None:
    """a = n / (1 + T s), b = a / (1 + T s) over ``steps = dt / T``; n is white of intensity T.

    The filter's output is ``b + sqrt(3) T db/dt = sqrt(3) a + (1 - sqrt(3)) b``, of unit variance.
    The covariance of what the noise adds is the integral of (1, x)(1, x)^T exp(-2x) over the step.
    """
    q_aa = _moment(0, steps)
    q_ab = _moment(1, steps)
    q_bb = _moment(2, steps)
    decay = np.exp(-steps)
    add_a = np.sqrt(q_aa) * noise[0]
    add_b = q_ab / q_aa * add_a + np.sqrt(max(q_bb - q_ab * q_ab / q_aa, 0.0)) * noise[1]
    a = pair[0]
    pair[0] = decay * a + add_a
    pair[1] = decay * (steps * a + pair[1]) + add_b


@njit(cache=True, error_model="numpy")
def _moment(power: int, steps: float) -> float:
    """Integral of x^power exp(-2x) over [0, steps]; a series where the closed form cancels."""
    if steps < 0.1:
        term = steps ** (power + 1)
        total = 0.0
        for k in range(12):
            total += term / (power + 1 + k)
            term *= -2.0 * steps / (k + 1)
        return total
    decay = np.exp(-2.0 * steps)
    if power == 0:
        return (1.0 - decay) / 2.0
    if power == 1:
        return (1.0 - decay * (1.0 + 2.0 * steps)) / 4.0
    return (1.0 - decay * (1.0 + 2.0 * steps + 2.0 * steps * steps)) / 4.0
