"""Motion of a hull in irregular waves of a stated sea state.

Long-crested waves of the Pierson-Moskowitz spectrum by significant height H and modal period T
(Bretschneider's form), met at w - k U cos(a) in deep water. The response is the plainest one: the
hull follows the mean height and slope of the water under its rectangle.
"""

import numpy as np

from touchdown.scenes.api import Sway
from touchdown.sim.api import GRAVITY_MPS2

SEA_STATES: tuple[tuple[float, float], ...] = (
    (0.0, 7.5), (0.05, 7.5), (0.3, 7.5), (0.88, 7.5), (1.88, 8.8), (3.25, 9.7), (5.0, 12.4),
)  # fmt: skip
"""significant height, m, and modal period, s, of sea states 0 to 6: means of STANAG 4194, North
Atlantic"""
_WAVES = 60
_BAND = (0.5, 4.0)
"""of the frequencies, over the modal one"""


def wave_amplitudes(height_m: float, period_s: float, rates_radps: np.ndarray) -> np.ndarray:
    """(K,) m of waves at (K,) ascending rates, which carry the energy of the spectrum."""
    peak = 2.0 * np.pi / period_s
    density = (5.0 / 16.0) * height_m**2 * peak**4 / rates_radps**5
    density *= np.exp(-1.25 * (peak / rates_radps) ** 4)
    return np.sqrt(2.0 * density * np.gradient(rates_radps))


def hull_motion(
    rng: np.random.Generator, sea_state: int, size_m: tuple[float, float], speed_mps: float
) -> Sway:
    """The motion of a hull of ``size_m``, length and width, under way at ``speed_mps``, with waves
    from a direction and of phases that ``rng`` draws."""
    height, period = SEA_STATES[sea_state]
    peak = 2.0 * np.pi / period
    edges = np.linspace(_BAND[0] * peak, _BAND[1] * peak, _WAVES + 1)
    rates = rng.uniform(edges[:-1], edges[1:])  # sums of evenly spaced ones repeat themselves
    direction, phase = rng.uniform(-np.pi, np.pi), rng.uniform(0.0, 2.0 * np.pi, _WAVES)
    number = rates**2 / GRAVITY_MPS2
    along, across = number * np.cos(direction), number * np.sin(direction)
    mean = np.sinc(along * size_m[0] / (2.0 * np.pi)) * np.sinc(across * size_m[1] / (2.0 * np.pi))
    amplitude = mean * wave_amplitudes(height, period, rates)
    # Height is a cos(k x - w t + e) at x = U t, slope its derivative, and pitch down is positive.
    return Sway(
        rates_radps=along * speed_mps - rates,
        amplitudes=np.column_stack([amplitude, amplitude * across, -amplitude * along]),
        phases=np.column_stack([phase, phase + 0.5 * np.pi, phase + 0.5 * np.pi]),
    )
