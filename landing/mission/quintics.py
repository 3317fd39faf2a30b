"""Values of chains of quintic polynomials, compiled."""

import numpy as np
from numba import njit

from touchdown.sim.typing import Array


@njit(cache=True, error_model="numpy")
def sample_quintics(starts: Array, coefficients: Array, t: float) -> tuple[Array, Array, Array]:
    """Position (3,), velocity (3,) and acceleration (3,) at ``t`` seconds, SI, of the chain that
    `landing.mission.trajectory.PiecewiseTrajectory` describes.

    ``starts`` (n + 1,) s; ``coefficients`` (n, 6, 3)."""
    position, velocity, acceleration = np.zeros(3), np.zeros(3), np.zeros(3)
    last = starts.size - 2
    index = min(max(int(np.searchsorted(starts, t, side="right")) - 1, 0), last)
    if t < 0.0:
        for axis in range(3):
            position[axis] = coefficients[0, 0, axis]
        return position, velocity, acceleration
    beyond = max(t - starts[last + 1], 0.0)
    local = min(t, starts[last + 1]) - starts[index]
    for power in range(5, -1, -1):  # Horner's scheme for the value and two derivatives
        for axis in range(3):
            acceleration[axis] = acceleration[axis] * local + 2.0 * velocity[axis]
            velocity[axis] = velocity[axis] * local + position[axis]
            position[axis] = position[axis] * local + coefficients[index, power, axis]
    if beyond > 0.0:
        position += beyond * velocity
        acceleration[:] = 0.0
    return position, velocity, acceleration
