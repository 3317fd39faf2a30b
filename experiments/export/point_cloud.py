"""Point clouds of a flight as PLY: its map, or all LIDAR returns in the colours of the camera."""

from collections import deque
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyParseError

from touchdown.experiments.errors import UsageError, reason_of
from touchdown.experiments.export.flown_run import LIBRARY, Exported, ExportOptions, FlownRun
from touchdown.experiments.io.sensor_log_reader import SensorLogReader
from touchdown.experiments.io.tum import Trajectory
from touchdown.sim.api import CameraImage, CameraIntrinsics, LidarScan
from touchdown.sim.frames import Pose
from touchdown.sim.geometry.lens import project
from touchdown.sim.typing import Array

Colours = NDArray[np.uint8]

_KEPT_IMAGES = 4
_MAX_COLOUR_AGE_S = 0.5
"""Greatest time between a return and the image that colours it."""
_VERTEX = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3), ("intensity", "<f4")])


def write_cloud(flown: FlownRun, path: Path, options: ExportOptions) -> Exported:
    """Binary little-endian PLY, world frame: x, y, z (m), red, green, blue and, of scans, intensity
    (0..255)."""
    if options.points == "map":
        return _write_map(flown, path)
    return _write_scans(flown, path, options)


def _write_map(flown: FlownRun, path: Path) -> Exported:
    source = flown.file("map.ply")
    try:
        cloud = PlyData.read(source)
        count = len(cloud["vertex"].data)
    except (PlyParseError, KeyError, ValueError) as error:
        raise UsageError(f"'{source}' is no map of a flight: {reason_of(error)}") from error
    cloud.comments = [f"{LIBRARY}: map, world frame, metres"]
    cloud.write(path)
    return Exported(path, {"points": count})


def _write_scans(flown: FlownRun, path: Path, options: ExportOptions) -> Exported:
    log = SensorLogReader(flown.sensors())
    rig = log.rig
    track = Trajectory(flown.file(f"{options.poses}.tum"))
    images: deque[CameraImage] = deque(maxlen=_KEPT_IMAGES)
    late = 0
    with path.open("wb") as file:
        cloud = _PlyFile(file, f"returns placed by the {options.poses}, world frame, metres")
        for obs in log:
            images.extend(obs.images)
            for scan in obs.scans:
                if not track.spans(scan.start_time_s, scan.end_time_s):
                    late += 1
                    continue
                points, intensity = placed_returns(scan, track, rig.body_from_lidar, options.every)
                colours = _grey(intensity)
                _paint(points, colours, scan, images, track, rig.body_from_camera, rig.camera)
                cloud.add(points, colours, intensity)
        cloud.finish()
    done = Exported(path, {"points": cloud.count})
    if late:
        done.notes.append(f"left out {late} scans that the trajectory does not span")
    return done


def placed_returns(
    scan: LidarScan, track: Trajectory, body_from_lidar: Pose, every: int
) -> tuple[Array, NDArray[np.float32]]:
    """(N, 3) world points of a scan's returns, each from the pose at its own time, and (N,)
    intensities."""
    hits = np.flatnonzero((scan.ranges > 0.0) & np.isfinite(scan.ranges))[::every]
    times = scan.start_time_s + scan.time_offsets[hits].astype(np.float64)
    in_lidar = (scan.directions[hits] * scan.ranges[hits, None]).astype(np.float64)
    positions, rotations = track.at(times)
    points = np.einsum("nij,nj->ni", rotations, body_from_lidar.apply(in_lidar)) + positions
    return points, scan.intensity[hits].astype(np.float32)


def _grey(intensity: NDArray[np.float32]) -> Colours:
    """(N, 3) grey levels, by intensity, of returns that no image shows."""
    level = (30.0 + 1.5 * np.minimum(intensity, 100.0)).astype(np.uint8)
    return np.repeat(level[:, None], 3, axis=1)


def _paint(
    points: Array,
    colours: Colours,
    scan: LidarScan,
    images: deque[CameraImage],
    track: Trajectory,
    body_from_camera: Pose,
    camera: CameraIntrinsics,
) -> None:
    """Writes the colours of the image nearest in time to the points that it shows."""
    middle = 0.5 * (scan.start_time_s + scan.end_time_s)
    near = [image for image in images if abs(image.time_s - middle) <= _MAX_COLOUR_AGE_S]
    if not near:
        return
    image = min(near, key=lambda each: abs(each.time_s - middle))
    if not track.spans(image.time_s, image.time_s):
        return
    camera_from_world = (track.pose(image.time_s) @ body_from_camera).inverse()
    pixels, seen = seen_in_image(camera_from_world.apply(points), camera)
    column, row = np.rint(pixels[seen]).astype(int).T
    colours[seen] = image.rgb[row, column]


def seen_in_image(points: Array, camera: CameraIntrinsics) -> tuple[Array, NDArray[np.bool_]]:
    """Pixels (N, 2) of (N, 3) points in the camera's frame, and (N,) True for those in the image.
    Occlusion is ignored: LIDAR and camera look from nearly the same point."""
    ahead = points[:, 2] > 0.01
    depth = np.where(ahead, points[:, 2], 1.0)
    plane = points[:, :2] / depth[:, None]
    half = np.array([camera.width / camera.fx, camera.height / camera.fy])
    half = np.tan(half) if camera.lens == "fisheye" else half
    # Outside the image a lens model may fold back into it.
    ahead &= (np.abs(plane) < half).all(axis=1)
    pixels = np.full((len(points), 2), -1.0)
    if ahead.any():
        pixels[ahead] = project(camera, points[ahead])[0]
    limit = np.array([camera.width - 0.5, camera.height - 0.5])
    return pixels, ahead & (pixels > -0.5).all(axis=1) & (pixels < limit).all(axis=1)


class _PlyFile:
    """PLY file that grows by scans. Not by `plyfile`, which writes arrays that are in memory as a
    whole."""

    def __init__(self, file: BinaryIO, comment: str) -> None:
        self._file, self._comment = file, comment
        self.count = 0
        self.finish()

    def add(self, points: Array, colours: Colours, intensity: NDArray[np.float32]) -> None:
        rows = np.empty(len(points), dtype=_VERTEX)
        rows["xyz"], rows["rgb"], rows["intensity"] = points, colours, intensity
        self._file.write(rows.tobytes())
        self.count += len(rows)

    def finish(self) -> None:
        """Writes the header with the present number of vertices, in a field of fixed length."""
        self._file.seek(0)
        head = (
            f"ply\nformat binary_little_endian 1.0\ncomment {LIBRARY}: {self._comment}\n"
            f"element vertex {self.count:012}\n"
            "property float x\nproperty float y\nproperty float z\n"
            "property uchar red\nproperty uchar green\nproperty uchar blue\n"
            "property float intensity\nend_header\n"
        )
        self._file.write(head.encode("ascii"))
