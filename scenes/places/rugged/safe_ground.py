"""Safe ground as a dial: lumps where too much of the ground is safe, and cleared pads where too
little is. Safe is what the geometric rule of the truth maps says of the nodes."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from touchdown.scenes.api import Array
from touchdown.scenes.authoring.noise import fractal_noise
from touchdown.scenes.authoring.relief import HALF_M, HeightField, smoothstep
from touchdown.scenes.places.rugged.relief import CELL_M, NODES
from touchdown.scenes.truth.maps import (
    CLEAR_RADIUS_M,
    MAX_SLOPE_DEG,
    PAD_RADIUS_M,
    fitted_slope_deg,
    geometric_rule,
)

_TILT = float(np.tan(np.deg2rad(0.55 * MAX_SLOPE_DEG)))
"""Steepest pad, well below the rule's limit"""
_LUMP_WAVE_M = 1.2
_BENIGN_M = 0.6
"""of the ground beside a pad that is level enough for part of a footprint"""
_BLEND_M = 2.4
"""from a pad to the ground around it"""
_ROOM_M = 0.7
"""between a pad's edge and the nearest thing"""
_START_M = 2.9
"""radius of the level pad at the take-off spot"""
_PADS, _PACKED = 140, 0.08
"""number of pads that is aimed at, and the safe fraction from which on they are fewer and larger,
since wide margins would leave no room"""
_GAP_M = 1.3
"""between the edges of two pads"""
_BEST_OF = 5
"""places of which the most level one becomes a pad"""
_LEFT = ((0.6, 0.09), (0.4, 0.12), (0.2, 0.16), (0.1, 0.2))
"""of the wanted fraction, what a round of lumps should leave safe; their standard deviation in
metres"""
_PARTS = (0.35, 0.8, 1.0, 1.0, 1.0)
"""of what is missing that a round of pads should add: what a pad adds is learned from the last
one"""
_EDGE_M = 3.0


def rule_map(heights: Array) -> NDArray[np.bool_]:
    """(n, n) True at the nodes that are safe to touch down on by the geometric rule."""
    slope = fitted_slope_deg(heights, CELL_M)
    return geometric_rule(heights, slope, np.zeros(heights.shape, bool), CELL_M)


@dataclass(kw_only=True, slots=True)
class Pad:
    """An ellipse of even ground."""

    xy_m: Array
    axes_m: Array
    """(2, 2): its half axes as rows"""

    @property
    def reach_m(self) -> float:
        """Its longer half axis."""
        return float(np.linalg.norm(self.axes_m, axis=1).max())

    def distance(self, xy_m: Array) -> Array:
        """(..., 2) -> (...) metres beyond its edge, negative inside, about."""
        half = np.linalg.norm(self.axes_m, axis=1)
        local = (np.asarray(xy_m) - self.xy_m) @ (self.axes_m / half[:, None] ** 2).T
        return np.asarray((np.linalg.norm(local, axis=-1) - 1.0) * half.min(), np.float64)


@dataclass(kw_only=True, slots=True)
class SafeGround:
    """The ground as it is made safe."""

    rng: np.random.Generator
    heights: Array
    """(NODES, NODES) metres without what lies on them"""
    things: Array
    """(NODES, NODES) metres that things rise over them"""
    pads: list[Pad] = field(default_factory=list)
    _beyond: Array = field(default_factory=lambda: np.full((NODES, NODES), _BLEND_M))
    """(NODES, NODES) metres to the nearest pad, up to the width of a blend"""

    def reach(self, fraction: float, takeoff_xy_m: Array) -> float:
        """Changes the ground until ``fraction`` of it is safe, and returns the fraction that is.
        There is a level pad at the take-off spot."""
        self._lay(Pad(xy_m=takeoff_xy_m, axes_m=_START_M * np.eye(2)), tilt=0.0)
        safe = self._safe()
        for part, high_m in _LEFT:
            if safe.mean() < 0.75 * fraction:
                break
            self._roughen(safe, part * fraction, high_m)
            safe = self._safe()
        yields = 1.0
        for part in _PARTS:
            missing = fraction - float(safe.mean())
            if missing < 0.04 * fraction:
                break
            before = float(safe.mean())
            expected = self._add_pads(part * missing / yields, fraction)
            safe = self._safe()
            yields = float(np.clip((safe.mean() - before) / max(expected, 1e-9), 0.2, 5.0))
        return float(safe.mean())

    def clear(self, xy_m: Array, radius_m: Array) -> NDArray[np.bool_]:
        """(N,) True for discs that lie on no pad."""
        free = np.ones(len(xy_m), bool)
        for pad in self.pads:
            near = np.abs(xy_m - pad.xy_m).max(axis=1) < pad.reach_m + radius_m + 2.0
            free[near] &= pad.distance(xy_m[near]) > radius_m[near] + _ROOM_M
        return free

    def _safe(self) -> NDArray[np.bool_]:
        return rule_map(self.heights + self.things)

    def _roughen(self, safe: NDArray[np.bool_], fraction: float, high_m: float) -> None:
        """Raises lumps of a step's height on patches until ``fraction`` stays safe."""
        shape = (NODES, NODES)
        patches = fractal_noise(self.rng, shape, 11.0 / CELL_M, 3, 0.5).astype(np.float64)
        low, high = 0.0, 1.0
        for _ in range(7):
            part = 0.5 * (low + high)
            rough = patches < np.quantile(patches[::8, ::8], part)
            away = ndimage.distance_transform_edt(~rough[::2, ::2]) * 2.0 * CELL_M
            left = float((safe[::2, ::2] & (away > CLEAR_RADIUS_M)).mean())
            low, high = (part, high) if left > fraction else (low, part)
        level = np.quantile(patches[::8, ::8], high)
        lumps = fractal_noise(self.rng, shape, _LUMP_WAVE_M / CELL_M, 2, 0.5).astype(np.float64)
        start = self.pads[0].distance(_nodes(np.s_[:], np.s_[:]))
        strength = smoothstep(level + 0.12, level - 0.12, patches) * smoothstep(0.2, 2.0, start)
        self.heights += high_m * strength * lumps

    def _add_pads(self, missing: float, fraction: float) -> float:
        """Lays pads that should add ``missing`` to the safe fraction; returns what they should
        add."""
        area = (2.0 * HALF_M) ** 2
        count = _PADS * min(1.0, (_PACKED / fraction) ** 1.3)
        room = max(np.sqrt(fraction * area / (np.pi * count)), 0.45)
        slopes = ndimage.gaussian_filter(self.heights, 1.5 / CELL_M)
        east, north = (HeightField(heights_m=g) for g in np.gradient(slopes, CELL_M)[::-1])
        added, tries = 0.0, 0
        while added < missing * area and tries < 8000:
            tries += _BEST_OF
            spots = self.rng.uniform(-HALF_M + _EDGE_M, HALF_M - _EDGE_M, (_BEST_OF, 2))
            rises = np.stack([east.at(spots), north.at(spots)], axis=-1)
            best = int(np.linalg.norm(rises, axis=1).argmin())
            rise, half = rises[best], room * self.rng.uniform(0.75, 1.35)
            steep = float(np.linalg.norm(rise))
            # Benches along the slope: long where it is steep.
            long = min(1.0 + 4.0 * steep, 2.2)
            along = np.array([-rise[1], rise[0]]) / max(steep, 1e-9)
            half_axes = PAD_RADIUS_M + 0.12 + half * np.array([np.sqrt(long), 1.0 / np.sqrt(long)])
            axes = half_axes[:, None] * np.stack([along, [along[1], -along[0]]])
            pad = Pad(xy_m=spots[best], axes_m=axes)
            if self._apart(pad):
                self._lay(pad)
                added += np.pi * (half + _BENIGN_M) ** 2
        return added / area

    def _apart(self, pad: Pad) -> bool:
        others = np.array([other.xy_m for other in self.pads])
        reaches = np.array([other.reach_m for other in self.pads])
        room = np.linalg.norm(others - pad.xy_m, axis=1) - reaches
        return bool((room > pad.reach_m + _GAP_M).all())

    def _lay(self, pad: Pad, tilt: float = _TILT) -> None:
        """Levels the ground of a pad to a plane, at most as steep as ``tilt``, and clears it."""
        reach = pad.reach_m + _BLEND_M
        low = np.floor((pad.xy_m - reach + HALF_M) / CELL_M).astype(int)
        high = np.ceil((pad.xy_m + reach + HALF_M) / CELL_M).astype(int) + 1
        cols, rows = (slice(max(a, 0), min(b, NODES)) for a, b in zip(low, high, strict=True))
        xy, ground = _nodes(rows, cols), self.heights[rows, cols]
        away = pad.distance(xy)
        inside = away <= 0.0
        off = np.column_stack([xy[inside] - pad.xy_m, np.ones(inside.sum())])
        plane = np.linalg.lstsq(off, ground[inside], rcond=None)[0]
        plane[:2] *= min(1.0, tilt / max(float(np.hypot(*plane[:2])), 1e-9))
        level = (xy - pad.xy_m) @ plane[:2] + plane[2]
        beyond = self._beyond[rows, cols]
        ground += (level - ground) * smoothstep(_BLEND_M, 0.05, away) * smoothstep(0.0, 1.0, beyond)
        np.minimum(beyond, away, out=beyond)
        self.things[rows, cols] *= away > _ROOM_M
        self.pads.append(pad)


def _nodes(rows: slice, cols: slice) -> Array:
    axis = np.linspace(-HALF_M, HALF_M, NODES)
    return np.stack(np.meshgrid(axis[cols], axis[rows]), axis=-1)
