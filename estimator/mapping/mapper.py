"""The mapper of every estimator: scans and images in, a coloured elevation map out.

Points are placed by the pose at their own time, coloured from the image nearest in time and
averaged per cell in the odom frame (the coloured point cloud map of Zou, Sun, Kong 2024, section
3.3, kept as a grid so that memory does not grow with the flight).
"""

import dataclasses
import itertools
import mmap
from collections import deque
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import (
    HEIGHT_BIN_M,
    HEIGHT_BINS,
    Estimate,
    GridMap,
    Mapper,
    MapperParams,
    MapView,
    PoseTrack,
)
from touchdown.estimator.filtering.deskew import Track, deskew, pose_on, track_of
from touchdown.estimator.filtering.error_state import Frame
from touchdown.estimator.filtering.synchronizer import max_delay_ticks
from touchdown.estimator.guard import InputGuard
from touchdown.estimator.mapping import kernels
from touchdown.estimator.mapping.kernels import Grid, Layers, Lens, Pulses
from touchdown.sim.api import CameraImage, LidarScan, Observation, SensorNeeds, SensorRig
from touchdown.sim.frames import Pose, PoseHistory
from touchdown.sim.typing import Array, Float32

_TRACK_LENGTH = 256
"""buffered poses: 1.28 s of control steps, more than a scan plus its delivery"""
_GROUND_BLOCK_M = 4.0
_CAMERA_HZ = 5
"""rate of images for the colour of cells, each of which a survey has in view for seconds"""
_IMAGES_KEPT = 3
_UNKNOWN_AT_FIRST = (
    "height_m", "height_std_m", "min_height_m", "max_height_m", "intensity", "histogram_base_m",
)  # fmt: skip
"""layers without a value where nothing was seen"""


def _blank(shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
    """Zeros that take memory where they are written: `numpy.zeros` may use memory again, and clears
    all of it."""
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    return np.frombuffer(mmap.mmap(-1, size), dtype).reshape(shape)


class _Grid:
    """Writable layers of one ``GridMap``, by the names of its fields, plus ``rgb_count``, the
    number of coloured returns; row = y, column = x."""

    def __init__(self, origin_xy_m: Array, cell_m: float, cells: int) -> None:
        self.cell_m = cell_m
        self.origin_xy_m = origin_xy_m
        shape = (cells, cells)
        self.layers: dict[str, NDArray[Any]] = {
            name: np.full(shape, np.nan, np.float32) for name in _UNKNOWN_AT_FIRST
        }
        for name in ("count", "rgb_count", "missing"):
            self.layers[name] = _blank(shape, np.float32)
        self.layers["rgb"] = np.full((*shape, 3), np.nan, np.float32)
        self.layers["histogram"] = _blank((*shape, HEIGHT_BINS), np.uint8)
        self.layers["last_seen_s"] = np.full(shape, -np.inf, np.float32)

    def view(self) -> GridMap:
        """Returns read-only views of the layers."""
        read_only: dict[str, NDArray[Any]] = {}
        for name, layer in self.layers.items():
            read_only[name] = layer.view()
            read_only[name].flags.writeable = False
        del read_only["rgb_count"]
        return GridMap(origin_xy_m=self.origin_xy_m.copy(), cell_m=self.cell_m, **read_only)

    def height_near(self, xy: Array) -> float:
        """Mean height of the known cells among the 3 x 3 around ``xy``; NaN if there are none."""
        col, row = np.floor((xy - self.origin_xy_m) / self.cell_m).astype(int)
        patch = self.layers["height_m"][
            max(row - 1, 0) : max(row + 2, 0), max(col - 1, 0) : max(col + 2, 0)
        ]
        known = patch[np.isfinite(patch)]
        return float(known.mean()) if known.size else float("nan")

    def moved_to(self, origin_xy_m: Array) -> "_Grid":
        """Returns a grid with its corner at ``origin_xy_m`` (a whole number of cells away) that
        keeps the common cells."""
        cells = self.layers["count"].shape[0]
        moved = _Grid(origin_xy_m, self.cell_m, cells)
        dc, dr = np.rint((origin_xy_m - self.origin_xy_m) / self.cell_m).astype(int)
        if abs(dc) >= cells or abs(dr) >= cells:
            return moved
        old = (slice(max(dr, 0), cells + min(dr, 0)), slice(max(dc, 0), cells + min(dc, 0)))
        new = (slice(max(-dr, 0), cells + min(-dr, 0)), slice(max(-dc, 0), cells + min(-dc, 0)))
        for name, layer in self.layers.items():
            moved.layers[name][new] = layer[old]
        return moved


@dataclass(frozen=True, slots=True)
class _PosedImage:
    image: CameraImage
    camera_from_odom: Pose


class _WaitingScan(NamedTuple):
    """A scan, the images known at its arrival and those that have come since."""

    scan: LidarScan
    images: list[_PosedImage]


class GridMapper:
    """Implements ``estimator.api.Mapper`` on two elevation grids: a coarse one around the take-off
    spot, and a fine one under the vehicle once it is low."""

    needs = SensorNeeds(camera_hz=_CAMERA_HZ, lidar=True)

    def __init__(self, rig: SensorRig, params: MapperParams) -> None:
        self._rig = rig
        self._params = params
        self._takeoff_ground = (
            float(rig.world_from_body_start.translation[2]) - rig.vehicle.leg_height_m
        )
        centre = rig.world_from_body_start.translation[:2]
        cells = round(params.extent_m / params.cell_m)
        corner = np.floor((centre - 0.5 * params.extent_m) / params.cell_m) * params.cell_m
        self._coarse = _Grid(corner, params.cell_m, cells)
        blocks = int(np.ceil(params.extent_m / _GROUND_BLOCK_M))
        self._ground_level = np.full((blocks, blocks), np.nan, np.float32)
        self._fine: _Grid | None = None
        self._fine_active = False
        self._history = PoseHistory(_TRACK_LENGTH)
        self._images: deque[_PosedImage] = deque(maxlen=_IMAGES_KEPT)
        self._waiting: deque[_WaitingScan] = deque()
        self._gives_tracks = False
        self._max_delay_ticks = max_delay_ticks(rig)
        camera = rig.camera
        k1, k2, p1, p2, k3 = np.asarray(camera.distortion, float).tolist()
        self._lens = Lens(
            camera.fx, camera.fy, camera.cx, camera.cy, k1, k2, p1, p2, k3,
            camera.lens == "fisheye",
        )  # fmt: skip
        self._guard = InputGuard(rig, inertial=False)
        self._view = MapView(version=0, coarse=self._coarse.view(), fine=None)

    def update(self, obs: Observation, estimate: Estimate) -> MapView:
        """Integrates the scans that are due and returns the map; without scans it costs nothing.

        An estimator may hold a scan back for an older image and give its track later: the scan
        waits for the track, or for the end of its patience. One whose estimator has given no track
        yet is integrated at its arrival."""
        obs = self._guard.screen(obs)
        self._history.add(estimate.time_s, estimate.odom_from_body)
        for image in obs.images:
            odom_from_body = self._pose_at(image.time_s, estimate)
            odom_from_camera = odom_from_body @ self._rig.body_from_camera
            posed = _PosedImage(image, odom_from_camera.inverse())
            self._images.append(posed)
            for waiting in self._waiting:
                waiting.images.append(posed)
        self._waiting.extend(_WaitingScan(scan, list(self._images)) for scan in obs.scans)
        self._gives_tracks |= estimate.scan_track is not None
        due = self._due(obs.tick, estimate)
        if due:
            self._place_fine_grid(estimate)
            for _ in range(due):
                self._integrate(self._waiting.popleft(), estimate)
            self._view = MapView(
                version=self._view.version + due,
                coarse=self._view.coarse,
                fine=self._fine.view() if self._fine is not None and self._fine_active else None,
            )
        return self._view

    def _due(self, tick: int, estimate: Estimate) -> int:
        """Number of waiting scans, from the oldest, to integrate now. Scans are used in order: one
        that is older than a scan with a track will get none."""
        if not self._gives_tracks:
            return len(self._waiting)
        due = 0
        for number, (scan, _) in enumerate(self._waiting, start=1):
            late = tick - scan.end_tick >= self._max_delay_ticks
            if late or self._own_track(scan.start_time_s, scan.end_time_s, estimate) is not None:
                due = number
        return due

    def _own_track(self, start_s: float, end_s: float, estimate: Estimate) -> PoseTrack | None:
        slack, track = 1.5 / self._rig.tick_hz, estimate.scan_track
        if track is None or track.times_s.size < 2:
            return None
        first, last = track.times_s[0], track.times_s[-1]
        return track if first <= start_s + slack and last >= end_s - slack else None

    def _track_spanning(self, start_s: float, end_s: float, estimate: Estimate) -> PoseTrack | None:
        """Returns the estimator's own track if it spans the interval, else the causal poses around
        it."""
        track = self._own_track(start_s, end_s, estimate)
        if track is not None:
            return track
        entries = self._history.around(start_s, end_s)
        return track_of(entries) if len(entries) > 1 else None

    def _pose_at(self, time_s: float, estimate: Estimate) -> Pose:
        track = self._own_track(time_s, time_s, estimate)
        pose = self._history.at(time_s) if track is None else pose_on(track, time_s)
        return estimate.odom_from_body if pose is None else pose

    def _place_fine_grid(self, estimate: Estimate) -> None:
        """Switches the fine grid on below ``fine_below_m`` and keeps it under the vehicle."""
        position = estimate.odom_from_body.translation
        if not np.isfinite(position).all():
            return
        ground = self._coarse.height_near(position[:2])
        if np.isnan(ground):
            ground = self._takeoff_ground
        params = self._params
        self._fine_active = position[2] - ground < params.fine_below_m
        if not self._fine_active:
            return
        cell, extent = params.fine_cell_m, params.fine_extent_m
        corner = np.round((position[:2] - 0.5 * extent) / cell) * cell
        if self._fine is None:
            self._fine = _Grid(corner, cell, round(extent / cell))
            return
        centre = self._fine.origin_xy_m + 0.5 * extent
        if np.max(np.abs(position[:2] - centre)) > params.fine_recentre_m:
            self._fine = self._fine.moved_to(corner)

    def _integrate(self, waiting: _WaitingScan, estimate: Estimate) -> None:
        scan, images = waiting
        track = self._track_spanning(scan.start_time_s, scan.end_time_s, estimate)
        if track is None:
            return
        origins, beams = deskew(
            scan.directions, scan.time_offsets, scan.start_time_s, Track.of(track),
            Frame.of(self._rig.body_from_lidar),
        )  # fmt: skip
        pulses = Pulses(origins, beams, scan.ranges)
        colours = self._colour(scan, images, pulses)
        spots = self._missing_spots(pulses)
        self._accumulate(self._coarse, scan, pulses, colours, spots)
        if self._fine is not None and self._fine_active:
            self._accumulate(self._fine, scan, pulses, colours, spots)

    def _colour(self, scan: LidarScan, images: list[_PosedImage], pulses: Pulses) -> Float32:
        """(N, 3) float32, from the image nearest in time, then from the others in reach."""
        colours = np.full((scan.ranges.shape[0], 3), np.nan, np.float32)
        duration = scan.end_time_s - scan.start_time_s
        earliest, latest = scan.start_time_s - duration - 1e-6, scan.end_time_s + duration + 1e-6
        near = [posed for posed in images if earliest <= posed.image.time_s <= latest]
        near.sort(key=lambda posed: posed.image.time_s)
        offsets = np.array([posed.image.time_s - scan.start_time_s for posed in near])
        count = scan.ranges.shape[0]
        middles = np.searchsorted(scan.time_offsets, 0.5 * (offsets[:-1] + offsets[1:])).tolist()
        nearest = list(itertools.pairwise([0, *middles, count]))
        first = [(own, (0, 0), posed) for own, posed in zip(nearest, near, strict=False)]
        then = [((0, count), own, posed) for own, _, posed in reversed(first)]
        for window, skipped, posed in first + (then if len(near) > 1 else []):
            kernels.sample_colours(
                pulses, window, skipped, posed.image.rgb, Frame.of(posed.camera_from_odom),
                self._lens, colours,
            )  # fmt: skip
        return colours

    def _missing_spots(self, pulses: Pulses) -> Float32:
        x, y = self._coarse.origin_xy_m.tolist()
        blocks = Grid(x, y, _GROUND_BLOCK_M)
        kernels.update_ground_level(pulses, blocks, self._ground_level)
        spots = np.empty((len(pulses.ranges), 2), np.float32)
        found = kernels.locate_missing(
            pulses, self._params.missing_min_reach_m, self._params.missing_max_reach_m,
            self._takeoff_ground, blocks, self._ground_level, spots,
        )  # fmt: skip
        return spots[:found]

    def _accumulate(
        self, grid: _Grid, scan: LidarScan, pulses: Pulses, colours: Float32,
        spots: Float32,
    ) -> None:  # fmt: skip
        x, y = grid.origin_xy_m.tolist()
        place = Grid(x, y, grid.cell_m)
        layers = Layers(grid.layers["count"], *(grid.layers[name] for name in Layers._fields[1:]))
        cap = self._params.count_cap
        kernels.accumulate_returns(
            pulses, colours, scan.intensity, scan.end_time_s, cap, self._params.extreme_memory_s,
            place, layers,
        )  # fmt: skip
        kernels.accumulate_heights(
            pulses, place, HEIGHT_BIN_M, grid.layers["histogram"], grid.layers["histogram_base_m"]
        )
        kernels.accumulate_missing(spots, place, cap, layers.counts, layers.missing)


class NoMap:
    """Implements ``estimator.api.Mapper``: returns the view of ``mapper`` before its first scan."""

    needs = SensorNeeds()

    def __init__(self, mapper: Mapper) -> None:
        self._mapper = mapper
        self._view: MapView | None = None

    def update(self, obs: Observation, estimate: Estimate) -> MapView:
        """Returns the same empty view every time."""
        if self._view is None:
            blind = dataclasses.replace(obs, scans=(), images=())
            self._view = self._mapper.update(blind, estimate)
        return self._view
