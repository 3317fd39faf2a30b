"""Scan patterns (direction of pulse number k) and data-sheet figures of LIDARs.

Parameters of the Livox patterns were fitted to recordings of the real sensors; ranges, fields of
view, rates and beam widths are those of the manufacturers' data sheets and user manuals.

Horizon and Avia send beams through rotating wedge prisms (Risley prisms), traced with Snell's law.

Each prism refracts at two faces; the faces' normals turn with the motors, so the direction of a
pulse is a pure function of its number and never repeats within a flight. The optics is the textbook
one (e.g. Li, "Closed-form analytical inverse solutions for Risley-prism-based beam steering systems
in different configurations", Applied Optics 50, 2011).

Recordings of the Mid-360 show a fan of four beams that turns about itself at 182.4 Hz while it runs
round the horizon at the same rate; a slower drive carries it up and down between -7 and 52 degrees
ten times a second, leading and lagging in azimuth as it goes. Its closed form holds the leading
terms of a Fourier series fitted to such recordings, four seconds of which it follows within 0.9
degrees (root mean square).

OS1-16 and PandarXT-16 turn a column of beams about their axis. Beams of a column are taken to fire
one after another at equal intervals; the OS1's fire at once, the XT's within 30 microseconds.
"""

import copy
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numba import njit

from touchdown.sim.api import LidarPreset
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

    def erring(self, error_rad: float, azimuth_rad: float) -> "RisleyPattern":
        """The pattern of a sensor whose first prism is tilted or badly ground: it deflects by
        ``error_rad`` more, towards ``azimuth_rad`` from its wedge, and this direction turns with
        it. The error is a thin wedge before the prism, which deflects by (n - 1) times its angle.

        Errors of single prisms: Zhou et al., "Pointing error analysis of Risley-prism-based beam
        steering system", Applied Optics 53, 2014; of a Livox Mid-40: Brazeal, Wilkinson and
        Hochmair, Sensors 21, 4722, 2021.
        """
        wedge = self._rows[0].copy()
        wedge[1] += azimuth_rad
        wedge[2] = error_rad / (self._index - 1.0)
        erring = copy.copy(self)
        erring._rows = np.vstack([wedge, self._rows])
        erring._turns = np.concatenate([self._turns[:, :1], self._turns], axis=1)
        return erring


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


_MID360_RATE_HZ = 200_000
_LASERS = 4
_ROUND_HZ = -182.41768
_NOD_HZ = 9.99903
_AZIMUTH_DEG = 270.58
_ELEVATION_DEG = (20.45, 23.52, 1.12, 2.30)
"""Mean, and amplitudes of the nod and its harmonics."""
_LEAD_DEG = (28.42, 2.34, 2.69)
_FAN_STEP_DEG = 0.92
"""Half the angle between neighbours in the fan."""
_FAN_WIDENING = 1.14
"""Widening of the fan in azimuth, where the meridians converge."""


def _mid360_directions(start_index: int, count: int) -> Float32:
    """(count, 3) float32 unit directions of the pulses from ``start_index`` on, in a frame whose z
    is the sensor's axis: elevation counts from its x-y plane towards +z, the side it sees most of.

    Raises ValueError for a negative index or count.
    """
    check_pulses(start_index, count)
    beams = np.empty((count, 3), dtype=np.float32)
    _trace_mid360(start_index, beams)
    return beams


@njit(cache=True, nogil=True, error_model="numpy")
def _trace_mid360(start_index: int, beams: Float32) -> None:
    for k in range(beams.shape[0]):
        index = start_index + k
        turns, nods = _ROUND_HZ * index / _MID360_RATE_HZ, _NOD_HZ * index / _MID360_RATE_HZ
        angle = 2.0 * math.pi * (turns - math.floor(turns))
        nod = 2.0 * math.pi * (nods - math.floor(nods))
        c, s = math.cos(angle), math.sin(angle)
        c1, s1 = math.cos(nod), math.sin(nod)
        c2, s2 = 2.0 * c1 * c1 - 1.0, 2.0 * s1 * c1
        c3, s3 = c2 * c1 - s2 * s1, s2 * c1 + c2 * s1
        place = _FAN_STEP_DEG * (_LASERS - 1 - 2 * (index % _LASERS))
        elevation = _ELEVATION_DEG[0] + _ELEVATION_DEG[1] * c1 + _ELEVATION_DEG[2] * c2
        elevation = math.radians(elevation + _ELEVATION_DEG[3] * c3 + place * c)
        lead = _LEAD_DEG[0] * s1 + _LEAD_DEG[1] * s2 + _LEAD_DEG[2] * s3
        azimuth = angle + math.radians(_AZIMUTH_DEG + lead - _FAN_WIDENING * place * s)
        level = math.cos(elevation)
        beams[k, 0] = level * math.cos(azimuth)
        beams[k, 1] = level * math.sin(azimuth)
        beams[k, 2] = math.sin(elevation)


@dataclass(frozen=True, slots=True)
class SpinningPattern:
    """A column of ``beams`` between ``-half_view_deg`` and ``half_view_deg`` of elevation, at equal
    steps, that turns about z: ``columns`` a turn, from the x axis towards y."""

    beams: int
    half_view_deg: float
    columns: int

    def __call__(self, start_index: int, count: int) -> Float32:
        """As those of ``RisleyPattern``; within a column from below upwards."""
        check_pulses(start_index, count)
        index = np.arange(start_index, start_index + count)
        azimuth = 2.0 * np.pi / self.columns * (index // self.beams % self.columns)
        step = 2.0 * self.half_view_deg / (self.beams - 1)
        elevation = np.deg2rad(index % self.beams * step - self.half_view_deg)
        level = np.cos(elevation)
        beams = [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)]
        return np.stack(beams, axis=-1).astype(np.float32)


@dataclass(frozen=True, kw_only=True, slots=True)
class ScanPattern:
    """``directions(start_index, count)`` gives (count, 3) float32 unit vectors in the LIDAR frame
    (x long axis, z boresight) of the pulses ``start_index ... start_index + count - 1``; pulse k
    fires at ``k / point_rate_hz`` seconds."""

    directions: Callable[[int, int], Float32]
    point_rate_hz: int
    field_of_view_deg: tuple[float, float]
    """along x and along y; for a sensor that looks all round: azimuth and elevation"""
    range_limits_m: tuple[float, ...]
    """detection range at each of ``range_reflectivities``, full sunlight"""
    range_reflectivities: tuple[float, ...]
    max_range_m: float
    divergence_deg: tuple[float, float]
    """full width at half maximum of the beam along x and y"""


_FAST_HZ = 121.567
_FAST_PHASE = 4.78534

HORIZON = ScanPattern(
    directions=RisleyPattern(
        (
            Prism(frequency_hz=-_FAST_HZ / 12.2361, phase_rad=4.55226, wedge_rad=0.32929),
            Prism(frequency_hz=_FAST_HZ, phase_rad=_FAST_PHASE + 1.56112, wedge_rad=0.41937),
            Prism(
                frequency_hz=-_FAST_HZ,
                phase_rad=-_FAST_PHASE + 1.56112,
                wedge_rad=0.41991,
                flat_face_first=False,
            ),
        ),
        lasers=6,
        spread_rad=0.03661,
        point_rate_hz=240_000,
    ),
    point_rate_hz=240_000,
    field_of_view_deg=(81.7, 25.1),
    range_limits_m=(90.0, 130.0, 260.0),
    range_reflectivities=(0.1, 0.2, 0.8),
    max_range_m=260.0,
    divergence_deg=(0.03, 0.28),
)
"""Six lasers through a slow prism and a pair that turns against one another."""

AVIA = ScanPattern(
    directions=RisleyPattern(
        (
            Prism(
                frequency_hz=131.55003, phase_rad=3.13259, wedge_rad=0.28685, flat_face_first=False
            ),
            Prism(frequency_hz=-40.79991, phase_rad=0.00125, wedge_rad=0.28803),
        ),
        lasers=6,
        spread_rad=-0.03931,
        point_rate_hz=240_000,
        refractive_index=1.89951,
    ),
    point_rate_hz=240_000,
    field_of_view_deg=(70.4, 77.2),
    range_limits_m=(190.0, 230.0, 320.0),
    range_reflectivities=(0.1, 0.2, 0.8),
    max_range_m=320.0,
    divergence_deg=(0.03, 0.28),
)
"""Six lasers through two prisms that turn at different rates: a rosette that never closes.
Stays within 0.13 degrees (root mean square) of four seconds of recordings."""

MID360 = ScanPattern(
    directions=_mid360_directions,
    point_rate_hz=_MID360_RATE_HZ,
    field_of_view_deg=(360.0, 59.0),
    range_limits_m=(40.0, 70.0),
    range_reflectivities=(0.1, 0.8),
    max_range_m=70.0,
    divergence_deg=(0.28, 0.28),
)
"""Mounted like the others it looks down and around: its z axis points down, and within 38 degrees
of nadir it sees nothing. The manufacturer states no beam width: that of its others is
taken."""

OS1_16 = ScanPattern(
    directions=SpinningPattern(beams=16, half_view_deg=16.6, columns=2048),
    point_rate_hz=327_680,
    field_of_view_deg=(360.0, 33.2),
    range_limits_m=(40.0, 120.0),
    range_reflectivities=(0.1, 0.8),
    max_range_m=120.0,
    divergence_deg=(0.13, 0.13),
)
"""Ouster OS1-16 (data sheet), 2048 columns at 10 turns a second."""

XT16 = ScanPattern(
    directions=SpinningPattern(beams=16, half_view_deg=15.0, columns=2000),
    point_rate_hz=320_000,
    field_of_view_deg=(360.0, 30.0),
    range_limits_m=(80.0, 120.0),
    range_reflectivities=(0.1, 0.8),
    max_range_m=120.0,
    divergence_deg=(0.13, 0.13),
)
"""Hesai PandarXT-16 (user manual), 10 turns a second. The beam width is that of the OS1."""

PATTERNS: Mapping[LidarPreset, ScanPattern] = MappingProxyType(
    {"avia": AVIA, "horizon": HORIZON, "mid360": MID360, "os1_16": OS1_16, "xt16": XT16}
)
"""Scan patterns by preset name."""
