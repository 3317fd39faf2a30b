"""A scanning LIDAR on a moving vehicle: pulses, returns, noise and intensity.

Every pulse is cast from the pose of its own instant. A link budget through the manufacturer's range
limits decides if it returns; water reflects like a rough mirror; a beam that an edge splits returns
several echoes.
"""

from collections.abc import Mapping
from statistics import NormalDist
from zlib import crc32

import numpy as np

from touchdown.scenes.api import Scene
from touchdown.sim.api import LidarParams, LidarScan
from touchdown.sim.dust import DustCloud
from touchdown.sim.effects import Effects, Returns
from touchdown.sim.faults.disturbances import Weather
from touchdown.sim.frames import Pose
from touchdown.sim.geometry.ray_target import Hits
from touchdown.sim.lidar import beam_edges, beams, returns
from touchdown.sim.lidar.patterns import PATTERNS, RisleyPattern, ScanPattern
from touchdown.sim.lidar.range_errors import RangeErrors
from touchdown.sim.lidar.raycast_scene import LidarScene, OpticalTable
from touchdown.sim.lidar.rays import Movers, Rays, Track
from touchdown.sim.lidar.surface_detail import SurfaceDetail
from touchdown.sim.lidar.sway import Sway
from touchdown.sim.lidar.weather import Clutter, LidarWeather
from touchdown.sim.moving import BodyTrack
from touchdown.sim.typing import Array, Bytes, Float32, Indices, Int32

_MAX_PASSES = 5
"""Porous surfaces that one pulse may cross (each crown counts twice: in and out)."""
_ON_AXIS: Array = np.zeros((1, 3))
_CALM: Array = np.zeros(2)
_NO_GAIN: Float32 = np.empty(0, dtype=np.float32)
_CONE_MARGIN_RAD = 0.02
"""Margin around the outermost pulse of the first second, for later pulses, pointing errors, beam
width."""
_FWHM_PER_SIGMA = 2.3548200450309493
_ACROSS = (4, 0, 5, 3, 1, 6, 2)
"""Quantile of a beam's part across its long axis; the index is the one along it."""


class LidarSensor:
    """Simulates the LIDAR that ``params.preset`` names in ``scene``.

    ``scan`` is a pure function of its arguments, the scene and the seed: it may run in any thread
    beside the physics, one scan at a time. Without ``weather`` the air is clear; ``wind_mps``, (2,)
    the mean wind at 20 ft, moves crowns. ``dust`` is noted up to a scan's end before the scan.
    ``optics``: of ``scene``, where they are known. ``number``: 1 for a second LIDAR beside another.
    Raises ValueError for impossible parameters.
    """

    def __init__(
        self,
        scene: Scene,
        params: LidarParams,
        seed: int,
        weather: Weather | None = None,
        wind_mps: Array = _CALM,
        dust: DustCloud | None = None,
        optics: OpticalTable | None = None,
        number: int = 0,
    ) -> None:
        if number:
            seed = int(np.random.default_rng([seed, number]).integers(2**32))
        self._pattern = PATTERNS[params.preset]
        self._fired = fired_directions(params, seed)
        self._params = params
        self._scene = LidarScene(scene, optics)
        key = np.random.default_rng([seed, crc32(b"lidar")]).integers(2**64, dtype=np.uint64)
        self._key = np.uint64(key)
        self._parts = beam_parts(self._pattern)
        outermost = self._pattern.directions(0, self._pattern.point_rate_hz)[:, 2].min()
        self._cone_rad = float(np.arccos(outermost)) + _CONE_MARGIN_RAD
        self._max_range = min(params.max_range_m, self._pattern.max_range_m)
        self._budget = returns.LinkBudget.of(
            self._pattern.range_limits_m, self._pattern.range_reflectivities, self._max_range
        )
        self._detail = SurfaceDetail.of(
            params, self._pattern, scene, self._scene.optics, self._scene.on_mover
        )
        self._sway = Sway.of(params, self._scene, wind_mps, seed)
        self._range_errors = RangeErrors.of(params, self._pattern, seed)
        self._weather, self._dust = None, dust
        self._rays, self._hits = Rays.of(0), Hits.none(0)
        self.effects = Effects()
        """of rain, fog, dust and a moved mount on scans"""
        if dust is not None or (weather is not None and weather.ever):
            self._weather = LidarWeather(weather, self._pattern, params, self._budget)

    @property
    def scene(self) -> LidarScene:
        """The scene that rays are cast against."""
        return self._scene

    def scan(
        self,
        start_tick: int,
        end_tick: int,
        tick_hz: int,
        body: BodyTrack,
        body_from_lidar: Pose,
        moving: Mapping[str, BodyTrack],
    ) -> LidarScan:
        """All pulses fired in (start_tick, end_tick].

        ``body``: the vehicle's track, which covers the scan (a pose per tick, both ends included).
        ``moving``: tracks by body name, of one instant or over the scan; a body left out stays at
        its rest pose.

        Raises ValueError when the track does not cover the scan or a name is not a moving body's.
        """
        rate = self._pattern.point_rate_hz
        first = start_tick * rate // tick_hz + 1
        count = end_tick * rate // tick_hz + 1 - first
        start_s = start_tick / tick_hz
        self._check_track(body.times_s, start_s, end_tick / tick_hz)
        nominal = self._pattern.directions(first, count)
        fired = nominal if self._fired is None else self._fired(first, count)
        track = Track.of(body).mounted(body_from_lidar)
        self._reserve(count)
        pulses = self._rays.part(0, count)
        self._aim(first, fired, np.arange(count), _ON_AXIS, track, pulses)
        movers = self._in_view(track, self._movers(body.times_s, moving))
        air = self._air(end_tick)
        ranges, intensity = self._measure(first, fired, track, movers, air)
        return LidarScan(
            start_tick=start_tick,
            end_tick=end_tick,
            start_time_s=start_s,
            end_time_s=end_tick / tick_hz,
            directions=_frozen(nominal),
            ranges=_frozen(ranges),
            time_offsets=_frozen((pulses.times - start_s).astype(np.float32)),
            intensity=_frozen(intensity),
        )

    def _air(self, tick: int) -> list[Clutter]:
        """What is in the air at ``tick``: nothing, rain or fog, dust."""
        if self._weather is None:
            return []
        found: list[Clutter | None] = [self._weather.at(tick)]
        if self._dust is not None and (dust := self._dust.at(tick)).extinction > 0.0:
            found.append(self._weather.dust(dust.extinction, dust.depth_m))
        return [clutter for clutter in found if clutter is not None]

    # ---------------------------------------------------------------------------- beams

    def _reserve(self, pulses: int) -> None:
        """Has memory for so many pulses and all parts of their beams."""
        needed = pulses * (1 + len(self._parts))
        if len(self._rays.rays) < needed:
            self._rays, self._hits = Rays.of(needed), Hits.of(needed)

    def _aim(
        self,
        first: int,
        nominal: Float32,
        chosen: Indices,
        offsets: Array,
        track: Track,
        rays: Rays,
    ) -> None:
        """Fills ``rays``: those of the ``chosen`` pulses (K,) at the first of the ``offsets``
        (S, 3) from the axis, then those at the second."""
        beams.aim(
            first, self._pattern.point_rate_hz, chosen, offsets, nominal, self._key,
            self._budget.quantiles, np.deg2rad(self._params.angle_sigma_deg), track, rays,
        )  # fmt: skip

    def _movers(self, times_s: Array, moving: Mapping[str, BodyTrack]) -> Movers:
        unknown = sorted(set(moving) - set(self._scene.moving))
        if unknown:
            raise ValueError(
                f"'{unknown[0]}' is not a moving body of the scene: name one of "
                f"{', '.join(sorted(self._scene.moving)) or 'none (the scene is static)'}"
            )
        movers = []
        for name, target in self._scene.moving.items():
            motion = moving.get(name)
            if motion is None:
                motion = BodyTrack.at_rest(self._scene.rest_poses[name], times_s[:1])
            movers.append((target, Track.of(motion)))
        return movers

    def _in_view(self, track: Track, movers: Movers) -> Movers:
        """The moving bodies that may come into the field of view during a scan."""
        return [
            (target, motion)
            for target, motion in movers
            if beams.in_view(track, motion, target.center, target.radius, self._cone_rad)
        ]

    # ----------------------------------------------------------------------------- hits

    def _cast(
        self, rays: Rays, hits: Hits, movers: Movers, *, open_ground: bool = False
    ) -> Indices:
        """Fills ``hits`` (N,) with the nearest over the static scene and every moving body. Returns
        the indices (with repeats) of the rays that came near more than open ground, which is looked
        for on request."""
        static = self._scene.static
        if static is None:
            hits.clear()
            near = np.arange(len(rays.rays))
        else:
            near = (static.cast_apart if open_ground else static.fill)(rays.rays, hits)
        if not movers:
            return near
        rows, travelled = np.arange(len(rays.rays)), np.zeros(len(rays.rays), np.float32)
        met = _cast_at_movers(rays.rays, rays.times, rows, travelled, hits, movers)
        return np.concatenate([near, *met])

    def _penetrate(self, pulses: Rays, hits: Hits, movers: Movers) -> None:
        """Replaces hits on porous surfaces by what lies behind, where the pulse passes."""
        porosity, static = self._scene.optics.porosity, self._scene.static
        if not porosity.any():
            return
        rows, travelled = np.arange(len(pulses.rays)), np.empty(len(pulses.rays), np.float32)
        onward = np.empty((len(rows), 6), np.float32)
        for left in range(_MAX_PASSES, -1, -1):
            count = returns.pass_on(rows, pulses, hits, porosity, onward, travelled)
            if not count or not left:
                return
            rows, travelled, onward = rows[:count], travelled[:count], onward[:count]
            if static is not None:
                static.cast_on(onward, rows, travelled, hits)
            if movers:
                _cast_at_movers(onward, pulses.times[rows], rows, travelled, hits, movers)

    # -------------------------------------------------------------------------- returns

    def _measure(
        self, first: int, nominal: Float32, track: Track, movers: Movers, air: list[Clutter]
    ) -> tuple[Float32, Bytes]:
        """Ranges and intensities of all pulses."""
        count = len(nominal)
        hits = self._hits.part(0, count)
        others = self._cast(self._rays.part(0, count), hits, movers, open_ground=True)
        split = np.empty(0, dtype=np.int64)
        if self._params.divergence:
            split = self._split(first, nominal, others, track, movers)
        rays = count + len(split) * len(self._parts)
        pulses, hits = self._rays.part(0, rays), self._hits.part(0, rays)
        self._penetrate(pulses, hits, movers)
        cells = self._scene.optics.cells(pulses.rays, hits)
        gain = self._refine(pulses, hits, cells, movers)
        strengths, ranges, intensity = self._receive(pulses, hits, cells, gain)
        weakened = []
        for clutter in air:
            seen = Returns(ranges[:count], intensity[:count])
            clear = seen.copy()
            clutter.weaken(hits.distance, pulses.bits, strengths, ranges, intensity)
            weakened.append(seen.changed_fraction(clear))
        ranges, intensity = ranges[:count], intensity[:count]
        if split.size:
            returns.receive_split(
                split, pulses, hits.distance, strengths, self._params.pulse_length_m,
                self._params.return_mode == "strongest", self._budget,
                self._params.range_sigma_m, self._params.min_range_m, ranges, intensity,
            )  # fmt: skip
        if self._range_errors is not None:
            changed = self._range_errors.apply(pulses.range_noise, hits.cosine, ranges, intensity)
            self.effects.note_lengths("ranging", count, *changed)
        for clutter, lost in zip(air, weakened, strict=True):
            seen = Returns(ranges, intensity)
            clear = seen.copy()
            clutter.scatter(pulses.bits[:count], ranges, intensity)
            self.effects.note(clutter.effects, min(lost + seen.changed_fraction(clear), 1.0))
        return ranges, intensity

    def _refine(self, pulses: Rays, hits: Hits, cells: Int32, movers: Movers) -> Float32:
        """Moves ``hits`` by the sway of crowns and into plants; factors (N,) of the reflectivities
        there, or empty."""
        count = max(len(pulses.rays), 1)
        if self._sway is not None:
            self.effects.note_lengths("sway", count, *self._sway.move(pulses, hits))
        if self._detail is None:
            return _NO_GAIN
        places = self._detail.find(pulses, hits, cells)
        gain = self._detail.gains(places, pulses, hits, movers)
        if self._detail.vegetation > 0.0:
            changed = self._detail.enter_plants(places, pulses, hits)
            self.effects.note_lengths("vegetation", count, *changed)
        return gain

    def _split(
        self, first: int, nominal: Float32, others: Indices, track: Track, movers: Movers
    ) -> Indices:
        """The pulses that an edge divides; the parts of their beams off the axis, with first hits,
        follow all axes, one part of all after another. Open ground divides no pulse. Where
        neighbours show a possible edge, two probes at the ends of a beam decide if its other parts
        are cast."""
        count, parts = len(nominal), self._parts
        rays, hits = self._rays, self._hits
        near = np.zeros(count, dtype=np.bool_)
        near[others] = True
        others = beam_edges.near_edges(nominal, hits.distance, hits.cosine, np.flatnonzero(near))
        angle_squared = float(np.sum(parts[0, :2] ** 2))
        ends = count + 2 * len(others)
        self._aim(first, nominal, others, parts[:2], track, rays.part(count, ends))
        self._cast(rays.part(count, ends), hits.part(count, ends), movers)
        kept = beam_edges.probed_apart(others, count, hits.distance, hits.cosine, angle_squared)
        split = others[kept]
        rows = count + np.concatenate([kept, len(others) + kept])
        start, end = count + len(rows), count + len(split) * len(parts)
        rays.move(rows, count)
        hits.move(rows, count)
        self._aim(first, nominal, split, parts[2:], track, rays.part(start, end))
        self._cast(rays.part(start, end), hits.part(start, end), movers)
        return split

    def _receive(
        self, pulses: Rays, hits: Hits, cells: Int32, gain: Float32
    ) -> tuple[Float32, Float32, Bytes]:
        """Strengths, ranges and intensities of rays as pulses of their own."""
        optics = self._scene.optics
        strengths, ranges = np.empty((2, len(cells)), dtype=np.float32)
        intensity = np.empty(len(cells), dtype=np.uint8)
        returns.receive(
            pulses, hits, cells, optics.reflectivity, optics.water,
            optics.ground_reflectivity.ravel(), gain, self._budget, self._params.range_sigma_m,
            self._params.min_range_m, self._max_range, strengths, ranges, intensity,
        )  # fmt: skip
        return strengths, ranges, intensity

    @staticmethod
    def _check_track(times_s: Array, start_s: float, end_s: float) -> None:
        if len(times_s) == 0 or times_s[0] > start_s + 1e-9 or times_s[-1] < end_s - 1e-9:
            raise ValueError(
                f"the body track must cover the scan from {start_s:.4f} s to {end_s:.4f} s: "
                "give a pose at every tick, both ends included"
            )


def fired_directions(params: LidarParams, seed: int) -> RisleyPattern | None:
    """The pattern that the pulses of a flight follow where it is not the nominal one. Raises
    ValueError for an error of the prisms of a sensor without prisms."""
    if params.prism_error_deg <= 0.0:
        return None
    nominal = PATTERNS[params.preset].directions
    if not isinstance(nominal, RisleyPattern):
        raise ValueError(f"lidar.prism_error_deg must be 0: '{params.preset}' has no prisms")
    azimuth = np.random.default_rng([seed, crc32(b"lidar prism")]).uniform(0.0, 2.0 * np.pi)
    return nominal.erring(np.deg2rad(params.prism_error_deg), azimuth)


def _cast_at_movers(
    rays: Float32, times: Array, rows: Indices, travelled: Float32, hits: Hits, movers: Movers
) -> list[Indices]:
    """`RayTarget.cast_on` of rays fired at ``times`` (K,), for every moving body that they come
    near, and the rows of these rays."""
    met = []
    for target, track in movers:
        chosen, local = beams.rays_near(rays, times, track, target.center, target.radius)
        if chosen.size:
            target.cast_on(local, rows[chosen], travelled[chosen], hits)
            met.append(rows[chosen])
    return met


def beam_parts(scan_pattern: ScanPattern) -> Array:
    """The parts of a beam off its axis, which together with the axis carry a seventh of the power
    each: (6, 3), radians along the LIDAR's x and y, and a number. The two ends come first.

    The data sheet's divergence is read as the full width at half maximum of a Gaussian profile;
    along either axis the parts lie at its quantiles."""
    count = len(_ACROSS)
    levels = np.array([NormalDist().inv_cdf((k + 0.5) / count) for k in range(count)])
    sigma_x, sigma_y = np.deg2rad(scan_pattern.divergence_deg) / _FWHM_PER_SIGMA
    offsets = np.column_stack([sigma_x * levels[list(_ACROSS)], sigma_y * levels])
    ends_first = [0, count - 1, *(k for k in range(1, count - 1) if k != count // 2)]
    return np.column_stack([offsets[ends_first], np.arange(1, count)])


def _frozen(array: np.ndarray) -> np.ndarray:
    array.setflags(write=False)
    return array
