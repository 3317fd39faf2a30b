"""Relief too fine for the height field, seen by its shading: drifts, ripples, prints and ruts.

The ground's geometry has nodes every 0.4 m; what is finer shows in the texture as the light on its
slopes. A canvas holds heights of a few centimetres; `MicroRelief.shading` turns them into a tone,
the light of a slope over that of level ground. Feet, skis, runners and wheels leave tracks in it.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np
from numba import njit

from touchdown.scenes.api import Array, Bytes, Float32
from touchdown.scenes.authoring.ground import TEXELS, Canvas, Ground
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.authoring.plane import SQUARE, rotated, unit, unit_circle
from touchdown.scenes.authoring.relief import HALF_M, HeightField

NEUTRAL = 128
"""Tone of level ground."""
_FLAT = 128
_TERRAIN_FRACTION = 0.7
_STEP_M = 0.001
"""Height of one grey level of `MicroRelief.prints`."""
_SINE = np.sin(2.0 * np.pi * np.arange(4096) / 4096).astype(np.float32)


@dataclass(frozen=True, kw_only=True, slots=True)
class Ripples:
    """Wind ripples: crests across the wind, in two trains whose beats make them end and fork."""

    wave_m: float
    height_m: float
    """from trough to crest"""
    wind_angle: float
    """radians, the way the wind blows"""
    cover: Float32
    """(n, n) 0..1 of the full height over the square of the ground, row 0 at y_min"""


@dataclass(kw_only=True, slots=True)
class MicroRelief:
    """Fine heights over the square of +-half_m, row 0 at y_min."""

    half_m: float = HALF_M
    drifts_m: Float32 = field(default_factory=lambda: np.zeros((TEXELS // 2,) * 2, np.float32))
    """at half the canvas' resolution"""
    prints: Bytes = field(default_factory=lambda: np.full((TEXELS, TEXELS), _FLAT, np.uint8))
    """millimetres above 128"""
    base_slopes: Float32 = field(default_factory=lambda: np.zeros((2, 2, 2), np.float32))
    """(n, n, 2) rise to the east and to the north at nodes over the same square"""

    def stand_on(self, terrain: HeightField) -> None:
        """Adds a fraction of the terrain's own slopes. MuJoCo's light saturates on level ground: it
        shades what is turned from the sun, and does not brighten what is turned to it."""
        heights = cv2.GaussianBlur(terrain.heights_m, (3, 3), 0.6)
        rise_y, rise_x = np.gradient(heights, terrain.cell_m)
        slopes = _TERRAIN_FRACTION * np.stack([rise_x, rise_y], axis=-1)
        self.base_slopes = slopes.astype(np.float32)

    @property
    def canvas(self) -> Canvas:
        """A canvas whose material are the prints: its shapes draw hollows and rims."""
        return Canvas(half_m=self.half_m, material=self.prints, paint=self.prints[:0, :0],
                      stain=self.prints[:0, :0])  # fmt: skip

    def press(self, outline_m: Array, depth_m: float) -> None:
        """Presses a polygon, (N, 2) world metres, into the ground; negative depths raise it."""
        level = int(np.clip(round(_FLAT - depth_m / _STEP_M), 0, 255))
        cv2.fillPoly(self.prints, [self.canvas.texels(outline_m)], level, cv2.LINE_AA, 4)

    def groove(self, line_m: Array, width_m: float, depth_m: float) -> None:
        """Draws a rut along a polyline, with the rim that it pushes up on both sides."""
        canvas = self.canvas
        points = [canvas.texels(line_m)]
        for wide, level in ((1.7, -0.3 * depth_m), (1.0, depth_m)):
            tone = int(np.clip(round(_FLAT - level / _STEP_M), 0, 255))
            width = max(1, round(wide * width_m / canvas.texel_m))
            cv2.polylines(self.prints, points, False, tone, width, cv2.LINE_AA, 4)

    def shading(
        self, rng: np.random.Generator, sun: Array, ripples: Ripples | None = None
    ) -> Bytes:
        """Returns the tone of every texel, (rows, cols) uint8, `NEUTRAL` where the ground is
        level. sun: (3,) unit, the direction in which light travels; a fraction of the light, the
        sky's, is the same for every slope."""
        size = len(self.prints)
        texel = 2.0 * self.half_m / size
        prints = np.asarray(cv2.GaussianBlur(self.prints, (5, 5), 1.0), np.uint8)
        tone = np.empty((size, size), np.uint8)
        bend = np.stack([fractal_noise(rng, (1024, 1024), 30.0, 3, 0.4) for _ in range(2)], -1)
        if ripples is None:
            ripples = Ripples(wave_m=1.0, height_m=0.0, wind_angle=0.0,
                              cover=np.zeros((4, 4), np.float32))  # fmt: skip
        cover = np.asarray(
            cv2.resize(ripples.cover, (1024, 1024), interpolation=cv2.INTER_LINEAR), np.float32
        )
        wind = unit(ripples.wind_angle)
        _shade_slopes(tone, self.drifts_m, self.base_slopes, prints, bend, cover, _SINE, wind, -sun,
                      texel, ripples.wave_m, ripples.height_m)  # fmt: skip
        return tone


@njit(cache=True, error_model="numpy")
def _shade_slopes(
    tone: Bytes,
    drifts: Float32,
    base: Float32,
    prints: Bytes,
    bend: Float32,
    cover: Float32,
    sine: Float32,
    wind: Array,
    to_sun: Array,
    texel_m: float,
    wave_m: float,
    height_m: float,
) -> None:
    """Lambert's law on the slopes; the sun gives half of the light on level ground."""
    size = tone.shape[0]
    half = drifts.shape[0]
    to_bend = (bend.shape[0] - 1.001) / size
    to_base = (base.shape[0] - 1.001) / size
    # Texels of either raster are compared with their neighbours.
    print_gain = 0.001 / (2.0 * texel_m)
    drift_gain = 1.0 / (4.0 * texel_m)
    ripple_gain = np.pi * height_m / wave_m
    to_cycle = sine.shape[0] / wave_m
    mask = sine.shape[0] - 1
    # The second train is turned by 7 degrees and 6 % shorter.
    east, north = 0.9925 * wind[0] - 0.1219 * wind[1], 0.1219 * wind[0] + 0.9925 * wind[1]
    sx, sy = to_sun[0] / to_sun[2], to_sun[1] / to_sun[2]
    for row in range(size):
        up, down = min(row + 1, size - 1), max(row - 1, 0)
        drift_row = min(row >> 1, half - 1)
        drift_up, drift_down = min(drift_row + 1, half - 1), max(drift_row - 1, 0)
        y = row * texel_m
        bend_row = row * to_bend
        i = int(bend_row)
        v = bend_row - i
        base_row = row * to_base
        k = int(base_row)
        base_v = base_row - k
        for col in range(size):
            right, left = min(col + 1, size - 1), max(col - 1, 0)
            drift_col = min(col >> 1, half - 1)
            drift_right, drift_left = min(drift_col + 1, half - 1), max(drift_col - 1, 0)
            gx = print_gain * (float(prints[row, right]) - float(prints[row, left]))
            gy = print_gain * (float(prints[up, col]) - float(prints[down, col]))
            base_col = col * to_base
            m = int(base_col)
            base_u = base_col - m
            a = (1.0 - base_u) * (1.0 - base_v)
            b, c, d = base_u * (1.0 - base_v), (1.0 - base_u) * base_v, base_u * base_v
            gx += a * base[k, m, 0] + b * base[k, m + 1, 0]
            gx += c * base[k + 1, m, 0] + d * base[k + 1, m + 1, 0]
            gy += a * base[k, m, 1] + b * base[k, m + 1, 1]
            gy += c * base[k + 1, m, 1] + d * base[k + 1, m + 1, 1]
            gx += drift_gain * (drifts[drift_row, drift_right] - drifts[drift_row, drift_left])
            gy += drift_gain * (drifts[drift_up, drift_col] - drifts[drift_down, drift_col])
            if height_m > 0.0:
                bend_col = col * to_bend
                j = int(bend_col)
                u = bend_col - j
                full = cover[i, j]
                if full > 0.02:
                    a = (1.0 - u) * (1.0 - v)
                    b, c, d = u * (1.0 - v), (1.0 - u) * v, u * v
                    warp = a * bend[i, j, 0] + b * bend[i, j + 1, 0]
                    warp += c * bend[i + 1, j, 0] + d * bend[i + 1, j + 1, 0]
                    slow = a * bend[i, j, 1] + b * bend[i, j + 1, 1]
                    slow += c * bend[i + 1, j, 1] + d * bend[i + 1, j + 1, 1]
                    x = col * texel_m
                    first = wind[0] * x + wind[1] * y + 0.20 * warp
                    second = 1.06 * (east * x + north * y) + 0.20 * warp + 0.08 * slow
                    p, q = int(first * to_cycle) & mask, int(second * to_cycle) & mask
                    # Steeper on the lee side: the second harmonic sharpens the fall.
                    wave = 0.62 * sine[p] + 0.5 * sine[q] + 0.22 * sine[(2 * p + 600) & mask]
                    wave *= full * (0.75 + 0.25 * min(max(slow, -1.0), 1.0)) * ripple_gain
                    gx += wave * wind[0]
                    gy += wave * wind[1]
            facing = 1.0 - (gx * sx + gy * sy)
            facing = max(facing, 0.0) / np.sqrt(1.0 + gx * gx + gy * gy)
            # A camera's curve is flatter in the highlights.
            facing = facing if facing < 1.0 else 1.0 + 0.5 * (facing - 1.0)
            value = 128.0 * (0.5 + 0.5 * facing) + 0.5
            tone[row, col] = int(min(max(value, 20.0), 255.0))


OVAL = unit_circle(14)


def placed(at: Array, heading: float, local: Array) -> Array:
    """(N, 2) local points turned by ``heading`` and moved to ``at`` (2,)."""
    return at + rotated(local, heading)


def wander(rng: np.random.Generator, ends_m: Array, sway_m: float) -> Array:
    """(N, 2) a smooth way from one end to the other, (2, 2), a point every 0.1 m or so."""
    span = ends_m[1] - ends_m[0]
    fraction = np.linspace(0.0, 1.0, max(8, int(np.hypot(*span) / 0.1)))
    return sidled(rng, ends_m[0] + fraction[:, None] * span, sway_m)


def sidled(rng: np.random.Generator, line_m: Array, sway_m: float) -> Array:
    """A line (N, 2) that sways to both sides of another and shares its ends."""
    span = line_m[-1] - line_m[0]
    side = np.array([-span[1], span[0]]) / np.hypot(*span)
    fraction = np.linspace(0.0, 1.0, len(line_m))
    off = np.zeros(len(fraction))
    for order in range(1, 5):
        off += rng.normal(0.0, sway_m / order) * np.sin(order * np.pi * fraction)
    return line_m + off[:, None] * side


def footprints(
    rng: np.random.Generator,
    canvas: Canvas,
    fine: MicroRelief,
    line_m: Array,
    material: Ground | None,
) -> None:
    """Presses a walker's prints along a line, left and right in turn, 0.7 m a step; their ground is
    ``material``, or stays what it is."""
    steps = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line_m, axis=0), axis=1))])
    left = 1.0
    for at in np.arange(0.3, steps[-1] - 0.3, 0.68):
        at += rng.normal(0.0, 0.04)
        where = np.array([np.interp(at, steps, line_m[:, k]) for k in (0, 1)])
        ahead = np.array([np.interp(at + 0.3, steps, line_m[:, k]) for k in (0, 1)])
        heading = float(np.arctan2(*(ahead - where)[::-1])) - 0.10 * left + rng.normal(0.0, 0.05)
        foot = placed(where, heading, np.array([0.0, 0.13 * left]))
        depth = rng.uniform(0.06, 0.10)
        fine.press(placed(foot, heading, OVAL * [0.20, 0.10]), -0.012)
        fine.press(placed(foot, heading, OVAL * [0.165, 0.058]), depth)
        # The foot drags snow out of its print.
        fine.press(placed(foot, heading, np.array([0.24, 0.0]) + OVAL * [0.07, 0.03]), 0.02)
        if material is not None:
            canvas.fill(placed(foot, heading, OVAL * [0.15, 0.055]), material)
        left = -left


def parallel(line_m: Array, off_m: float) -> Array:
    """The line moved to its left."""
    way = np.gradient(line_m, axis=0)
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
    return line_m + off_m * np.stack([-way[:, 1], way[:, 0]], axis=-1)


@dataclass(frozen=True, kw_only=True, slots=True)
class Gauge:
    """A pair of skis, runners or wheels, in metres."""

    apart_m: float
    width_m: float
    depth_m: float


SKIS = Gauge(apart_m=0.22, width_m=0.085, depth_m=0.03)
SLEDGE = Gauge(apart_m=0.42, width_m=0.07, depth_m=0.035)
WHEELS = Gauge(apart_m=1.55, width_m=0.27, depth_m=0.07)


def runners(
    canvas: Canvas, fine: MicroRelief, line_m: Array, gauge: Gauge, material: Ground
) -> None:
    """Draws a pair of grooves."""
    for side in (-0.5, 0.5):
        groove = parallel(line_m, side * gauge.apart_m)
        fine.groove(groove, gauge.width_m, gauge.depth_m)
        canvas.track(groove, gauge.width_m, material)


def vehicle_track(
    rng: np.random.Generator, canvas: Canvas, fine: MicroRelief, line_m: Array, material: Ground
) -> None:
    """The ruts of a vehicle with lugged tyres."""
    runners(canvas, fine, line_m, WHEELS, material)
    for side in (-0.5, 0.5):
        rut = parallel(line_m, side * WHEELS.apart_m)
        way = np.gradient(rut, axis=0)
        for index in range(0, len(rut), 2):
            heading = float(np.arctan2(way[index, 1], way[index, 0]))
            lug = placed(rut[index], heading + 0.5 * side, SQUARE * [0.028, 0.11])
            fine.press(lug, WHEELS.depth_m + rng.uniform(0.005, 0.02))
