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

from __future__ import annotations

import math
from dataclasses import dataclass
from zlib import crc32

import numpy as np

from touchdown.sim.api import AIR_DENSITY_KGPM3, LidarParams
from touchdown.sim.geometry.ray_target import Hits
from touchdown.sim.lidar.raycast_scene import LidarScene
from touchdown.sim.typing import Array, Bools, Float32, Indices

TURBULENCE = 0.2
"""Standard deviation of the wind over its mean (MIL-F-8785C at tree height)"""
DRAG_AREA_M2PKG = 0.025
"""Drag area of a crown in leaf over its modal mass, assumed: 5 m^2 on 200 kg"""
SLENDERNESS = 60.0
_ACROSS = 0.5
_BEATS = 7.0
"""periods over which the swing waxes and wanes"""
_WAXING = 0.5
_LEAST_HEIGHT_M = 0.5
_LEAST_HALF_M = 0.05
_LEAST_COSINE = 0.3
_TINY = 1e-12


@dataclass(frozen=True)
class Sway:
    """The motion of all crowns of a scene; arrays of (G,) by geom id."""

    porous: Bools
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
    def of(params: LidarParams, scene: LidarScene, wind_mps: Array, seed: int) -> Sway | None:
        """None where ``params``, the scene or the air give nothing that sways. ``wind_mps``: (2,)
        mean wind at 20 ft."""
        speed = float(np.hypot(*wind_mps))
        porous = scene.optics.porosity > 0.0
        if params.sway <= 0.0 or scene.static is None or speed <= 0.0 or not porous.any():
            return None
        draw = np.random.default_rng([seed, crc32(b"lidar sway")])
        crowns = scene.crowns(porous)
        porous &= crowns.height_m > 0.0  # not those that move anyway
        height = np.maximum(crowns.height_m, _LEAST_HEIGHT_M)
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
            squares=np.maximum(0.5 * (crowns.high - crowns.low), _LEAST_HALF_M) ** 2,
        )

    def displacement_m(self, geoms: Indices, times_s: Array) -> Array:
        """(N, 2) displacements of crowns (N,) at instants (N,)."""
        phase = 2.0 * np.pi * self.frequency_hz[geoms] * times_s
        one, two, slow = self.phases[:, geoms]
        size = self.amplitude_m[geoms] * (1.0 + _WAXING * np.sin(phase / _BEATS + slow))
        along, across = size * np.sin(phase + one), _ACROSS * size * np.sin(phase + two)
        left = np.array([-self.along[1], self.along[0]])
        moved: Array = along[:, None] * self.along + across[:, None] * left
        return moved

    def move(self, rays: Float32, times_s: Array, hits: Hits) -> None:
        """Changes the distances of ``hits`` on crowns of the (N, 6) ``rays``, fired at (N,)
        ``times_s``."""
        rows = np.flatnonzero((hits.geom >= 0) & self.porous[hits.geom])
        if not rows.size:
            return
        geoms = hits.geom[rows].astype(np.int64)
        chosen, distance = rays[rows], hits.distance[rows, None]
        places = chosen[:, :3] + distance * chosen[:, 3:]
        normals = (places - self.centers[geoms]) / self.squares[geoms]
        lengths = np.sqrt(np.einsum("nc,nc->n", normals, normals)) + _TINY
        across = np.einsum("nc,nc->n", normals[:, :2], self.displacement_m(geoms, times_s[rows]))
        cosine = np.maximum(np.abs(hits.cosine[rows]), _LEAST_COSINE)
        # a surface that moves along its normal, towards the LIDAR, comes nearer
        hits.distance[rows] -= (across / lengths / cosine).astype(np.float32)


def sway_frequency_hz(height_m: Array) -> Array:
    """Fundamental frequency of trees of these heights."""
    diameter_cm = 100.0 * height_m / SLENDERNESS
    frequency: Array = 0.0948 + 3.4317 * diameter_cm / height_m**2
    return frequency


def sway_sigma_m(frequency_hz: Array, wind_mps: float) -> Array:
    """Standard deviation of a crown's displacement along the wind."""
    pull_mps2 = 0.5 * AIR_DENSITY_KGPM3 * DRAG_AREA_M2PKG * wind_mps**2
    sigma: Array = 2.0 * TURBULENCE * pull_mps2 / (2.0 * np.pi * frequency_hz) ** 2
    return sigma
