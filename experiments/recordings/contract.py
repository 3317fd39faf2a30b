"""What a format gives of a recording: raw messages with the stamps of their own clocks, and what
the data say of the rig themselves."""

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchdown.sim.api import (
    BarometerSheet,
    CameraIntrinsics,
    GpsSheet,
    ImuSheet,
    LidarSheet,
    MagnetometerParams,
    NavSheet,
    SensorRig,
)
from touchdown.sim.frames import Pose
from touchdown.sim.typing import Array, Bytes, Float32

Stamps = NDArray[np.int64]
"""nanoseconds of a clock of the recording"""


@dataclass(frozen=True, kw_only=True, slots=True)
class ImuTable:
    """All samples of an IMU, ascending in time."""

    stamps_ns: Stamps
    """(N,)"""
    gyro: Array
    """(N, 3) rad/s, IMU frame"""
    force: Array
    """(N, 3) m/s^2, IMU frame"""


@dataclass(frozen=True, kw_only=True, slots=True)
class PoseTable:
    """True poses of the body in any frame, ascending in time."""

    stamps_ns: Stamps
    """(N,)"""
    positions: Array
    """(N, 3) m"""
    quats_wxyz: Array
    """(N, 4)"""


@dataclass(frozen=True, kw_only=True, slots=True)
class NavTable:
    """What the small sensors measured, each ascending in time."""

    fix_ns: Stamps
    """(N,)"""
    fixes: Array
    """(N, 10) m and m/s: position and velocity, east, north, up, and the standard deviations that
    the receiver states, three of the position and one of each axis of the velocity"""
    pressure_ns: Stamps
    """(M,)"""
    pressures_pa: Array
    """(M,)"""
    field_ns: Stamps
    """(K,)"""
    fields_ut: Array
    """(K, 3) body frame"""


@dataclass(frozen=True, kw_only=True, slots=True)
class RotorTable:
    """Speeds of rotors, ascending in time."""

    stamps_ns: Stamps
    """(N,)"""
    speeds: Array
    """(N, R) rad/s"""


@dataclass(frozen=True, kw_only=True, slots=True)
class RawScan:
    """Returns of one sweep of a LIDAR."""

    stamp_ns: int
    points: Float32
    """(N, 3) m, LIDAR frame; (0, 0, 0) or not finite: no return"""
    offsets_s: Float32
    """(N,) s after the stamp, in any order; all 0: the sweep is moved to one instant already"""
    intensity: Bytes
    """(N,) 0..255"""
    arrives_ns: int | None = None
    """when it was on board, where DATA tells; None: the latency of the rig after its end"""


@dataclass(frozen=True, kw_only=True, slots=True)
class RawImage:
    """One image; it is decoded when it is used."""

    stamp_ns: int
    right: bool
    """of the right camera of a pair"""
    read: Callable[[], Bytes]
    """(H, W, 3) RGB. Raises ValueError, one line"""
    arrives_ns: int | None = None
    """as that of a `RawScan`"""


RawFrame = RawScan | RawImage


@dataclass(frozen=True, kw_only=True, slots=True)
class Lens:
    """A camera as its calibration gives it."""

    intrinsics: CameraIntrinsics
    body_from_camera: Pose
    offset_s: float = 0.0
    """what is added to its stamps to give the time of the IMU's clock"""


@dataclass(frozen=True, kw_only=True, slots=True)
class RigParts:
    """What is known of a rig. The body is the IMU unless ``body_from_imu`` says otherwise."""

    camera: Lens | None = None
    right: Lens | None = None
    body_from_imu: Pose = field(default_factory=Pose.identity)
    body_from_lidar: Pose | None = None
    lidar: LidarSheet = field(default_factory=lambda: LidarSheet(min_range_m=0.5))
    lidar_offset_s: float = 0.0
    """as that of a `Lens`"""
    imu: ImuSheet = field(default_factory=ImuSheet)
    nav: NavSheet = field(default_factory=lambda: NavSheet(
        gps=GpsSheet(antenna_body_m=(0.0, 0.0, 0.0), latency_ticks=0),
        barometer=BarometerSheet(latency_ticks=0),
        magnetometer=MagnetometerParams(latency_ticks=0, declination_deg=0.0),
    ))  # fmt: skip
    topics: dict[str, str] = field(default_factory=dict)
    """of a bag, by what they hold"""
    moving: bool = False
    """the recording begins in motion"""
    latency_s: float = 0.0
    """from the stamp of a scan or an image until an estimator gets it"""
    whole: SensorRig | None = None
    """a rig as our exports write it, which says all"""

    def with_more(self, other: "RigParts") -> "RigParts":
        """These parts, and those of ``other`` where it says something."""
        blank = RigParts()
        said = {
            one.name: getattr(other, one.name)
            for one in dataclasses.fields(other)
            if not _same(getattr(other, one.name), getattr(blank, one.name))
        }
        return dataclasses.replace(self, **said)


def _same(first: object, second: object) -> bool:
    if isinstance(first, Pose) and isinstance(second, Pose):
        return bool(np.array_equal(first.matrix(), second.matrix()))
    return type(first) is type(second) and first == second


class Span(NamedTuple):
    """Stamps from the first to before the last."""

    first_ns: int
    last_ns: int

    def holds(self, stamp_ns: int) -> bool:
        """True for a stamp in it."""
        return self.first_ns <= stamp_ns < self.last_ns


ALL = Span(-(1 << 62), 1 << 62)


class Recording:
    """A recording in one format, here without messages. The methods of formats raise UsageError,
    one line, for what is damaged."""

    path: Path
    found: RigParts
    """what the data say of the rig"""

    def imu(self) -> ImuTable | None:
        """All samples; None without an IMU."""
        return None

    def truth(self) -> PoseTable | None:
        """Poses of the body; None without."""
        return None

    def nav(self) -> NavTable | None:
        """Fixes, pressures and magnetic fields; None without any."""
        return None

    def rotors(self) -> RotorTable | None:
        """Speeds of the rotors of the vehicle; None without, as is usual."""
        return None

    def frames(self, span: Span = ALL) -> Iterator[RawFrame]:
        """Scans and images of a span of stamps in the order of the recording, which is nearly that
        of the stamps; each time from the beginning."""
        return iter(())

    def begins_ns(self) -> int:
        """The first stamp of a frame."""
        return next((frame.stamp_ns for frame in self.frames()), 0)
