"""The true surface, and what LIDAR and rangefinder measure of it along the true path.

The returns of the log say which pulses come back; places and derivatives are the truth's. Returns
from crowns and from what moves are left out.

Ranges: a landmark is the surface in a voxel, an unknown plane. The noise of a return is that of the
data sheet, or the scatter of the returns in its voxel where that is larger: plants.

Intensities: a landmark is a cell of the ground, whose logarithm of the reflectivity is an unknown
value with unknown slopes. What is not linear within the cell counts as noise, and so does the
beam's own error of direction.
"""

import copy
import dataclasses
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.benchmarks.limit.information import (
    CONSTANTS,
    LANDMARK,
    MOUNT,
    RANGE,
    Indices,
    Rows,
)
from touchdown.experiments.config.schema import Config
from touchdown.experiments.flight.wiring import build_scene
from touchdown.experiments.io.tum import Trajectory
from touchdown.sim.airframe.vehicle import sensor_mounts
from touchdown.sim.api import LidarScan
from touchdown.sim.geometry.ray_target import Hits, RayTarget
from touchdown.sim.geometry.tessellation import FIRST_HIDDEN_GROUP
from touchdown.sim.lidar.patterns import PATTERNS
from touchdown.sim.lidar.range_errors import RangeErrors
from touchdown.sim.lidar.raycast_scene import LidarScene
from touchdown.sim.lidar.rays import Rays
from touchdown.sim.lidar.surface_detail import SurfaceDetail
from touchdown.sim.typing import Array

Bools = NDArray[np.bool_]

VOXEL_M, CELL_M = 0.5, 0.1
STRIDE = 8
"""pulses for one that is taken"""
PATCHES = 4000
"""landmarks without a feature that stand for all of them"""
CELL_FRACTION = 0.005
"""of the cells with intensities, which stand for all"""
OTHERS, CELLS = 10**6, 10**7
"""numbers of the first landmarks that are no features, and of the first cells"""
_MATCH_M = 0.3
_MIN_COSINE, _LEVEL_COSINE = 0.1, 0.7
_MIN = 5
_LEVELS = 150.0
"""intensity of a reflectivity of 1"""
_SPAN_S = 0.01
_SHIFT_M = 0.02
"""step of the differences of the reflectivity"""
_DARKEST = 1e-3


class Struck(NamedTuple):
    """What N rays meet."""

    distance: Array
    """(N,) m, inf for a miss"""
    normal: Array
    """(N, 3), towards the ray's origin"""
    hits: Hits


class TrueSurface:
    """The static scene of a flight. Moving bodies are left out; so are, in ``solid``, crowns and
    all else that lets pulses through."""

    def __init__(self, config: Config) -> None:
        scene = build_scene(config)
        everything = LidarScene(scene)
        self.mounts = sensor_mounts(scene.model)
        """true extrinsics"""
        self.optics = everything.optics
        model = copy.copy(scene.model)
        model.geom_group[self.optics.porosity > 0.0] = FIRST_HIDDEN_GROUP
        solid = LidarScene(dataclasses.replace(scene, model=model), self.optics)
        self.seen, self.solid = _target(everything), _target(solid)
        pattern = PATTERNS[config.lidar.preset]
        self._detail = SurfaceDetail.of(
            config.lidar, pattern, scene, self.optics, everything.on_mover
        )
        self._errors = RangeErrors.of(config.lidar, pattern, config.world_seed)

    def strike(self, target: RayTarget, origins: Array, directions: Array) -> Struck:
        """Casts rays (N, 3) and (N, 3) at `seen` or `solid`."""
        rays = _rays(origins, directions)
        hits = target.cast_all(rays)
        normal = target.embree(rays)["primitive_normals"].numpy().astype(np.float64)
        normal *= -np.sign(np.einsum("ni,ni->n", normal, directions))[:, None]
        return Struck(hits.distance.astype(np.float64), normal, hits)

    def reflectivity_gradient(
        self, origins: Array, directions: Array, hits: Hits
    ) -> tuple[Array, Array]:
        """Logarithm (N,) of the reflectivity, and its derivative (N, 2) in 1/m by a shift of the
        rays (N, 3), (N, 3) to the east and to the north."""
        middle = self._log_reflectivity(_rays(origins, directions), hits)
        slopes = np.empty((len(middle), 2))
        for axis in range(2):
            ends = []
            for sign in (1.0, -1.0):
                rays = _rays(origins + sign * _SHIFT_M * np.eye(3)[axis], directions)
                ends.append(self._log_reflectivity(rays, self.solid.cast_all(rays)))
            slopes[:, axis] = (ends[0] - ends[1]) / (2.0 * _SHIFT_M)
        return middle, slopes

    def _log_reflectivity(self, rays: NDArray[np.float32], hits: Hits) -> Array:
        optics, count = self.optics, len(rays)
        cells = optics.cells(rays, hits)
        ground = optics.ground_reflectivity.ravel()
        rho = optics.reflectivity[hits.geom].astype(np.float64)
        rho[cells >= 0] = ground[cells[cells >= 0]]
        found = np.log(np.maximum(rho, _DARKEST))
        if self._detail is not None:
            still = np.zeros(count)
            pulses = Rays(rays, still, still.astype(np.float32), np.zeros(count, np.uint32))
            gains = self._detail.gains(self._detail.find(pulses, hits, cells), pulses, hits, [])
            if len(gains):
                found += np.log(gains)
        return found

    def range_columns(self, distance: Array, strength: Array, cosine: Array) -> Array:
        """(N, 3) range errors by the constant, by time walk and by incidence of 1 m each."""
        if self._errors is None:
            return np.zeros((len(distance), 3))
        none = {"constant_m": 0.0, "walk_m": 0.0, "incidence_m": 0.0}
        units = [dataclasses.replace(self._errors, **(none | {name: 1.0})) for name in none]
        return np.column_stack([unit.bias_m(distance, strength, cosine) for unit in units])

    def range_sigma_m(self, distance: Array, strength: Array, usual_m: float) -> Array:
        """(N,) standard deviations of the range noise; ``usual_m`` without growth."""
        if self._errors is None:
            return np.full(len(distance), usual_m)
        with warnings.catch_warnings():  # numpy's, of arrays that are broadcast and only read
            warnings.simplefilter("ignore", DeprecationWarning)
            sigma = self._errors.noise_sigma_m(distance, strength)
        return np.asarray(sigma, dtype=np.float64)


def _target(scene: LidarScene) -> RayTarget:
    if scene.static is None:
        raise ValueError("the scene has no ground: nothing can be measured")
    return scene.static


def _rays(origins: Array, directions: Array) -> NDArray[np.float32]:
    return np.hstack([origins, directions]).astype(np.float32)


@dataclass(frozen=True, slots=True)
class Flight:
    """What is known of a logged flight."""

    config: Config
    surface: TrueSurface
    path: Trajectory
    period_s: float
    """between states"""

    def state_of(self, times_s: Array) -> Indices:
        """(N,) the nearest state."""
        return np.rint(times_s / self.period_s).astype(np.int64)


def rates_at(path: Trajectory, times_s: Array) -> Array:
    """(N, 6) velocity, m/s, and angular rate, rad/s, both in world axes."""
    steps = np.diff(path.times_s)[:, None]
    turns = (path.attitudes[1:] * path.attitudes[:-1].inv()).as_rotvec() / steps
    both = np.hstack([np.diff(path.positions, axis=0) / steps, turns])
    k = np.searchsorted(path.times_s, times_s, side="right") - 1
    return both[np.clip(k, 0, len(both) - 1)]


class Pulses(NamedTuple):
    """Returns of a log, world frame."""

    times_s: Array
    origin: Array
    """(N, 3) of the LIDAR"""
    direction: Array
    """(N, 3), nominal"""
    range_m: Array
    level: Array

    def chosen(self, which: Bools) -> "Pulses":
        """Those of ``which`` (N,)."""
        return Pulses._make(column[which] for column in self)


class Places(NamedTuple):
    """Returns, and where they come from."""

    pulses: Pulses
    struck: Struck
    points: Array
    """(N, 3) world"""
    cosine: Array


def collect(scans: Iterable[LidarScan], flight: Flight) -> tuple[Pulses, Pulses]:
    """Of the returns of a log: those of one pulse in `STRIDE`, and all that fall into a random
    fraction of the ground."""
    some, near = [], []
    mount = flight.surface.mounts.lidar
    for scan in scans:
        back = np.flatnonzero(scan.ranges > 0.0)
        times = scan.start_time_s + scan.time_offsets[back].astype(np.float64)
        position, _ = flight.path.at(times)
        # Attitudes hardly change within 10 ms, and one for every pulse would cost most of the time.
        parts = np.arange(scan.start_time_s, scan.end_time_s + _SPAN_S, _SPAN_S)
        _, rotations = flight.path.at(parts)
        own = rotations[np.rint((times - parts[0]) / _SPAN_S).astype(int)]
        beams = scan.directions[back].astype(np.float64) @ mount.rotation.T
        pulses = Pulses(
            times,
            position + own @ mount.translation,
            np.einsum("nij,nj->ni", own, beams),
            scan.ranges[back].astype(np.float64),
            scan.intensity[back].astype(np.float64),
        )
        some.append(pulses.chosen(back % STRIDE == 0))
        near.append(pulses.chosen(_drawn(pulses)))
    return _joined(some), _joined(near)


def _joined(parts: list[Pulses]) -> Pulses:
    return Pulses._make(np.concatenate(column) for column in zip(*parts, strict=True))


def _drawn(pulses: Pulses) -> Bools:
    """Returns in a random fraction of the ground's blocks of 5 x 5 cells."""
    points = pulses.origin[:, :2] + pulses.range_m[:, None] * pulses.direction[:, :2]
    block = np.floor(points / (5.0 * CELL_M)).astype(np.int64)
    mixed = (block[:, 0] * 73856093) ^ (block[:, 1] * 19349663)
    return (mixed * 2654435761 >> 8) % 2**20 < CELL_FRACTION * 2**20


def places(flight: Flight, pulses: Pulses) -> Places:
    """The returns that come from the static, solid surface."""
    surface = flight.surface
    struck = surface.strike(surface.solid, pulses.origin, pulses.direction)
    cosine = -np.einsum("ni,ni->n", struck.normal, pulses.direction)
    good = (np.abs(pulses.range_m - struck.distance) < _MATCH_M) & (cosine > _MIN_COSINE)
    good &= struck.hits.geom >= 0
    points = pulses.origin + struck.distance[:, None] * pulses.direction
    return _chosen(Places(pulses, struck, points, cosine), good)


def voxel_names(points: Array, normals: Array) -> Indices:
    """(N,) one number for the voxel of each point and the side that its surface faces."""
    axis = np.abs(normals).argmax(axis=1)
    faces = 2 * axis + (np.take_along_axis(normals, axis[:, None], 1)[:, 0] > 0.0)
    x, y, z = (np.floor(points / VOXEL_M).astype(np.int64) + 2**17).T
    return ((x * 2**18 + y) * 2**18 + z) * 8 + faces


class Patches(NamedTuple):
    """The voxels that returns fall into."""

    own: Indices
    """(N,) voxel of each return"""
    counts: Indices
    """(V,)"""
    center: Array
    """(V, 3) the feature, or the mean of the returns"""
    normal: Array
    """(V, 3)"""
    feature: Indices
    """(V,) its number, -1 for none"""

    @staticmethod
    def of(found: Places, features: Array, facing: Array) -> "Patches":
        """The voxels of the returns, some of them with one of the ``features`` (F, 3), which face
        (F, 3) ``facing``."""
        points, normals = found.points, found.struck.normal
        names, own, counts = np.unique(
            voxel_names(points, normals), return_inverse=True, return_counts=True
        )
        center, normal = (mean_of(own, counts, table) for table in (points, normals))
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        feature = np.full(len(names), -1)
        _, at, which = np.intersect1d(names, voxel_names(features, facing), return_indices=True)
        feature[at], center[at], normal[at] = which, features[which], facing[which]
        return Patches(own, counts, center, normal, feature)


def mean_of(own: Indices, counts: Indices, table: Array) -> Array:
    """(V, D) means of the rows of ``table`` (N, D) by ``own`` (N,)."""
    sums = [np.bincount(own, column, len(counts)) for column in table.T]
    return np.column_stack(sums) / counts[:, None]


def tangents(normals: Array) -> Array:
    """(N, 2, 3) two unit vectors across each of the unit normals (N, 3)."""
    minimum = np.eye(3)[np.abs(normals).argmin(axis=1)]
    first = np.cross(normals, minimum)
    first /= np.linalg.norm(first, axis=1)[:, None]
    return np.stack([first, np.cross(normals, first)], axis=1)


def range_rows(flight: Flight, pulses: Pulses, features: Array, facing: Array) -> Rows:
    """The ranges of the LIDAR. ``features`` (F, 3) with normals ``facing`` (F, 3) are landmarks 0
    to F - 1, one a voxel at most; of the other voxels a random share is taken, which stands for
    all."""
    found = places(flight, pulses)
    patches = Patches.of(found, features, facing)
    enough, known = patches.counts >= _MIN, patches.feature >= 0
    others = enough & ~known
    fraction = min(1.0, PATCHES / max(int(others.sum()), 1))
    drawn = others & (np.random.default_rng(0).random(len(others)) < fraction)
    use = ((enough & known) | drawn)[patches.own]
    weight = STRIDE / _variance(flight, found, patches)[use]
    found, patches = _chosen(found, use), patches._replace(own=patches.own[use])
    rows = _plane_rows(flight, found, patches, weight)
    rows.copies[:] = np.where(known, 1.0, 1.0 / fraction)[patches.own]
    rows.constant[:, RANGE] = -found.cosine[:, None] * flight.surface.range_columns(
        found.struck.distance, np.maximum(found.pulses.level, 1.0) / _LEVELS, found.cosine
    )
    return rows


def height_rows(flight: Flight, end_s: float, features: Array, facing: Array) -> Rows:
    """The readings of the rangefinder that fall near ``features``, as in `range_rows`."""
    sheet, config = flight.config.rangefinder, flight.config
    times = np.arange(0.0, end_s, sheet.period_ticks / config.sim.tick_hz)
    position, rotation = flight.path.at(times)
    origin = position + rotation @ np.array(sheet.position_body_m)
    down = -rotation[:, :, 2]
    distance = flight.surface.strike(flight.surface.solid, origin, down).distance
    pulses = Pulses(times, origin, down, distance, np.ones(len(times)))
    found = places(
        flight, pulses.chosen((distance > sheet.min_range_m) & (distance < sheet.max_range_m))
    )
    patches = Patches.of(found, features, facing)
    variance = (sheet.sigma_m**2 + sheet.resolution_m**2 / 12.0) * found.cosine**2
    rows = _plane_rows(flight, found, patches, 1.0 / variance)
    rows.constant[:, MOUNT] = 0.0
    return rows.chosen((patches.feature >= 0)[patches.own])


def _plane_rows(flight: Flight, found: Places, patches: Patches, weight: Array) -> Rows:
    """Rows along the normals of the patches that the returns fall into."""
    own, known = patches.own, patches.feature >= 0
    landmark = np.where(known, patches.feature, OTHERS + np.arange(len(known)))[own]
    rows = _rows(flight, found, patches.normal[own], landmark, weight)
    across = tangents(patches.normal)[own]
    rows.local[:, 2] = -1.0
    rows.local[:, 3:] = -np.einsum("nki,ni->nk", across, found.points - patches.center[own])
    return rows


def _variance(flight: Flight, found: Places, patches: Patches) -> Array:
    """(N,) m^2 along the surface's normal."""
    lidar, pulses = flight.config.lidar, found.pulses
    strength = np.maximum(pulses.level, 1.0) / _LEVELS
    along = flight.surface.range_sigma_m(pulses.range_m, strength, lidar.range_sigma_m)
    across = pulses.range_m * np.deg2rad(lidar.angle_sigma_deg)
    sheet = (found.cosine * along) ** 2 + (1.0 - found.cosine**2) * across**2
    off = (-found.cosine * (pulses.range_m - found.struck.distance))[:, None]
    left = off - mean_of(patches.own, patches.counts, off)[patches.own]
    scatter = np.bincount(patches.own, left[:, 0] ** 2) / np.maximum(patches.counts - 1, 1)
    return np.maximum(sheet, scatter[patches.own])


def _rows(
    flight: Flight, found: Places, directions: Array, landmark: Indices, weight: Array
) -> Rows:
    """Rows that measure the displacement of `found` along ``directions`` (N, 3), world, without
    their landmarks' part."""
    state, pulses = flight.state_of(found.pulses.times_s), found.pulses
    _, rotation = flight.path.at(flight.period_s * np.arange(state.max() + 1))
    body, _ = flight.path.at(pulses.times_s)
    arm = found.points - body
    beam = found.points - pulses.origin
    constant = np.zeros((len(state), CONSTANTS))
    own = rotation[state]
    turn = np.cross(beam, directions)
    constant[:, MOUNT] = np.hstack(
        [np.einsum("nji,nj->ni", own, turn), np.einsum("nji,nj->ni", own, directions)]
    )
    pose = np.hstack([directions, np.cross(arm, directions)])
    local, copies = np.zeros((len(state), LANDMARK)), np.ones(len(state))
    return Rows(state, landmark, pose, constant, local, weight, copies)


def intensity_rows(flight: Flight, pulses: Pulses) -> Rows:
    """The intensities of returns from level ground."""
    found = places(flight, pulses)
    level = (found.struck.normal[:, 2] > _LEVEL_COSINE) & (found.pulses.level > 0.0)
    found = _chosen(found, level)
    value, slope = flight.surface.reflectivity_gradient(
        found.pulses.origin, found.pulses.direction, found.struck.hits
    )
    cell = np.floor(found.points[:, :2] / CELL_M).astype(np.int64) + 2**20
    names = cell[:, 0] * 2**21 + cell[:, 1]
    _, own, counts = np.unique(names, return_inverse=True, return_counts=True)
    center = mean_of(own, counts, found.points)
    mean = mean_of(own, counts, np.column_stack([value, slope]))[own]
    offset = found.points[:, :2] - center[own, :2]
    left = value - mean[:, 0] - np.einsum("ni,ni->n", mean[:, 1:], offset)
    nonlinear = np.bincount(own, left**2) / np.maximum(counts - 1, 1)
    across = found.pulses.range_m * np.deg2rad(flight.config.lidar.angle_sigma_deg)
    variance = (
        1.0 / (12.0 * np.maximum(found.pulses.level, 1.0) ** 2)
        + nonlinear[own]
        + (mean[:, 1:] ** 2).sum(axis=1) * across**2
    )
    use = (counts >= _MIN)[own]
    # A shift of the ray moves the place along the surface, whatever its component along the ray.
    beam, normal = found.pulses.direction, found.struck.normal
    east = np.column_stack([mean[:, 1:], np.zeros(len(mean))])
    fraction = np.einsum("ni,ni->n", east, beam) / -found.cosine
    direction = east - fraction[:, None] * normal
    rows = _rows(flight, found, direction, CELLS + own, 1.0 / variance)
    rows.copies[:] = 1.0 / CELL_FRACTION
    rows.local[:, 0], rows.local[:, 1:3] = -1.0, -offset
    return rows.chosen(use)


def _chosen(found: Places, which: Bools) -> Places:
    hits = Hits._make(column[which] for column in found.struck.hits)
    struck = Struck(found.struck.distance[which], found.struck.normal[which], hits)
    return Places(found.pulses.chosen(which), struck, found.points[which], found.cosine[which])
