"""Folders of data sets: EuRoC's ASL layout and KITTI odometry's."""

import dataclasses
import functools
from collections.abc import Callable, Iterator
from itertools import zip_longest
from pathlib import Path
from typing import TypeVar

import numpy as np

from touchdown.experiments.errors import UsageError, reason_of
from touchdown.experiments.io.untrusted import inside
from touchdown.experiments.recordings.contract import (
    ALL,
    ImuTable,
    Lens,
    PoseTable,
    RawFrame,
    RawImage,
    RawScan,
    Recording,
    RigParts,
    RotorTable,
    Span,
    Stamps,
)
from touchdown.experiments.recordings.pictures import read_image
from touchdown.experiments.recordings.rig_files import (
    intrinsics_of,
    numbers,
    pose_of,
    read_rig,
    read_yaml,
)
from touchdown.sim.api import CameraIntrinsics, ImuSheet, LidarSheet
from touchdown.sim.files.opening import check_file, no_file
from touchdown.sim.frames import Pose, matrices_from_quats_wxyz, quat_wxyz_from_matrix
from touchdown.sim.typing import Array

T = TypeVar("T")
_MAX_TABLE_BYTES = 1 << 31
_MAX_SCAN_BYTES = 1 << 28


def _told(path: Path, read: Callable[[], T]) -> T:
    """The result of ``read``; its errors become one line that names ``path``."""
    try:
        return read()
    except UsageError:
        raise
    except KeyError as error:
        raise UsageError(f"'{path}' lacks {str(error.args[0])[:40]!r}") from error
    except (ValueError, TypeError, OSError) as error:
        reason = reason_of(error)
        raise UsageError(reason if str(path) in reason else f"'{path}': {reason}") from error


def _rows(path: Path, columns: int) -> tuple[Stamps, Array]:
    """Stamps (N,) ns as int64 and the numbers after them (N, columns) of a table with commas."""
    check_file(path, "table", _MAX_TABLE_BYTES)
    stamps: list[int] = []
    values: list[list[float]] = []
    with path.open(encoding="ascii", errors="replace") as file:
        for number, line in enumerate(file, 1):
            if not line.strip() or line.startswith("#"):
                continue
            words = line.split(",")
            try:
                stamps.append(int(words[0]))
                values.append([float(word) for word in words[1 : columns + 1]])
                if len(values[-1]) != columns or not np.isfinite(values[-1]).all():
                    raise ValueError
            except ValueError:
                raise UsageError(
                    f"'{path}': line {number} is not a stamp and {columns} numbers, but "
                    f"{line[:40].strip()!r}"
                ) from None
    if not stamps:
        raise UsageError(f"'{path}' is empty")
    if stamps[-1] >= 1 << 62 or stamps[0] < 0:
        raise UsageError(f"'{path}': stamps are not nanoseconds")
    order = np.array(stamps, np.int64)
    if (np.diff(order) <= 0).any():
        where = int(np.argmax(np.diff(order) <= 0)) + 1
        raise UsageError(f"'{path}': stamp {order[where]} is not later than the one before")
    return order, np.array(values)


class EurocFolder(Recording):
    """A folder ``mav0`` of EuRoC MAV, or the one that holds it. The body is the IMU, in a folder of
    ours that of the rig in it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._root = path / "mav0" if (path / "mav0").is_dir() else path
        own = self._root / "rig.json"
        self.found = self._rig() if no_file(own) == "does not exist" else read_rig(own)

    @staticmethod
    def holds(path: Path) -> bool:
        """True if ``path`` looks like one."""
        return (path / "mav0").is_dir() or (path / "imu0").is_dir()

    def _rig(self) -> RigParts:
        sheet = _told(self._root / "imu0", self._imu_sheet)
        cameras = [self._root / f"cam{n}" for n in range(2)]
        lenses = [_told(one, functools.partial(_lens, one)) if one.is_dir() else None
                  for one in cameras]  # fmt: skip
        return RigParts(imu=sheet, camera=lenses[0], right=lenses[1] if lenses[0] else None)

    def _imu_sheet(self) -> ImuSheet:
        told = read_yaml(self._root / "imu0" / "sensor.yaml")
        names = {
            "gyro_density": "gyroscope_noise_density", "gyro_bias_walk": "gyroscope_random_walk",
            "accel_density": "accelerometer_noise_density",
            "accel_bias_walk": "accelerometer_random_walk",
        }  # fmt: skip
        given = {one: abs(float(numbers(told[key], 1, key)[0])) for one, key in names.items()}
        # the format does not tell turn-on biases; those of the ADIS16448 of EuRoC are the largest
        return ImuSheet(gyro_bias_sigma=0.08, accel_bias_sigma=0.4, **given)

    def imu(self) -> ImuTable:
        """The samples of ``imu0``."""
        file = self._root / "imu0" / "data.csv"
        stamps, values = _told(file, lambda: _rows(file, 6))
        return ImuTable(stamps_ns=stamps, gyro=values[:, :3], force=values[:, 3:])

    def truth(self) -> PoseTable | None:
        """The states of ``state_groundtruth_estimate0``, if there are any."""
        file = self._root / "state_groundtruth_estimate0" / "data.csv"
        if no_file(file) == "does not exist":
            return None
        stamps, values = _told(file, lambda: _rows(file, 7))
        if (whole := self.found.whole) is not None:
            turns = matrices_from_quats_wxyz(values[:, 3:])
            imu_from_body = whole.body_from_imu.inverse()
            values[:, :3] += turns @ imu_from_body.translation
            turned = turns @ imu_from_body.rotation
            values[:, 3:] = [quat_wxyz_from_matrix(turn) for turn in turned]
        return PoseTable(stamps_ns=stamps, positions=values[:, :3], quats_wxyz=values[:, 3:])

    def rotors(self) -> RotorTable | None:
        """The speeds in ``rotors0``, which our exports write beside their rig."""
        file, whole = self._root / "rotors0" / "data.csv", self.found.whole
        if whole is None or no_file(file) == "does not exist":
            return None
        stamps, speeds = _told(file, lambda: _rows(file, len(whole.vehicle.rotor_spin)))
        return RotorTable(stamps_ns=stamps, speeds=speeds)

    def _lists(self) -> list[list[tuple[int, Path]]]:
        return [_told(folder, functools.partial(_listed, folder))
                for folder in (self._root / "cam0", self._root / "cam1")
                if folder.is_dir()]  # fmt: skip

    def _arrivals(self) -> dict[int, int]:
        """When images were on board, by their stamps, which our exports write beside their rig."""
        file = self._root / "arrivals.csv"
        if self.found.whole is None or no_file(file) == "does not exist":
            return {}
        stamps, values = _told(file, lambda: _rows(file, 1))
        return dict(zip(stamps.tolist(), values[:, 0].astype(int).tolist(), strict=True))

    def begins_ns(self) -> int:
        """The first stamp of an image."""
        return min((rows[0][0] for rows in self._lists() if rows), default=0)

    def frames(self, span: Span = ALL) -> Iterator[RawFrame]:
        """Left images, each before the right one of its row."""
        arrivals = self._arrivals()
        for pair in zip_longest(*self._lists()):
            for n, entry in enumerate(pair):
                if entry is not None and span.holds(entry[0]):
                    stamp, file = entry
                    read = functools.partial(read_image, file)
                    at = arrivals.get(stamp)
                    yield RawImage(stamp_ns=stamp, right=n == 1, read=read, arrives_ns=at)


def _lens(folder: Path) -> Lens:
    told = read_yaml(folder / "sensor.yaml")
    mount = pose_of(told["T_BS"]["data"], "T_BS")
    model = told.get("distortion_model", "none")
    camera = intrinsics_of(
        model, told["resolution"], told["intrinsics"], told.get("distortion_coefficients", []),
        folder.name,
    )  # fmt: skip
    return Lens(intrinsics=camera, body_from_camera=mount)


def _listed(folder: Path) -> list[tuple[int, Path]]:
    """Stamps and files of the images of a camera; each must be there."""
    listing = folder / "data.csv"
    check_file(listing, "list of images", _MAX_TABLE_BYTES)
    found = []
    for line in listing.read_text(encoding="ascii", errors="replace").splitlines():
        if line.strip() and not line.startswith("#"):
            stamp, _, name = line.partition(",")
            file = inside(folder / "data", name.strip())
            if reason := no_file(file):
                raise ValueError(f"'{listing}' names '{file.name}', which {reason}")
            found.append((int(stamp), file))
    return found


class KittiFolder(Recording):
    """A sequence of KITTI odometry: ``velodyne``, ``image_2`` or ``image_3``, ``calib.txt`` and
    ``times.txt``; poses in ``poses.txt`` or ``../../poses/NN.txt``. The body is the LIDAR. Sweeps
    are moved to one instant by the data set, and there is no IMU."""

    def __init__(self, path: Path) -> None:
        self.path = self._root = path
        sequences = sorted((path / "sequences").glob("*")) if (path / "sequences").is_dir() else []
        if sequences:
            if len(sequences) > 1:
                raise UsageError(f"'{path}' holds {len(sequences)} sequences; name one of them")
            self._root = sequences[0]
        self._images = next(
            (one for n in (2, 3, 0, 1) if (one := self._root / f"image_{n}").is_dir()), None
        )
        self.found = _told(self._root / "calib.txt", self._rig)

    @staticmethod
    def holds(path: Path) -> bool:
        """True if ``path`` looks like one."""
        return (path / "calib.txt").is_file() or (path / "sequences").is_dir()

    @functools.cached_property
    def _calibration(self) -> dict[str, Array]:
        file = self._root / "calib.txt"
        check_file(file, "calibration", 1 << 20)
        rows = [line.partition(":") for line in file.read_text("ascii", "replace").splitlines()]
        return {key.strip(): numbers(text.split(), 12, key.strip()[:20]).reshape(3, 4)
                for key, colon, text in rows if colon}  # fmt: skip

    def _rig(self) -> RigParts:
        lidar = LidarSheet(min_range_m=0.9, max_range_m=120.0)
        parts = RigParts(body_from_lidar=Pose.identity(), lidar=lidar, moving=True)
        if self._images is None:
            return parts
        projection = self._calibration[f"P{self._images.name[-1]}"]
        fx, fy, cx, cy = projection[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
        first = next(iter(sorted(self._images.iterdir())), None)
        if first is None:
            raise ValueError(f"'{self._images}' is empty")
        height, width = read_image(first).shape[:2]
        camera = CameraIntrinsics(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)
        shift = Pose(np.eye(3), np.linalg.inv(projection[:, :3]) @ projection[:, 3])
        lens = Lens(intrinsics=camera, body_from_camera=(shift @ self._camera_from_body).inverse())
        return dataclasses.replace(parts, camera=lens)

    @property
    def _camera_from_body(self) -> Pose:
        """Of the left grey camera, whose poses the data set gives, from the LIDAR."""
        return pose_of(self._calibration["Tr"].ravel().tolist(), "Tr")

    @functools.cached_property
    def _stamps(self) -> list[int]:
        file = self._root / "times.txt"

        def read() -> list[int]:
            check_file(file, "table", _MAX_TABLE_BYTES)
            words = file.read_text("ascii", "replace").split()
            times = numbers(words, len(words), "the list")
            if not len(times) or (np.diff(times) <= 0.0).any():
                raise ValueError("times are not ascending, or there are none")
            return np.rint(times * 1e9).astype(np.int64).tolist()  # type: ignore[no-any-return]

        return _told(file, read)

    def truth(self) -> PoseTable | None:
        """The poses, if there are any."""
        places = (
            self._root / "poses.txt",
            self._root.resolve().parents[1] / "poses" / f"{self._root.resolve().name}.txt",
        )
        file = next((one for one in places if no_file(one) != "does not exist"), None)
        if file is None:
            return None

        def read() -> Array:
            check_file(file, "poses", _MAX_TABLE_BYTES)
            words = file.read_text("ascii", "replace").split()
            return numbers(words, 12 * len(self._stamps), f"{len(self._stamps)} poses")

        table = _told(file, read).reshape(-1, 12)
        poses = [_told(file, functools.partial(pose_of, row.tolist(), "a pose"))
                 @ self._camera_from_body for row in table]  # fmt: skip
        return PoseTable(
            stamps_ns=np.array(self._stamps, np.int64),
            positions=np.array([pose.translation for pose in poses]),
            quats_wxyz=np.array([quat_wxyz_from_matrix(pose.rotation) for pose in poses]),
        )

    def begins_ns(self) -> int:
        """The first stamp of a frame."""
        return self._stamps[0]

    def frames(self, span: Span = ALL) -> Iterator[RawFrame]:
        """Each scan before the image of its frame."""
        for n, stamp in enumerate(self._stamps):
            if not span.holds(stamp):
                continue
            scan = self._root / "velodyne" / f"{n:06}.bin"
            yield _told(scan, functools.partial(_velodyne, scan, stamp))
            if self._images is not None:
                file = self._images / f"{n:06}.png"
                yield RawImage(
                    stamp_ns=stamp, right=False, read=functools.partial(read_image, file)
                )


def _velodyne(file: Path, stamp: int) -> RawScan:
    check_file(file, "scan", _MAX_SCAN_BYTES)
    data = np.fromfile(file, "<f4")
    if not len(data) or len(data) % 4:
        raise ValueError(f"'{file}' is cut short: it is no whole number of points of 16 bytes")
    table = data.reshape(-1, 4)
    level = np.clip(np.nan_to_num(table[:, 3]) * 255.0, 0.0, 255.0).astype(np.uint8)
    return RawScan(
        stamp_ns=stamp, points=np.ascontiguousarray(table[:, :3]),
        offsets_s=np.zeros(len(table), np.float32), intensity=level,
    )  # fmt: skip
