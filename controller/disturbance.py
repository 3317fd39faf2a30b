"""An observer of the aerodynamic force on the vehicle.

Measured acceleration, less gravity and the thrust of the modelled rotors along the measured body
axis, leaves the aerodynamic force: drag of wind and own speed. Thrust and tilt are those of the
vehicle, not those commanded, so that the loops' own action cancels in the difference, and the
feed-forward of the observed force leaves the loops' margins unchanged (an incremental inversion in
the sense of Smeur, de Croon and Chu, 2018).

The vertical share, where it is asked for, is bounded to downward forces. A vehicle that leans into
a strong wind has air flowing down through its rotors, which takes up to half of their thrust; the
integral of the velocity loop cannot hold as much. Upward forces are left to the loops: near the
ground they are those of ground effect and of the legs' contact.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from touchdown.sim.api import GRAVITY_MPS2, VehicleModel

Array = NDArray[np.float64]

_SUPPORTED = 0.35 * GRAVITY_MPS2
"""An unexplained upward acceleration above this means ground contact. In the air a fast descent
through the rotors' inflow reaches about half of it."""


class DisturbanceObserver:
    """Low-pass estimate of the acceleration that thrust does not explain: the horizontal share, and
    with ``vertical`` the loss of thrust along z, which is 0 or below."""

    def __init__(
        self,
        vehicle: VehicleModel,
        bandwidth_radps: float,
        step_s: float,
        *,
        vertical: bool = False,
    ) -> None:
        self._vertical = vertical
        self._thrust_per_mass = vehicle.thrust_coefficient / vehicle.mass_kg
        self._approach = 1.0 - float(np.exp(-bandwidth_radps * step_s))
        self.reset()

    def reset(self) -> None:
        """Resets the estimate to still air."""
        self.acceleration = np.zeros(3)

    def update(
        self, acceleration: Array, rotation: Array, rotor_speed_radps: Array, expected: Array
    ) -> Array:
        """(3,) m/s^2 beyond ``expected`` (3,), odom frame; without ``vertical`` z is always 0.

        acceleration: (3,) m/s^2 measured, gravity removed; rotation: odom_from_body;
        rotor_speed_radps: (4,) modelled. Forgets while the ground carries the vehicle, where the
        unexplained force is friction.
        """
        self.acceleration = _update(
            self.acceleration,
            acceleration,
            rotation,
            self._thrust_per_mass * float(rotor_speed_radps @ rotor_speed_radps),
            expected,
            self._approach,
            self._vertical,
        )
        return self.acceleration


@njit(cache=True, error_model="numpy")
def _update(
    estimate: Array,
    acceleration: Array,
    rotation: Array,
    thrust_per_mass: float,
    expected: Array,
    approach: float,
    vertical: bool,
) -> Array:
    residual = acceleration - thrust_per_mass * rotation[:, 2] - expected
    residual[2] += GRAVITY_MPS2
    if residual[2] > _SUPPORTED:
        residual[:] = 0.0
    if not vertical:
        residual[2] = 0.0
    following = estimate + approach * (residual - estimate)
    following[2] = min(following[2], 0.0)
    return following
