"""Detail of surfaces that a scene's geometry and reflectivity leave out: texture and plants.

Texture: within a surface the reflectivity varies by a factor exp(s n - s^2 / 2), s the surface's
spread and n a sum of value noise over cells of 6 cm to 3.8 m, a function of the place alone (of
the place on the body, for what moves): the intensity image of a place is the same from everywhere.
A beam averages over its footprint, which weakens the detail that is finer than it.

Plants: a canopy of the height h over level ground, with a leaf area index L and leaves in all
directions, lets a ray through over the path p with the probability exp(-L p / (2 h)) (Beer and
Lambert; Ross, "The radiation regime and architecture of plant stands", 1981). A pulse returns from
where that falls below a random number, or else from the ground. h varies smoothly with the place.
On a slope that falls away along the ray, p is bounded by what it is over level ground, doubled: the
ray has come from over ground that lies higher.

Value noise: the nodes of a square or cubic lattice have hashed values, evenly distributed, and
between them a smoothstep interpolates; the sum is scaled to unit variance at every place. Its loops
have neither branches nor calls, so that the compiler makes vector instructions of them.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple
from zlib import crc32

import numpy as np
from numba import njit

from touchdown.scenes.api import Scene
from touchdown.sim.api import LidarParams
from touchdown.sim.geometry.ray_target import Hits
from touchdown.sim.lidar.beams import hashed
from touchdown.sim.lidar.patterns import PATTERNS, ScanPattern
from touchdown.sim.lidar.raycast_scene import OpticalTable, optical_table
from touchdown.sim.lidar.rays import Movers, Rays
from touchdown.sim.typing import Array, Bytes, Float32, Indices, Int32, Mask, Uint32

FINEST_M = 0.06
"""side of the smallest cells; those of the next octave are four times as large"""
FRACTIONS = (0.40, 0.35, 0.18, 0.07)
"""of the variance of the texture, from the finest octave to the coarsest"""
_WEIGHTS = np.sqrt(np.array(FRACTIONS, dtype=np.float32))
_EXIT_M = np.float32(0.01)
"""width of a beam where it leaves the LIDAR"""
_PLANT_CELLS_M = (0.7, 3.5)
_PLANT_SPREAD = 0.3
"""relative standard deviation of the height of plants from place to place, over cells of those
sides; heights stay within a half and one and a half of the mean"""
_MIN_COSINE = 0.05
_LEAF_SALT = 0x3C6EF372
_PLANT_SALT = 0x9E3779B9
_LEAF_PROJECTION = 0.5


class Found(NamedTuple):
    """Rays (K,), the places in the world of their hits, and two properties of these."""

    rows: Indices
    x: Float32
    y: Float32
    z: Float32
    one: Float32
    other: Float32


class Places(NamedTuple):
    """Hits with texture, on the ground's plane and in space: distance and spread; and hits among
    plants: mean height and leaf area index."""

    flat: Found
    solid: Found
    plants: Found


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
    moving: Mask
    """(G,) geoms that hang on a moving body"""

    @cached_property
    def _surfaces(self) -> Float32:
        """(M + G, 3) of materials and geoms: spread, mean height, leaf area index"""
        optics = self.optics
        materials = [optics.material_spread, optics.material_canopy_m, optics.material_leaf_area]
        geoms = [optics.spread, optics.canopy_m, optics.leaf_area]
        return np.concatenate([np.column_stack(materials), np.column_stack(geoms)])

    @staticmethod
    def of(
        params: LidarParams, scanner: ScanPattern, scene: Scene, optics: OpticalTable, moving: Mask
    ) -> "SurfaceDetail | None":
        """None where ``params`` ask for neither. The detail is a function of the scene's seed."""
        if params.texture <= 0.0 and params.vegetation <= 0.0:
            return None
        salt = np.random.default_rng(
            [scene.seed, crc32(b"lidar texture of " + scene.name.encode())]
        ).integers(2**32)
        width_x, width_y = np.deg2rad(scanner.divergence_deg).tolist()
        return SurfaceDetail(
            optics, params.texture, params.vegetation, np.uint32(salt), (width_x, width_y), moving
        )

    @staticmethod
    def plants_of(params: LidarParams, scene: Scene) -> "SurfaceDetail | None":
        """The plants that the LIDAR meets, for the other sensors; None without vegetation."""
        if params.vegetation <= 0.0:
            return None
        optics, moving = optical_table(scene.model, scene), np.zeros(scene.model.ngeom, np.bool_)
        return SurfaceDetail.of(params, PATTERNS[params.preset], scene, optics, moving)

    def find(self, pulses: Rays, hits: Hits, cells: Int32) -> Places:
        """What the rays meet: surfaces with texture, and plants. ``cells``: as from
        `OpticalTable.cells`."""
        optics, count = self.optics, len(pulses.rays)
        rows, tables = np.empty((3, count), np.int64), np.empty((3, 5, count), np.float32)
        flat, solid, plants = _find(
            pulses.rays, hits, cells, self._surfaces, optics.ground_geom, optics.ground_material,
            len(optics.material_spread), self.texture > 0.0, self.vegetation > 0.0, rows, tables,
        )  # fmt: skip
        found = enumerate((flat, solid, plants))
        return Places(
            *(Found(rows[k, :n], *(column[:n] for column in tables[k])) for k, n in found)
        )

    def gains(self, places: Places, pulses: Rays, hits: Hits, movers: Movers) -> Float32:
        """(N,) factors of the reflectivity where the rays hit; empty: 1 everywhere."""
        if self.texture <= 0.0:
            return np.empty(0, dtype=np.float32)
        self._place_on_movers(places.solid, pulses, hits.geom, movers)
        gain = np.zeros(len(pulses.rays), dtype=np.float32)
        for found, plane in ((places.flat, True), (places.solid, False)):
            _log_gains(*found, plane, self.salt, *self.width_rad, self.texture, gain)
        return np.exp(gain, out=gain)

    def _place_on_movers(self, found: Found, pulses: Rays, geom: Int32, movers: Movers) -> None:
        """Carries those places of ``found``, world frame, that lie on a moving body into its frame,
        at the instants of the rays."""
        if not movers or not self.moving[geom[found.rows]].any():
            return
        for target, track in movers:
            own = np.flatnonzero(np.isin(geom[found.rows], target.geoms))
            if not own.size:
                continue
            times = pulses.times[found.rows[own]]
            k = np.searchsorted(track.times_s, times).clip(0, len(track.times_s) - 1)
            center = np.column_stack(
                [np.interp(times, track.times_s, axis) for axis in track.positions.T]
            )
            places = found[1:4]
            offset = np.column_stack([axis[own] for axis in places]).astype(np.float64) - center
            moved = np.einsum("nji,nj->in", track.rotations[k], offset)
            for axis, values in zip(places, moved, strict=True):
                axis[own] = values

    def enter_plants(self, places: Places, pulses: Rays, hits: Hits) -> tuple[int, float]:
        """Shortens the distances of ``hits`` where a plant is in the way of the ground; the number
        of these, and the sum of the changes in metres."""
        rows, x, y, _, mean, leaf_area = places.plants
        if not len(rows):
            return 0, 0.0
        height = self.plant_height_m(x, y, mean)
        passed = -np.log(_even(rows, pulses.bits))  # by the law of Beer and Lambert
        return _shorten(rows, height, leaf_area, passed, pulses.rays, hits.cosine, hits.distance)

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
        factor, fraction = np.ones(len(x), np.float32), np.empty(len(x), np.float32)
        fraction[:] = _PLANT_SPREAD * math.sqrt(0.5)
        for octave, cell in enumerate(_PLANT_CELLS_M):
            add_plane_noise(x, y, cell, np.uint32((own + octave) % 2**32), fraction, factor)
        scale = np.float32(self.vegetation) * mean_m
        return scale * np.clip(factor, np.float32(0.5), np.float32(1.5))


@njit(cache=True, nogil=True, error_model="numpy")
def _find(
    rays: Float32,
    hits: Hits,
    cells: Int32,
    surfaces: Float32,
    ground_geom: int,
    ground_material: Bytes,
    materials: int,
    texture: bool,
    plants: bool,
    rows: Indices,
    tables: Float32,
) -> tuple[int, int, int]:
    """Fills the ``rows`` (3, N) and ``tables`` (3, 5, N) of `Places` from the front, and returns
    how many each has. ``surfaces`` (M + G, 3) of M ``materials`` and the geoms: spread, mean height
    and leaf area index. Most hits are kept: all are written, which saves branches."""
    distance, geom, cosine = hits
    kinds = ground_material.ravel()
    flat_x, flat_y, flat_d, flat_s = tables[0, 0], tables[0, 1], tables[0, 3], tables[0, 4]
    x_in, y_in, mean_in, leaves_in = tables[2, 0], tables[2, 1], tables[2, 3], tables[2, 4]
    flat_rows, plant_rows = rows[0], rows[2]
    flat, solid, grown = 0, 0, 0
    for i in range(rays.shape[0]):
        g, d = geom[i], distance[i]
        if g < 0:
            continue
        x, y = np.float32(rays[i, 0] + d * rays[i, 3]), np.float32(rays[i, 1] + d * rays[i, 4])
        own = kinds[cells[i]] if cells[i] >= 0 and kinds.size else materials + g
        spread, mean, leaves = surfaces[own, 0], surfaces[own, 1], surfaces[own, 2]
        flat_rows[flat], flat_x[flat], flat_y[flat] = i, x, y
        flat_d[flat], flat_s[flat] = d, spread
        varied = texture & (spread > 0.0)
        flat += varied & (g == ground_geom)
        if varied & (g != ground_geom):
            rows[1, solid], tables[1, 0, solid], tables[1, 1, solid] = i, x, y
            tables[1, 2, solid] = rays[i, 2] + d * rays[i, 5]
            tables[1, 3, solid], tables[1, 4, solid] = d, spread
            solid += 1
        plant_rows[grown], x_in[grown], y_in[grown] = i, x, y
        mean_in[grown], leaves_in[grown] = mean, leaves
        grown += plants & (cosine[i] > 0.0) & (mean > 0.0) & (leaves > 0.0)
    return flat, solid, grown


@njit(cache=True, nogil=True, error_model="numpy")
def _log_gains(
    rows: Indices,
    x: Float32,
    y: Float32,
    z: Float32,
    distance: Float32,
    spread: Float32,
    plane: bool,
    salt: np.uint32,
    width_x: float,
    width_y: float,
    texture: float,
    gain: Float32,
) -> None:
    """Logarithms of the gains of ``rows`` (K,): noise, on the plane or in space, averaged by a beam
    at its distance."""
    count = rows.shape[0]
    noise, left = np.zeros(count, np.float32), np.empty(count, np.float32)
    wide_x, wide_y = np.float32(width_x), np.float32(width_y)
    for octave in range(_WEIGHTS.shape[0]):
        side = FINEST_M * 4.0**octave
        cell, weight = np.float32(side), _WEIGHTS[octave]
        for k in range(count):
            area_x = cell + (_EXIT_M + wide_x * distance[k])
            left[k] = cell * weight / np.sqrt(area_x * (cell + (_EXIT_M + wide_y * distance[k])))
        own = np.uint32(salt + np.uint32(octave))
        if plane:
            add_plane_noise(x, y, side, own, left, noise)
        else:
            add_space_noise(x, y, z, side, own, left, noise)
    for k in range(count):
        size = np.float32(texture) * spread[k]
        gain[rows[k]] = size * (noise[k] - np.float32(0.5) * size)


@njit(cache=True, nogil=True, error_model="numpy")
def _even(rows: Indices, bits: Uint32) -> Array:
    """Numbers in (0, 1) of the rays ``rows`` (K,)."""
    out = np.empty(rows.shape[0])
    for k in range(rows.shape[0]):
        out[k] = (float(hashed(bits[rows[k]], _LEAF_SALT)) + 0.5) / 4294967296.0
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _shorten(
    rows: Indices,
    height: Float32,
    leaf_area: Float32,
    passed: Array,
    rays: Float32,
    cosine: Float32,
    distance: Float32,
) -> tuple[int, float]:
    """Ends the rays ``rows`` (K,) in plants at the optical depths ``passed`` (K,) unless the ground
    comes first. Returns how many it shortens, and by how many metres all of them."""
    shortened, total = 0, 0.0
    for k in range(rows.shape[0]):
        i = rows[k]
        slant = max(cosine[i], -0.5 * rays[i, 5], _MIN_COSINE)
        path = min(height[k] / slant, distance[i])
        depth = passed[k] * height[k] / (_LEAF_PROJECTION * leaf_area[k])
        before = distance[i]
        distance[i] = before - path + depth if depth < path else before
        shortened += distance[i] != before
        total += abs(distance[i] - before)
    return shortened, total


_X, _Y, _Z = np.uint32(0x8DA6B343), np.uint32(0xD8163841), np.uint32(0xCB1AB31F)
_SCALE = np.float32(math.sqrt(3.0) / 2147483648.0)
"""Makes a signed word of 32 even bits a number of unit variance"""
_ONE, _TWO, _THREE = np.float32(1.0), np.float32(2.0), np.float32(3.0)


@njit(cache=True, forceinline=True, error_model="numpy")
def _node(place: np.uint32, salt: np.uint32) -> np.float32:
    """Hashed value of a node (finaliser "lowbias32" of Wellons, 2018)."""
    h = np.uint32(place ^ salt)
    h = np.uint32(h ^ (h >> np.uint32(16)))
    h = np.uint32(h * np.uint32(0x7FEB352D))
    h = np.uint32(h ^ (h >> np.uint32(15)))
    h = np.uint32(h * np.uint32(0x846CA68B))
    return np.float32(np.int32(h)) * _SCALE


@njit(cache=True, nogil=True, fastmath=True, forceinline=True, error_model="numpy")
def add_plane_noise(
    x: Float32, y: Float32, cell_m: float, salt: np.uint32, amplitude: Float32, out: Float32
) -> None:
    """Adds ``amplitude`` (N,) times the noise at (N,) ``x``, ``y`` to ``out`` (N,)."""
    scale = np.float32(1.0 / cell_m)
    for n in range(x.shape[0]):
        px, py = x[n] * scale, y[n] * scale
        fx, fy = np.floor(px), np.floor(py)
        u, v = px - fx, py - fy
        u, v = u * u * (_THREE - _TWO * u), v * v * (_THREE - _TWO * v)
        i, j = np.uint32(np.uint32(np.int32(fx)) * _X), np.uint32(np.uint32(np.int32(fy)) * _Y)
        i2, j2 = np.uint32(i + _X), np.uint32(j + _Y)
        a, b = _node(np.uint32(i ^ j), salt), _node(np.uint32(i2 ^ j), salt)
        c, d = _node(np.uint32(i ^ j2), salt), _node(np.uint32(i2 ^ j2), salt)
        low, high = a + (b - a) * u, c + (d - c) * u
        power = (_ONE - _TWO * u * (_ONE - u)) * (_ONE - _TWO * v * (_ONE - v))
        out[n] += amplitude[n] * (low + (high - low) * v) / np.sqrt(power)


@njit(cache=True, nogil=True, fastmath=True, forceinline=True, error_model="numpy")
def add_space_noise(
    x: Float32,
    y: Float32,
    z: Float32,
    cell_m: float,
    salt: np.uint32,
    amplitude: Float32,
    out: Float32,
) -> None:
    """As `add_plane_noise`, at (N,) ``x``, ``y``, ``z``."""
    scale = np.float32(1.0 / cell_m)
    for n in range(x.shape[0]):
        px, py, pz = x[n] * scale, y[n] * scale, z[n] * scale
        fx, fy, fz = np.floor(px), np.floor(py), np.floor(pz)
        u, v, w = px - fx, py - fy, pz - fz
        u, v = u * u * (_THREE - _TWO * u), v * v * (_THREE - _TWO * v)
        w = w * w * (_THREE - _TWO * w)
        i, j = np.uint32(np.uint32(np.int32(fx)) * _X), np.uint32(np.uint32(np.int32(fy)) * _Y)
        k = np.uint32(np.uint32(np.int32(fz)) * _Z)
        i2, j2, k2 = np.uint32(i + _X), np.uint32(j + _Y), np.uint32(k + _Z)
        a, b = _node(np.uint32(i ^ j ^ k), salt), _node(np.uint32(i2 ^ j ^ k), salt)
        c, d = _node(np.uint32(i ^ j2 ^ k), salt), _node(np.uint32(i2 ^ j2 ^ k), salt)
        low, high = a + (b - a) * u, c + (d - c) * u
        bottom = low + (high - low) * v
        a, b = _node(np.uint32(i ^ j ^ k2), salt), _node(np.uint32(i2 ^ j ^ k2), salt)
        c, d = _node(np.uint32(i ^ j2 ^ k2), salt), _node(np.uint32(i2 ^ j2 ^ k2), salt)
        low, high = a + (b - a) * u, c + (d - c) * u
        top = low + (high - low) * v
        power = (_ONE - _TWO * u * (_ONE - u)) * (_ONE - _TWO * v * (_ONE - v))
        power *= _ONE - _TWO * w * (_ONE - w)
        out[n] += amplitude[n] * (bottom + (top - bottom) * w) / np.sqrt(power)
