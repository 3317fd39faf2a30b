"""Beams through rotating wedge prisms (Risley prisms), traced with Snell's law.

Each prism refracts at two faces; the faces' normals turn with the motors, so the direction of a
pulse is a pure function of its number and never repeats within a flight. The optics is the textbook
one (e.g. Li, "Closed-form analytical inverse solutions for Risley-prism-based beam steering systems
in different configurations", Applied Optics 50, 2011).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from touchdown.sim.typing import Array, Float32

_BLOCK = 384
"""Pulses traced together: fills the lanes of the processor; a multiple of every laser count."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Prism:
    """A wedge prism that turns at ``frequency_hz`` (negative: clockwise seen along the beam). The
    normal of its wedge face has azimuth ``phase_rad`` at time 0."""

    frequency_hz: float
    phase_rad: float
    wedge_rad: float
    flat_face_first: bool = True


class RisleyPattern:
    """Beam directions of ``lasers`` that fire in turn through ``prisms``, in the order the beam
    meets them. Laser i enters in the y-z plane at (2 i / (lasers - 1) - 1) ``spread_rad``."""

    def __init__(
        self,
        prisms: tuple[Prism, ...],
        *,
        lasers: int,
        spread_rad: float,
        point_rate_hz: int,
        refractive_index: float = 1.51,
    ) -> None:
        if _BLOCK % lasers:
            raise ValueError(f"{lasers} lasers do not divide the block of {_BLOCK} pulses")
        self._rows = np.array(
            [[p.frequency_hz, p.phase_rad, p.wedge_rad, p.flat_face_first] for p in prisms]
        )
        self._rate = point_rate_hz
        self._index = refractive_index
        tilts = (2.0 * (np.arange(_BLOCK) % lasers) / (lasers - 1) - 1.0) * spread_rad
        self._entry = np.stack([np.sin(tilts), np.cos(tilts)])
        steps = 2.0 * math.pi * self._rows[:, :1] * np.arange(_BLOCK) / point_rate_hz
        self._turns = np.stack([np.cos(steps), np.sin(steps)])

    def __call__(self, start_index: int, count: int) -> Float32:
        """(count, 3) float32 unit directions in the LIDAR frame of the pulses from
        ``start_index`` on. Raises ValueError for a negative index or count."""
        check_pulses(start_index, count)
        beams = np.empty((count, 3), dtype=np.float32)
        _trace(start_index, beams, self._rows, self._index, self._rate, self._entry, self._turns)
        return beams


def check_pulses(start_index: int, count: int) -> None:
    """Raises ValueError for a negative index or count."""
    if start_index < 0 or count < 0:
        raise ValueError(
            f"pulse index {start_index} and count {count} must not be negative: "
            "pulses are numbered from the start of the simulation"
        )


@njit(cache=True, nogil=True, error_model="numpy")
def _trace(
    start_index: int,
    beams: Float32,
    prisms: Array,
    refractive_index: float,
    rate: int,
    entry: Array,
    turns: Array,
) -> None:
    """Fills ``beams`` (N, 3), block by block; blocks are aligned to the pulse numbers, so that a
    pulse comes out the same to the bit however the calls are cut."""
    x, y, z = np.empty(_BLOCK), np.empty(_BLOCK), np.empty(_BLOCK)
    block = start_index // _BLOCK
    done = 0
    while done < beams.shape[0]:
        first = block * _BLOCK
        for j in range(_BLOCK):
            x[j], y[j], z[j] = 0.0, entry[0, j], entry[1, j]
        for p in range(prisms.shape[0]):
            turned = prisms[p, 0] * (first / rate)
            azimuth = 2.0 * math.pi * (turned - math.floor(turned)) + prisms[p, 1]
            nx, ny = math.cos(azimuth), math.sin(azimuth)
            wedge, nz = math.sin(prisms[p, 2]), math.cos(prisms[p, 2])
            nx, ny = wedge * nx, wedge * ny
            if prisms[p, 3] > 0.5:
                _refract_flat(x, y, z, 1.0 / refractive_index)
                _refract_wedge(x, y, z, nx, ny, nz, turns[0, p], turns[1, p], refractive_index)
            else:
                inverse = 1.0 / refractive_index
                _refract_wedge(x, y, z, nx, ny, nz, turns[0, p], turns[1, p], inverse)
                _refract_flat(x, y, z, refractive_index)
        skipped = start_index + done - first
        taken = min(_BLOCK - skipped, beams.shape[0] - done)
        for j in range(taken):
            beams[done + j, 0] = x[skipped + j]
            beams[done + j, 1] = y[skipped + j]
            beams[done + j, 2] = z[skipped + j]
        done += taken
        block += 1


@njit(cache=True, inline="always", error_model="numpy")
def _refract_flat(x: Array, y: Array, z: Array, ratio: float) -> None:
    """Crosses a face whose normal is the z axis; ``ratio`` is index before over index behind."""
    for j in range(_BLOCK):
        x[j] *= ratio
        y[j] *= ratio
        z[j] = np.sqrt(1.0 - x[j] * x[j] - y[j] * y[j])


@njit(cache=True, inline="always", error_model="numpy")
def _refract_wedge(
    x: Array,
    y: Array,
    z: Array,
    nx: float,
    ny: float,
    nz: float,
    turn_cos: Array,
    turn_sin: Array,
    ratio: float,
) -> None:
    """Snell's law in vector form at a face whose unit normal (nx, ny, nz) points along the ray and
    turns about z by ``turn_cos``, ``turn_sin`` (_BLOCK,)."""
    for j in range(_BLOCK):
        ax = nx * turn_cos[j] - ny * turn_sin[j]
        ay = nx * turn_sin[j] + ny * turn_cos[j]
        cosine = x[j] * ax + y[j] * ay + z[j] * nz
        gain = np.sqrt(1.0 - ratio * ratio * (1.0 - cosine * cosine)) - ratio * cosine
        x[j] = ratio * x[j] + gain * ax
        y[j] = ratio * y[j] + gain * ay
        z[j] = ratio * z[j] + gain * nz
