"""Detail of surfaces that a scene's geometry and reflectivity leave out: texture and plants.

Texture: within a surface the reflectivity varies by a factor exp(s n - s^2 / 2), s the surface's
spread and n a sum of value noise over cells of 6 cm to 3.8 m, a function of the place alone (of
the place on the body, for what moves): the intensity image of a place is the same from everywhere.
A beam averages over its footprint, which weakens the detail that is finer than it.

Plants: a canopy of the height h over level ground, with a leaf area index L and leaves in all
directions, lets a ray through over the path p with the probability exp(-L p / (2 h)) (Beer and
Lambert; Ross, "The radiation regime and architecture of plant stands", 1981). A pulse returns from
where that falls below a random number, or else from the ground. h varies smoothly with the place.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from zlib import crc32

import numpy as np
from numba import njit

from touchdown.scenes.api import Scene
from touchdown.sim.api import LidarParams
from touchdown.sim.geometry.ray_target import Hits
from touchdown.sim.lidar.beams import hashed
from touchdown.sim.lidar.lattice_noise import add_plane_noise, add_space_noise
from touchdown.sim.lidar.patterns.livox import PATTERNS, ScanPattern
from touchdown.sim.lidar.raycast_scene import OpticalTable, optical_table
from touchdown.sim.lidar.rays import Movers, Rays
from touchdown.sim.typing import Array, Bools, Bytes, Float32, Indices, Int32, Uint32

FINEST_M = 0.06
"""side of the smallest cells; those of the next octave are four times as large"""
SHARES = (0.40, 0.35, 0.18, 0.07)
"""of the variance of the texture, from the finest octave to the coarsest"""
_WEIGHTS = np.sqrt(np.array(SHARES, dtype=np.float32))
_EXIT_M = np.float32(0.01)
"""width of a beam where it leaves the LIDAR"""
_PLANT_CELLS_M = (0.7, 3.5)
_PLANT_SPREAD = 0.3
"""relative standard deviation of the height of plants from place to place, over cells of those
sides; heights stay within a half and one and a half of the mean"""
_LEAST_COSINE = 0.05
_LEAF_SALT = 0x3C6EF372
_PLANT_SALT = 0x9E3779B9
_LEAF_PROJECTION = 0.5


@dataclass(frozen=True)
class SurfaceDetail:
    """Texture and plants of one scene. ``texture`` and ``vegetation`` scale the spreads and the
    heights."""

    optics: OpticalTable
    texture: float
    vegetation: float
    salt: np.uint32
    width_rad: tuple[float, float]
    """full widths of the beam at half maximum"""
    moving: Bools
    """(G,) geoms that hang on a moving body"""

    @staticmethod
    def of(
        params: LidarParams, scanner: ScanPattern, scene: Scene, optics: OpticalTable, moving: Bools
    ) -> SurfaceDetail | None:
        """None where ``params`` ask for neither. The detail is a function of the scene's seed."""
        if params.texture <= 0.0 and params.vegetation <= 0.0:
            return None
        salt = np.random.default_rng([scene.seed, crc32(b"lidar texture")]).integers(2**32)
        width_x, width_y = np.deg2rad(scanner.divergence_deg).tolist()
        return SurfaceDetail(
            optics, params.texture, params.vegetation, np.uint32(salt), (width_x, width_y), moving
        )

    @staticmethod
    def plants_of(params: LidarParams, scene: Scene) -> SurfaceDetail | None:
        """The plants that the LIDAR meets, for the other sensors; None without vegetation."""
        if params.vegetation <= 0.0:
            return None
        optics, moving = optical_table(scene.model, scene), np.zeros(scene.model.ngeom, np.bool_)
        return SurfaceDetail.of(params, PATTERNS[params.preset], scene, optics, moving)

    def gains(self, pulses: Rays, hits: Hits, movers: Movers) -> Float32:
        """(N,) factors of the reflectivity where the rays hit; empty: 1 everywhere."""
        if self.texture <= 0.0:
            return np.empty(0, dtype=np.float32)
        optics, count = self.optics, len(pulses.rays)
        places = np.empty((3, count), dtype=np.float32)
        spread = np.empty(count, dtype=np.float32)
        _find_places(
            pulses.rays,
            hits.distance,
            hits.geom,
            optics.spread,
            optics.ground_geom,
            optics.ground_frame,
            optics.ground_material,
            optics.material_spread,
            places,
            spread,
        )
        gain = np.ones(count, dtype=np.float32)
        varied = spread > 0.0
        flat = varied & (hits.geom == optics.ground_geom)
        for rows, axes in ((np.flatnonzero(flat), 2), (np.flatnonzero(varied & ~flat), 3)):
            if not rows.size:
                continue
            there = np.take(places[:axes], rows, axis=1)
            if axes == 3:
                self._place_on_movers(pulses, hits.geom, movers, rows, there)
            noise = self._octaves(there, hits.distance[rows])
            size = np.float32(self.texture) * spread[rows]
            gain[rows] = np.exp(size * (noise - np.float32(0.5) * size))
        return gain

    def _octaves(self, places: Float32, distance: Float32) -> Float32:
        """Noise (K,) at ``places`` (2 or 3, K), contiguous, averaged by a beam at ``distance``
        (K,)."""
        widths = [_EXIT_M + np.float32(width) * distance for width in self.width_rad]
        noise = np.zeros(len(distance), dtype=np.float32)
        for octave, weight in enumerate(_WEIGHTS):
            cell = FINEST_M * 4.0**octave
            area = (np.float32(cell) + widths[0]) * (np.float32(cell) + widths[1])
            left = np.float32(cell) * weight / np.sqrt(area)
            salt = np.uint32((int(self.salt) + octave) % 2**32)
            if len(places) == 2:
                add_plane_noise(places[0], places[1], cell, salt, left, noise)
            else:
                add_space_noise(places[0], places[1], places[2], cell, salt, left, noise)
        return noise

    def _place_on_movers(
        self, pulses: Rays, geom: Int32, movers: Movers, rows: Indices, places: Float32
    ) -> None:
        """Carries those of ``places`` (3, K), world frame, that lie on a moving body into its
        frame, at the instants of the rays ``rows`` (K,)."""
        if not self.moving[geom[rows]].any():
            return
        for target, track in movers:
            own = np.flatnonzero(np.isin(geom[rows], target.geoms))
            if not own.size:
                continue
            times = pulses.times[rows[own]]
            k = np.searchsorted(track.times_s, times).clip(0, len(track.times_s) - 1)
            center = np.column_stack(
                [np.interp(times, track.times_s, axis) for axis in track.positions.T]
            )
            offset = places[:, own].T.astype(np.float64) - center
            places[:, own] = np.einsum("nji,nj->in", track.rotations[k], offset)

    def enter_plants(self, pulses: Rays, hits: Hits) -> None:
        """Shortens the distances of ``hits`` where a plant is in the way of the ground."""
        if self.vegetation <= 0.0:
            return
        optics, count = self.optics, len(pulses.rays)
        rows = np.empty(count, dtype=np.int64)
        table = np.empty((4, count), dtype=np.float32)
        found = _find_plants(
            pulses.rays,
            hits.distance,
            hits.geom,
            hits.cosine,
            optics.canopy_m,
            optics.leaf_area,
            optics.ground_geom,
            optics.ground_frame,
            optics.ground_material,
            optics.material_canopy_m,
            optics.material_leaf_area,
            rows,
            table,
        )
        if not found:
            return
        x, y, mean, leaf_area = np.ascontiguousarray(table[:, :found])
        height = self.plant_height_m(x, y, mean)
        _shorten(rows[:found], height, leaf_area, hits.cosine, pulses.bits, hits.distance)

    def visible_height_m(self, x: Array, y: Array, under_m: float = math.inf) -> Array:
        """Mean heights (N,) above the ground, at places (N,) in the world, from which pulses and
        light come back at the vertical: h - (1 - exp(-L / 2)) h / (L / 2), and 0 where no plants
        stand. ``under_m``: height of a sensor that may look from within them."""
        optics = self.optics
        if optics.ground_geom < 0:
            return np.zeros(len(x))
        mean = np.full(len(x), optics.canopy_m[optics.ground_geom])
        leaves = np.full(len(x), optics.leaf_area[optics.ground_geom])
        rows, cols = optics.ground_material.shape
        left, low, per_m = optics.ground_frame
        col, row = np.floor((x - left) * per_m).astype(int), np.floor((y - low) * per_m).astype(int)
        inside = (col >= 0) & (row >= 0) & (col < cols) & (row < rows)
        kind = optics.ground_material[row[inside], col[inside]]
        mean[inside] = optics.material_canopy_m[kind]
        leaves[inside] = optics.material_leaf_area[kind]
        east, north = (np.ascontiguousarray(axis, dtype=np.float32) for axis in (x, y))
        height = self.plant_height_m(east, north, mean).astype(np.float64)
        grown = (mean > 0.0) & (leaves > 0.0)
        free = np.where(grown, height, 1.0) / np.where(grown, _LEAF_PROJECTION * leaves, 1.0)
        top = np.minimum(height, under_m)
        return np.where(grown, top + free * np.expm1(-top / free), 0.0)

    def plant_height_m(self, x: Float32, y: Float32, mean_m: Float32) -> Float32:
        """Heights (N,) of plants of these mean heights (N,) at places (N,) in the world."""
        own = int(self.salt) ^ _PLANT_SALT
        factor, share = np.ones(len(x), np.float32), np.empty(len(x), np.float32)
        share[:] = _PLANT_SPREAD * math.sqrt(0.5)
        for octave, cell in enumerate(_PLANT_CELLS_M):
            add_plane_noise(x, y, cell, np.uint32((own + octave) % 2**32), share, factor)
        scale = np.float32(self.vegetation) * mean_m
        return scale * np.clip(factor, np.float32(0.5), np.float32(1.5))


@njit(cache=True, forceinline=True)
def _material(x: float, y: float, frame: Array, material: Bytes) -> int:
    """Index of the ground's material at a place, -1 beyond the raster."""
    col, row = math.floor((x - frame[0]) * frame[2]), math.floor((y - frame[1]) * frame[2])
    if 0 <= row < material.shape[0] and 0 <= col < material.shape[1]:
        return int(material[row, col])
    return -1


@njit(cache=True, nogil=True)
def _find_places(
    rays: Float32,
    distance: Float32,
    geom: Int32,
    spread: Float32,
    ground_geom: int,
    ground_frame: Array,
    ground_material: Bytes,
    material_spread: Float32,
    places: Float32,
    spreads: Float32,
) -> None:
    """Where the rays (N, 6) hit, ``places`` (3, N), and the ``spreads`` (N,) there; 0 where nothing
    is hit."""
    for i in range(rays.shape[0]):
        spreads[i] = 0.0
        g = geom[i]
        if g < 0:
            continue
        for axis in range(3):
            places[axis, i] = rays[i, axis] + distance[i] * rays[i, 3 + axis]
        spreads[i] = spread[g]
        if g == ground_geom:
            kind = _material(places[0, i], places[1, i], ground_frame, ground_material)
            if kind >= 0:
                spreads[i] = material_spread[kind]


@njit(cache=True, nogil=True)
def _find_plants(
    rays: Float32,
    distance: Float32,
    geom: Int32,
    cosine: Float32,
    canopy: Float32,
    leaf_area: Float32,
    ground_geom: int,
    ground_frame: Array,
    ground_material: Bytes,
    material_canopy: Float32,
    material_leaf_area: Float32,
    rows: Indices,
    table: Float32,
) -> int:
    """Rays that end where plants stand: their number K, ``rows`` (K, in front), and of each x, y,
    mean height and leaf area index, ``table`` (4, K in front)."""
    count = 0
    for i in range(rays.shape[0]):
        g = geom[i]
        if g < 0 or cosine[i] <= 0.0:
            continue
        mean, leaves = canopy[g], leaf_area[g]
        x = rays[i, 0] + distance[i] * rays[i, 3]
        y = rays[i, 1] + distance[i] * rays[i, 4]
        if g == ground_geom:
            kind = _material(x, y, ground_frame, ground_material)
            if kind >= 0:
                mean, leaves = material_canopy[kind], material_leaf_area[kind]
        if mean <= 0.0 or leaves <= 0.0:
            continue
        rows[count] = i
        table[0, count], table[1, count] = x, y
        table[2, count], table[3, count] = mean, leaves
        count += 1
    return count


@njit(cache=True, nogil=True)
def _shorten(
    rows: Indices,
    height: Float32,
    leaf_area: Float32,
    cosine: Float32,
    bits: Uint32,
    distance: Float32,
) -> None:
    """Draws the path of each of the rays ``rows`` (K,) in the plants by the law of Beer and
    Lambert, and ends it there unless the ground comes first."""
    for k in range(rows.shape[0]):
        i = rows[k]
        path = min(height[k] / max(cosine[i], _LEAST_COSINE), distance[i])
        bit = (float(hashed(bits[i], _LEAF_SALT)) + 0.5) / 4294967296.0
        depth = -math.log(bit) * height[k] / (_LEAF_PROJECTION * leaf_area[k])
        if depth < path:
            distance[i] = distance[i] - path + depth
