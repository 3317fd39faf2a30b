"""The Rerun recording of a flight: entity tree = frame tree, SI units, timeline ``sim_time``.

Cost and size are bounded: everything is thinned to the rates of ``config.log``, scalars, poses and
paths go in batches, static geometry is logged once, the map goes in tiles and only those that
changed.
"""

import contextlib
import errno
import os
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from touchdown.estimator.api import Estimate, GridMap, MapView, PoseTrack
from touchdown.estimator.filtering.deskew import deskewed_points, track_of
from touchdown.experiments.config.schema import Config
from touchdown.experiments.drawing.costmap_image import costmap_image, fitted
from touchdown.experiments.drawing.map_images import map_points
from touchdown.experiments.recording.recorder import StepRecord
from touchdown.experiments.recording.rerun_blueprint import TIMELINE, flight_blueprint, log_styles
from touchdown.experiments.recording.rerun_scene import log_moving, log_scene, log_vehicle
from touchdown.landing.api import Candidate, LanderView, WatchReport
from touchdown.landing.mission.waypoints import survey_waypoints
from touchdown.scenes.api import Scene
from touchdown.sim.api import Command, LidarScan, Observation, SensorRig, Truth
from touchdown.sim.frames import Pose, PoseHistory, quat_wxyz_from_matrix, tilt_from_rotation
from touchdown.sim.typing import Array

_POSE_HZ = 20.0
_SCALAR_HZ = 10.0
_PATH_HZ = 5.0
_FLUSH_S, _LIVE_FLUSH_S = 2.0, 0.5
_VIEWER_TIMEOUT_S = 10.0
"""for a viewer that does not take the rest of a flight"""
_MAP_POINT_M = 0.11
_HISTORY_POSES = 80
"""number of poses in 0.4 s at 200 Hz: a scan of 0.1 s and its delivery"""
_SPAN_M = 75.0
_RING_M, _POLE_M = 1.5, 12.0
_HEIGHT_SPAN_M = 12.0
_TURBO_BGR = np.asarray(cv2.applyColorMap(np.arange(256, dtype=np.uint8), cv2.COLORMAP_TURBO))
_TURBO_RGB: NDArray[np.uint8] = _TURBO_BGR.reshape(256, 3)[:, ::-1].astype(np.uint8)
_TILE_M = 16.0
_GROWTH = 1.5
"""A tile is recorded again once it holds this many times the returns it held before."""
_MIN_CELLS = 20
_RGB_ACCEPTED, _RGB_REFUSED, _RGB_CHOSEN = (120, 230, 255), (255, 90, 90), (90, 255, 90)


class Every:
    """Rate limit: ``due`` is true at most ``hz`` times a second of simulated time."""

    def __init__(self, hz: float) -> None:
        self._period_s = 1.0 / hz
        self._next_s = -np.inf

    def due(self, time_s: float) -> bool:
        if time_s < self._next_s - 1e-6:
            return False
        self._next_s = time_s + self._period_s
        return True


class Columns:
    """Rows of one kind by entity, each sent to Rerun in one call."""

    def __init__(self, columns: Callable[[list[Any]], rr.ComponentColumnList]) -> None:
        self._columns = columns
        self._rows: defaultdict[str, list[tuple[float, Any]]] = defaultdict(list)

    def add(self, time_s: float, values: dict[str, Any]) -> None:
        """Appends a row to each of the entities that ``values`` names."""
        for path, value in values.items():
            self._rows[path].append((time_s, value))

    def send(self, stream: rr.RecordingStream) -> None:
        """Sends all rows and forgets them."""
        for path, rows in self._rows.items():
            times = [time_s for time_s, _ in rows]
            columns = self._columns([value for _, value in rows])
            stream.send_columns(path, [rr.TimeColumn(TIMELINE, duration=times)], columns)
        self._rows.clear()


def _pose_columns(poses: list[Pose]) -> rr.ComponentColumnList:
    return rr.Transform3D.columns(
        translation=np.array([pose.translation for pose in poses]),
        quaternion=[quat_wxyz_from_matrix(pose.rotation)[[1, 2, 3, 0]] for pose in poses],
    )


_FOOTER, _FOOTER_BYTES = b"RRF2FOOT", 64
"""Marker at the end of a complete recording, and the length of the searched tail."""


class RerunLog:
    """A ``Recorder`` that writes one ``.rrd`` file with a blueprint in it, streams the same to a
    viewer, or both. ``close`` raises OSError if the file is incomplete; a viewer that goes away is
    no error."""

    def __init__(
        self,
        path: Path | None,
        scene: Scene,
        rig: SensorRig,
        config: Config,
        live: str | None = None,
    ) -> None:
        """``path``: of the file; ``live``: address of a viewer, such as
        ``rerun+http://127.0.0.1:9876/proxy``."""
        self._scene = scene
        self._rig = rig
        self._params = config.log
        self._stream = rr.RecordingStream(
            "touchdown", recording_id=f"{config.scene}-{config.estimator}-{config.seed}"
        )
        middle = scene.takeoff_xy_m + _survey_middle(scene, config)
        self._path = path
        sinks: list[rr.FileSink | rr.GrpcSink] = [] if path is None else [rr.FileSink(path)]
        sinks += [] if live is None else [rr.GrpcSink(live)]
        self._stream.set_sinks(*sinks, default_blueprint=flight_blueprint(middle, _SPAN_M))
        self._poses = Columns(_pose_columns)
        self._paths = Columns(lambda pieces: rr.LineStrips3D.columns(strips=pieces))
        self._path_ends: dict[str, Array] = {}
        self._scalars = Columns(lambda numbers: rr.Scalars.columns(scalars=numbers))
        self._tiles = MapTiles()
        self._history = PoseHistory(_HISTORY_POSES)
        self._pose_due, self._scalar_due = Every(_POSE_HZ), Every(_SCALAR_HZ)
        self._path_due = Every(_PATH_HZ)
        self._flush_due = Every(1.0 / (_FLUSH_S if live is None else _LIVE_FLUSH_S))
        self._scan_due = Every(self._params.scan_hz)
        self._camera_due = Every(self._params.camera_hz)
        self._map_due = Every(1.0 / self._params.map_period_s)
        self._faults = deque(sorted(_fault_times(config)))
        self._seen_text = ("", "")
        self._seen_site: Array = np.full(3, np.nan)
        self._seen_costmap: object = None
        self._seen_watch: object = None
        self._costmap_shape: tuple[int, int] | None = None
        self._seen_candidates: object = ()
        self._last: tuple[Truth, Estimate, MapView] | None = None
        self._log_static()

    def tick(self, step: StepRecord) -> None:
        truth, estimate, lander_view = step.truth, step.estimate, step.lander_view
        time_s = truth.time_s
        self._last = (truth, estimate, step.map_view)
        self._history.add(estimate.time_s, estimate.odom_from_body)
        if self._pose_due.due(time_s):
            self._poses.add(time_s, {"world/vehicle": truth.world_from_body})
        if self._path_due.due(time_s):
            self._add_paths(step)
        if self._scalar_due.due(time_s):
            self._add_scalars(truth, estimate, lander_view, step.command)
        self._log_sensors(step.obs, estimate)
        if self._map_due.due(time_s):
            self._log_map(time_s, estimate, step.map_view)
        self._log_decisions(time_s, estimate, lander_view)
        self._log_events(time_s, estimate)
        if self._flush_due.due(time_s):
            self._flush()

    def close(self) -> None:
        if self._last is not None:
            truth, estimate, map_view = self._last
            self._log_map(truth.time_s, estimate, map_view, everything=True)
        self._flush()
        with contextlib.suppress(RuntimeError):  # of a viewer that went away
            self._stream.flush(timeout_sec=_VIEWER_TIMEOUT_S)
        self._stream.disconnect()
        if self._path is None:
            return
        # The writer thread of Rerun does not report a full disk.
        with self._path.open("rb") as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - _FOOTER_BYTES))
            if _FOOTER not in file.read():
                raise OSError(errno.EIO, os.strerror(errno.EIO), str(self._path))

    # --------------------------------------------------------------------------------- static

    def _log_static(self) -> None:
        stream, rig = self._stream, self._rig
        stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        log_scene(stream, self._scene, self._params.texture_pixels)
        log_vehicle(stream, self._scene)
        for name, pose in (("camera", rig.body_from_camera), ("lidar", rig.body_from_lidar)):
            stream.log(f"world/vehicle/{name}", _transform(pose), static=True)
        camera = rig.camera
        stream.log(
            "world/vehicle/camera",
            rr.Pinhole(
                image_from_camera=camera.matrix(),
                resolution=[camera.width, camera.height],
                image_plane_distance=5.0,
                color=(255, 220, 120),
            ),
            static=True,
        )
        marker = rr.Points3D(
            [[0.0, 0.0, 0.0]], radii=rr.Radius.ui_points([5.0]), colors=[(255, 240, 120)]
        )
        stream.log("world/vehicle/marker", marker, static=True)
        log_styles(stream)

    # -------------------------------------------------------------------------------- channels

    def _log(self, time_s: float, path: str, entity: rr.AsComponents) -> None:
        self._stream.set_time(TIMELINE, duration=time_s)
        self._stream.log(path, entity)

    def _add_paths(self, step: StepRecord) -> None:
        """Adds short pieces, each at its own time; the blueprint shows all pieces up to now."""
        before = self._path_ends
        self._path_ends = {
            "world/path/true": step.truth.world_from_body.translation.copy(),
            "world/path/estimated": step.estimate.world_from_body.translation.copy(),
            "world/path/reference": step.lander_view.reference_world.copy(),
        }
        pieces = {path: np.stack([start, self._path_ends[path]]) for path, start in before.items()}
        self._paths.add(step.truth.time_s, pieces)

    def _add_scalars(
        self, truth: Truth, estimate: Estimate, lander_view: LanderView, command: Command
    ) -> None:
        position = truth.world_from_body.translation
        error = estimate.world_from_body.translation - position
        tracking = position - lander_view.reference_world
        rows = {f"plots/error/{axis}": error[i] for i, axis in enumerate("xyz")}
        rows |= {f"plots/tracking/{axis}": tracking[i] for i, axis in enumerate("xyz")}
        rows |= {
            "plots/motion/height_m": position[2],
            "plots/motion/speed_mps": np.linalg.norm(truth.velocity_world),
            "plots/motion/tilt_deg": np.degrees(tilt_from_rotation(truth.world_from_body.rotation)),
            "plots/motion/wind_mps": np.linalg.norm(truth.wind_world),
        }
        rows |= {f"plots/rotors/{i}": speed for i, speed in enumerate(command.rotor_speed_radps)}
        rows |= {
            f"plots/estimator/{name.replace('/', '_')}": value
            for name, value in estimate.diagnostics.items()
        }
        self._scalars.add(truth.time_s, {path: float(value) for path, value in rows.items()})

    def _log_sensors(self, obs: Observation, estimate: Estimate) -> None:
        for image in obs.images:
            if self._camera_due.due(image.time_s):
                quality = (cv2.IMWRITE_JPEG_QUALITY, self._params.jpeg_quality)
                path = "world/vehicle/camera/image"
                self._log_picture(image.time_s, path, "jpeg", image.rgb, *quality)
        for scan in obs.scans:
            if self._scan_due.due(scan.end_time_s):
                self._log_scan(scan, estimate)

    def _log_picture(
        self, time_s: float, path: str, kind: str, rgb: NDArray[np.uint8], *options: int
    ) -> None:
        """``kind``: ``jpeg`` or ``png``."""
        done, data = cv2.imencode(f".{kind}", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), options)
        if done:
            image = rr.EncodedImage(contents=data.tobytes(), media_type=f"image/{kind}")
            self._log(time_s, path, image)

    def _log_scan(self, scan: LidarScan, estimate: Estimate) -> None:
        track = estimate.scan_track
        if track is None or not (track.times_s[0] <= scan.start_time_s < track.times_s[-1]):
            # none, or one of an older scan
            passed = self._history.around(scan.start_time_s, scan.end_time_s)
            if len(passed) < 2:
                return
            track = track_of(passed)
        points = scan_points_odom(scan, track, self._rig.body_from_lidar, self._params.scan_points)
        pose = estimate.world_from_odom
        points = points @ pose.rotation.T + pose.translation
        self._log(
            scan.end_time_s,
            "world/scan",
            rr.Points3D(
                points.astype(np.float32), colors=height_colours(points[:, 2]), radii=[0.08]
            ),
        )

    def _log_map(
        self, time_s: float, estimate: Estimate, map_view: MapView, *, everything: bool = False
    ) -> None:
        self._stream.set_time(TIMELINE, duration=time_s)
        log_moving(self._stream, self._scene, time_s)
        self._stream.log("world/map", _transform(estimate.world_from_odom))
        grid = map_view.coarse
        for rows, cols in self._tiles.changed(grid, everything=everything):
            points, colours = map_points(grid, rows, cols)
            self._stream.log(
                f"world/map/tile_{rows.start}_{cols.start}",
                rr.Points3D(points, colors=colours, radii=[_MAP_POINT_M]),
            )

    def _log_decisions(self, time_s: float, estimate: Estimate, view: LanderView) -> None:
        text = (str(view.phase), view.note)
        if text != self._seen_text:
            self._seen_text = text
            level = "WARN" if view.no_site or view.aborted else "INFO"
            self._log(time_s, "log/phase", rr.TextLog(": ".join(filter(None, text)), level=level))
        if view.site_world is not None and not np.array_equal(view.site_world, self._seen_site):
            self._seen_site = view.site_world.copy()
            self._log(time_s, "world/site", _site_lines(view.site_world))
        if view.watch is not None and view.watch is not self._seen_watch:
            self._seen_watch = view.watch
            self._log(time_s, "world/map/watch", _watched_things(view.watch))
        if view.costmap is not None and view.costmap is not self._seen_costmap:
            self._seen_costmap = view.costmap
            site = view.site_world
            site_odom = None if site is None else estimate.world_from_odom.inverse().apply(site)
            picture = costmap_image(view, site_odom)
            self._costmap_shape = self._costmap_shape or picture.shape[:2]
            self._log_picture(time_s, "costmap/total", "png", fitted(picture, self._costmap_shape))
        if view.candidates and view.candidates is not self._seen_candidates:
            self._seen_candidates = view.candidates
            self._log(time_s, "world/map/candidates", _candidate_points(view.candidates))

    def _log_events(self, time_s: float, estimate: Estimate) -> None:
        """Logs the messages of the estimator and the injected faults."""
        for text in estimate.events:
            self._log(time_s, "log/estimator", rr.TextLog(text, level="WARN"))
        while self._faults and time_s >= self._faults[0][0]:
            start_s, text = self._faults.popleft()
            self._log(start_s, "log/faults", rr.TextLog(text, level="ERROR"))

    def _flush(self) -> None:
        for batch in (self._poses, self._paths, self._scalars):
            batch.send(self._stream)


def _fault_times(config: Config) -> list[tuple[float, str]]:
    """Returns (time, text) of the begin and end of each fault of the schedule."""
    found = []
    for fault in config.faults.schedule():
        found.append((fault.start_s, f"fault {fault.text} begins"))
        if fault.duration_s is not None:
            found.append((fault.start_s + fault.duration_s, f"fault {fault.text} ends"))
    return found


def _survey_middle(scene: Scene, config: Config) -> Array:
    """(2,) from the take-off point to the middle of the surveyed area, world axes."""
    ways = survey_waypoints(scene.takeoff_yaw, config.survey)[:, :2]
    return np.asarray(0.5 * (ways.min(axis=0) + ways.max(axis=0)))


def _transform(pose: Pose) -> rr.Transform3D:
    return rr.Transform3D(translation=pose.translation, mat3x3=pose.rotation)


def _site_lines(site_world: Array) -> rr.LineStrips3D:
    """Ring of the required clear radius, and a pole as a marker."""
    angle = np.linspace(0.0, 2.0 * np.pi, 37)
    ring = np.column_stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)])
    pole = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, _POLE_M]])
    return rr.LineStrips3D(
        [site_world + _RING_M * ring + np.array([0.0, 0.0, 0.2]), site_world + pole],
        colors=[_RGB_CHOSEN],
        radii=rr.Radius.ui_points([2.0, 0.8]),
    )


def _candidate_points(candidates: tuple[Candidate, ...]) -> rr.Points3D:
    lift = np.array([0.0, 0.0, 0.5])
    return rr.Points3D(
        np.array([candidate.position_odom + lift for candidate in candidates]),
        colors=[_RGB_ACCEPTED if c.accepted else _RGB_REFUSED for c in candidates],
        radii=[0.6],
        labels=[f"{n}: score {c.value:.3f}, {c.reason}" for n, c in enumerate(candidates, start=1)],
        show_labels=False,
    )


def _watched_things(report: WatchReport) -> rr.Points3D:
    """What the watch has found, with its words; what is in the way is red."""
    found = report.findings
    return rr.Points3D(
        np.array([finding.position_odom for finding in found]).reshape(-1, 3),
        colors=[_RGB_ACCEPTED if one.kind == "known" else _RGB_REFUSED for one in found],
        radii=[0.5 * one.width_m for one in found],
        labels=[f"{one.kind}, {one.height_m:.1f} m high" for one in found],
        show_labels=False,
    )


def scan_points_odom(
    scan: LidarScan, track: PoseTrack, body_from_lidar: Pose, max_points: int
) -> Array:
    """(N, 3) returns in the odom frame, about ``max_points`` at most, spread over the scan."""
    hits = np.flatnonzero(scan.ranges > 0.0)
    return deskewed_points(scan, hits[:: max(1, len(hits) // max_points)], track, body_from_lidar)


def height_colours(heights_m: Array) -> NDArray[np.uint8]:
    """(N, 3) RGB from blue at the ground to red at ``_HEIGHT_SPAN_M``."""
    level = np.clip((heights_m + 1.0) / _HEIGHT_SPAN_M, 0.0, 1.0)
    return _TURBO_RGB[(55 + 200 * level).astype(np.uint8)]


class MapTiles:
    """Number of returns and of coloured cells of each tile when it was last recorded."""

    def __init__(self) -> None:
        self._recorded: dict[tuple[int, int], tuple[float, int]] = {}

    def changed(self, grid: GridMap, *, everything: bool = False) -> Iterator[tuple[slice, slice]]:
        """Rows and columns of the tiles that have grown by `_GROWTH` since they were last returned;
        ``everything``: of all tiles that have grown."""
        side = max(1, round(_TILE_M / grid.cell_m))
        growth = 1.0 if everything else _GROWTH
        returns = _tile_sums(grid.count, side)
        coloured = _tile_sums(np.isfinite(grid.rgb[:, :, 0]) & (grid.count > 0), side)
        cells = _tile_sums(grid.count > 0, side)
        for row, col in np.argwhere(cells >= _MIN_CELLS):
            had_returns, had_coloured = self._recorded.get((row, col), (0.0, 0))
            now_returns, now_coloured = (float(returns[row, col]), int(coloured[row, col]))
            if now_returns > growth * had_returns or now_coloured > growth * had_coloured:
                self._recorded[(row, col)] = (now_returns, now_coloured)
                yield (slice(row * side, (row + 1) * side), slice(col * side, (col + 1) * side))


def _tile_sums(cells: NDArray[np.generic], side: int) -> NDArray[np.float64]:
    rows = np.arange(0, cells.shape[0], side)
    cols = np.arange(0, cells.shape[1], side)
    summed = np.add.reduceat(cells.astype(np.float32), rows, axis=0)
    return np.add.reduceat(summed, cols, axis=1, dtype=np.float64)
