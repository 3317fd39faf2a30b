"""The landing lamp: a lamp beside the camera, whose light falls off with the square of distance.

The intensity is I0 cos(a)^m at the angle a off the optical axis, with m from the beam's angle of
half intensity and I0 = flux (m + 1) / (2 pi). A surface at the distance r whose normal makes the
angle b with the beam gets I cos(b) / r^2. The normal follows from the drawn inverse depths, which
are a linear function of the pixel on every plane. Surfaces are matt, there is no glint; lamp and
camera are at one place, so that no shadow of the lamp is seen.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from touchdown.sim.api import CameraIntrinsics, LampParams
from touchdown.sim.camera.gl import InverseDepth
from touchdown.sim.typing import Float32

_FAINT = 0.01
"""fraction of the ambient light below which the lamp's is left out"""
_PATCH = 8
"""the height is the median over the middle part of the raster, 1 / 8 of its width and height"""


class LampField(NamedTuple):
    """The lamp over a raster: a surface across the axis at the depth z = 1 / rho gets
    ``beam * rho**2`` lux, with the lens's own angles to axis and surface in ``beam`` (h, W)."""

    beam: Float32
    fx: float
    fy: float
    cx: float
    cy: float


def peak_candela(params: LampParams) -> float:
    """Intensity along the axis."""
    return params.flux_lm * (_exponent(params) + 1.0) / (2.0 * math.pi)


def lamp_field(params: LampParams, raster: CameraIntrinsics) -> LampField:
    """The field of a lamp at the camera that draws ``raster``."""
    x = (np.arange(raster.width) - raster.cx) / raster.fx
    y = (np.arange(raster.height) - raster.cy) / raster.fy
    stretch = np.sqrt(1.0 + x**2 + y[:, None] ** 2)
    beam = peak_candela(params) * stretch ** -(_exponent(params) + 3.0)
    return LampField(beam.astype(np.float32), raster.fx, raster.fy, raster.cx, raster.cy)


def shines(params: LampParams, depth: InverseDepth, ambient_lux: float) -> bool:
    """True where the ground in the middle of the image is nearer than ``below_m`` and the lamp
    brightens it visibly."""
    if params.below_m <= 0.0:
        return False
    rows, cols = depth.levels.shape
    h, w = max(rows // (2 * _PATCH), 1), max(cols // (2 * _PATCH), 1)
    middle = depth.levels[rows // 2 - h : rows // 2 + h : 4, cols // 2 - w : cols // 2 + w : 4]
    inverse = depth.far + depth.per_level * float(np.median(middle))
    bright = peak_candela(params) * inverse**2 > _FAINT * ambient_lux
    return inverse * params.below_m > 1.0 and bright


def _exponent(params: LampParams) -> float:
    return math.log(0.5) / math.log(math.cos(math.radians(0.5 * params.beam_deg)))


@njit(cache=True, nogil=True, fastmath=True, forceinline=True, error_model="numpy")
def lamp_row(
    levels: Float32, far: float, per_level: float, field: LampField, row: int, lux: Float32
) -> None:
    """Writes (W,) illuminance by the lamp of what row ``row`` of the raster shows. ``levels``:
    bottom row first."""
    rows, cols = levels.shape
    row = min(max(row, 2), rows - 3)
    up = rows - 1 - row
    line, before, behind, beam = levels[up], levels[up - 2], levels[up + 2], field.beam[row]
    base, rise, half = np.float32(far), np.float32(per_level), np.float32(0.5 * per_level)
    fx, fy = np.float32(field.fx), np.float32(field.fy)
    cx, dy = np.float32(field.cx), np.float32(row - field.cy)
    for col in range(2, cols - 2):
        here = line[col]
        # the smaller of both one-sided slopes: the other may cross an edge
        right, left = line[col + 2] - here, here - line[col - 2]
        low, high = before[col] - here, here - behind[col]
        u = half * (right if abs(right) < abs(left) else left)
        v = half * (low if abs(low) < abs(high) else high)
        rho = base + rise * here
        nz = rho - u * (np.float32(col) - cx) - v * dy
        normal = np.sqrt((fx * u) ** 2 + (fy * v) ** 2 + nz * nz)
        lux[col] = beam[col] * rho * rho * rho / normal
    lux[:2], lux[cols - 2 :] = lux[2], lux[cols - 3]
