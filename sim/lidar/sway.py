"""Crowns that sway in the wind.

A tree is a damped oscillator that the gusts drive. Its fundamental frequency is linear in D / H^2,
with D the stem's diameter and H the height (Moore and Maguire, Trees 18, 2004): about 0.095 Hz +
3.43 D / H^2 in cm and m, here with H / D = 60. The standard deviation of its displacement is that
of the drag, twice the intensity of turbulence times the mean, over the stiffness: it grows with the
square of the wind. Along the wind a crown moves twice as far as across it. Each porous geom of the
scene is a crown of its own, which moves as a whole.

What a ray meets moves along: the range changes by the displacement across the surface over the
cosine of incidence, as on a plane. The surface's normal is that of the ellipsoid in the crown's
box. Outlines stay where they are, with the rays that meet or miss them, and the lean in the mean
wind is left out.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from zlib import crc32

import numpy as np
from numba import njit

from touchdown.sim.api import AIR_DENSITY_KGPM3, LidarParams
from touchdown.sim.geometry.ray_target import Hits
from touchdown.sim.lidar.raycast_scene import LidarScene
from touchdown.sim.lidar.rays import Rays
from touchdown.sim.typing import Array, Mask

TURBULENCE = 0.2
"""Standard deviation of the wind over its mean (MIL-F-8785C at tree height)"""
DRAG_AREA_M2PKG = 0.025
"""Drag area of a crown in leaf over its modal mass, assumed: 5 m^2 on 200 kg"""
SLENDERNESS = 60.0
_ACROSS = 0.5
_BEATS = 7.0
"""periods over which the swing waxes and wanes"""
_WAXING = 0.5
_MIN_HEIGHT_M = 0.5
_MIN_HALF_M = 0.05
_MIN_COSINE = 0.3
_TINY = 1e-12


@dataclass(frozen=True)
class Sway:
    """The motion of all crowns of a scene; arrays of (G,) by geom id."""

    porous: Mask
    along: Array
    """(2,) unit vector that the wind blows to"""
    amplitude_m: Array
    frequency_hz: Array
    phases: Array
    """(3, G) rad"""
    centers: Array
    """(G, 3) of the crowns' boxes, world frame"""
    squares: Array
    """(G, 3) of their half sides"""

    @staticmethod
    def of(params: LidarParams, scene: LidarScene, wind_mps: Array, seed: int) -> "Sway | None":
        """None where ``params``, the scene or the air give nothing that sways. ``wind_mps``: (2,)
        mean wind at 20 ft."""
        speed = float(np.hypot(*wind_mps))
        porous = scene.optics.porosity > 0.0
        if params.sway <= 0.0 or scene.static is None or speed <= 0.0 or not porous.any():
            return None
        draw = np.random.default_rng([seed, crc32(b"lidar sway")])
        crowns = scene.crowns(porous)
        porous &= crowns.height_m > 0.0  # not those that move anyway
        height = np.maximum(crowns.height_m, _MIN_HEIGHT_M)
        frequency = sway_frequency_hz(height)
        spread = params.sway * sway_sigma_m(frequency, speed)
        # of (1 + b sin) sin: the mean square is (1 + b^2 / 2) / 2
        amplitude = spread / math.sqrt(0.5 * (1.0 + 0.5 * _WAXING**2))
        return Sway(
            porous=porous,
            along=wind_mps / speed,
            amplitude_m=np.where(porous, amplitude, 0.0),
            frequency_hz=frequency,
            phases=draw.uniform(0.0, 2.0 * np.pi, (3, len(porous))),
            centers=0.5 * (crowns.low + crowns.high),
            squares=np.maximum(0.5 * (crowns.high - crowns.low), _MIN_HALF_M) ** 2,
        )

    def move(self, pulses: Rays, hits: Hits) -> tuple[int, float]:
        """Changes the distances of ``hits`` of ``pulses`` on crowns; the number of these, and the
        sum of the changes in metres."""
        return _move(pulses, hits, self.porous, self.along, self._swing, self.centers, self.squares)

    @cached_property
    def _swing(self) -> Array:
        """(G, 5) amplitudes, angular frequencies and phases."""
        return np.column_stack([self.amplitude_m, 2.0 * np.pi * self.frequency_hz, self.phases.T])


@njit(cache=True, forceinline=True, error_model="numpy")
def _displacement(time_s: float, along: Array, swing: Array) -> tuple[float, float]:
    phase = swing[1] * time_s
    size = swing[0] * (1.0 + _WAXING * math.sin(phase / _BEATS + swing[4]))
    far, beside = size * math.sin(phase + swing[2]), _ACROSS * size * math.sin(phase + swing[3])
    return far * along[0] - beside * along[1], far * along[1] + beside * along[0]


@njit(cache=True, nogil=True, error_model="numpy")
def _move(
    pulses: Rays,
    hits: Hits,
    porous: Mask,
    along: Array,
    swing: Array,
    centers: Array,
    squares: Array,
) -> tuple[int, float]:
    """As `Sway.move`; the arrays of (G,) geoms are those of `Sway`."""
    rays, times_s, _, _ = pulses
    distance, geom, cosine = hits
    moved, total = 0, 0.0
    for i in range(rays.shape[0]):
        g = geom[i]
        if g < 0 or not porous[g]:
            continue
        normal_x = (rays[i, 0] + distance[i] * rays[i, 3] - centers[g, 0]) / squares[g, 0]
        normal_y = (rays[i, 1] + distance[i] * rays[i, 4] - centers[g, 1]) / squares[g, 1]
        normal_z = (rays[i, 2] + distance[i] * rays[i, 5] - centers[g, 2]) / squares[g, 2]
        length = math.sqrt(normal_x * normal_x + normal_y * normal_y + normal_z * normal_z) + _TINY
        east, north = _displacement(times_s[i], along, swing[g])
        across = (normal_x * east + normal_y * north) / length
        # a surface that moves along its normal, towards the LIDAR, comes nearer
        before = distance[i]
        distance[i] -= np.float32(across / max(abs(cosine[i]), _MIN_COSINE))
        moved += distance[i] != before
        total += abs(distance[i] - before)
    return moved, total


def sway_frequency_hz(height_m: Array) -> Array:
    """Fundamental frequency of trees of these heights."""
    diameter_cm = 100.0 * height_m / SLENDERNESS
    return 0.0948 + 3.4317 * diameter_cm / height_m**2


def sway_sigma_m(frequency_hz: Array, wind_mps: float) -> Array:
    """Standard deviation of a crown's displacement along the wind."""
    pull_mps2 = 0.5 * AIR_DENSITY_KGPM3 * DRAG_AREA_M2PKG * wind_mps**2
    return 2.0 * TURBULENCE * pull_mps2 / (2.0 * np.pi * frequency_hz) ** 2
