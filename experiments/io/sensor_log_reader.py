"""Reader of sensor logs: returns the observations of a flight, equal to the bit. A log may be
damaged; what no flight has logged does not reach an estimator."""

import contextlib
import dataclasses
import io
import json
import math
import struct
import zlib
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from mcap.exceptions import EndOfFile
from mcap.records import Channel, Chunk, Message, Metadata
from mcap.stream_reader import StreamReader, breakup_chunk
from numpy.typing import NDArray
from PIL.PngImagePlugin import PngImageFile

from touchdown.experiments.errors import UsageError
from touchdown.experiments.io import ros2_messages as ros
from touchdown.experiments.io.dataclass_json import from_plain
from touchdown.experiments.io.sensor_log import (
    FORMAT,
    IMAGE_TOPICS,
    METADATA,
    OBSERVATION_TOPIC,
    SCAN_TOPIC,
)
from touchdown.sim.api import CameraImage, LidarScan, Observation, SensorNeeds, SensorRig
from touchdown.sim.files.opening import no_file

_WANTED = frozenset({OBSERVATION_TOPIC, SCAN_TOPIC, *IMAGE_TOPICS})
MAX_RECORD_BYTES = 1 << 27
"""of a record, and of a chunk once inflated; a flight writes 4 MiB and one message"""
MAX_OBSERVATION_BYTES = MAX_RECORD_BYTES
"""of all messages of one observation"""
MAX_TEXT_BYTES = 1 << 24
"""of an observation without its scans and images"""
MAX_PIXELS = 1 << 26
"""of an image"""
_MAX_TICK = 1 << 53


class DamagedError(ValueError):
    """Content that no log of a flight has."""


@contextlib.contextmanager
def damage_reported(path: Path) -> Iterator[None]:
    """Turns errors of inconsistent content into a UsageError that says what is wrong with
    ``path``."""
    from rosbags.serde import SerdeError

    faults = {
        (struct.error, SerdeError): "a message is cut short",
        (LookupError,): "a message or a value is missing",
        (MemoryError,): "a part claims an absurd size",
        (TypeError, ArithmeticError, RecursionError, AttributeError, ValueError): (
            "a value is not of its kind"
        ),
    }
    try:
        yield
    except UsageError:
        raise
    except tuple(kind for kinds in faults for kind in kinds) as error:
        why = next(text for kinds, text in faults.items() if isinstance(error, kinds))
        why = str(error) if isinstance(error, DamagedError) else why
        raise UsageError(f"'{path}' is damaged: {why}; fly again with --log-sensors") from error


Arrived = defaultdict[str, deque[bytes]]
"""messages by topic"""


@dataclass(frozen=True, slots=True)
class PackedImage:
    """One exposure with a `CameraImage`'s stamp, as PNG."""

    tick: int
    time_s: float
    png: NDArray[np.uint8]
    right_png: NDArray[np.uint8] | None

    @property
    def pngs(self) -> tuple[NDArray[np.uint8], ...]:
        """Of the left eye, and of the right one where there is one."""
        return (self.png,) if self.right_png is None else (self.png, self.right_png)


class SensorLogReader:
    """A log at ``path``. Iteration returns its observations in order, each time from the beginning;
    only the present one is kept in memory.

    Raises UsageError if the file is missing, damaged or not a sensor log.
    """

    rig: SensorRig
    """the nominal calibration of the flight"""
    sensed: SensorNeeds
    """all sensor data that the flight simulated, hence that the log holds"""
    shared: SensorNeeds
    """the part of it that components other than the estimator requested"""
    remedy = "log a flight of an estimator that asks for it"
    """what to do where a sensor is missing"""

    def __init__(self, path: Path) -> None:
        self.path = path
        if reason := no_file(path):
            raise UsageError(f"'{path}' {reason}; fly with --log-sensors to record one")
        facts = self._metadata()
        if facts.get("format") != FORMAT:
            raise UsageError(
                f"'{path}' is a sensor log of format {facts.get('format')}, not {FORMAT}; "
                "fly again with --log-sensors"
            )
        with damage_reported(path):
            self.rig = from_plain(SensorRig, json.loads(facts["rig"], parse_constant=_not_nan))
            self.sensed = from_plain(SensorNeeds, json.loads(facts["sensed"]))
            self.shared = from_plain(SensorNeeds, json.loads(facts["shared"]))
            check_rig(self.rig)

    def __iter__(self) -> Iterator[Observation]:
        return self.observations()

    def observations(
        self, images: bool = True, keep: Callable[[Any], bool] | None = None, right: bool = True
    ) -> Iterator[Observation]:
        """Observations from the beginning; half the time without images. ``keep``: true for an
        image, by its stamp, to decode; ``right``: with that of the right eye, if there is one."""
        return (obs for obs, _ in self.packed(images, keep, right))

    def packed(
        self, images: bool = True, keep: Callable[[Any], bool] | None = None, right: bool = True
    ) -> Iterator[tuple[Observation, tuple[PackedImage, ...]]]:
        """As ``observations``, each with its images as the logged PNG files too."""
        before = -1
        for plain, arrived in self._arrivals(images):
            with damage_reported(self.path):
                packed = tuple(_packed(head, arrived) for head in plain.pop("images", []))
                if keep is not None:
                    packed = tuple(image for image in packed if keep(image))
                if not right:
                    packed = tuple(dataclasses.replace(image, right_png=None) for image in packed)
                obs = _observation(plain, arrived, packed)
                _check(obs, self.rig, before)
                before = obs.tick
            yield obs, packed

    def _arrivals(self, images: bool) -> Iterator[tuple[dict[str, Any], Arrived]]:
        """Observations as plain values, each with the messages before it by topic, which its reader
        takes out."""
        arrived: Arrived = defaultdict(deque)
        waiting = 0
        for topic, data in self._messages():
            with damage_reported(self.path):
                waiting += len(data)
                if waiting > MAX_OBSERVATION_BYTES:
                    maximum = MAX_OBSERVATION_BYTES >> 20
                    raise DamagedError(f"an observation has more than {maximum} MiB of messages")
                if topic == OBSERVATION_TOPIC:
                    if len(data) > MAX_TEXT_BYTES:
                        raise DamagedError("an observation has an absurd size")
                    plain = json.loads(_text(data))
            if topic == OBSERVATION_TOPIC:
                yield plain if images else plain | {"images": []}, arrived
                with damage_reported(self.path):
                    if any(arrived.values()):
                        raise DamagedError("a message belongs to no observation")
                waiting = 0
            elif images or topic not in IMAGE_TOPICS:
                arrived[topic].append(data)

    def _metadata(self) -> dict[str, str]:
        for record in self._records():
            if isinstance(record, Metadata) and record.name == METADATA:
                return record.metadata
            if isinstance(record, Message):
                break
        raise UsageError(f"'{self.path}' is an MCAP file, but no sensor log of a flight")

    def _messages(self) -> Iterator[tuple[str, bytes]]:
        """Topics and messages in the order of writing, which an order by time does not preserve."""
        topics: dict[int, str] = {}
        for record in self._records():
            if isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Message) and topics.get(record.channel_id) in _WANTED:
                yield topics[record.channel_id], record.data

    def _records(self) -> Iterator[Any]:
        """Records, those of chunks among them; no more is inflated than a chunk states."""
        with self.path.open("rb") as file:
            reader = StreamReader(
                file, emit_chunks=True, validate_crcs=True, record_size_limit=MAX_RECORD_BYTES
            )
            records = iter(reader.records)
            while True:
                try:
                    record = next(records)
                    parts = _parts(record) if isinstance(record, Chunk) else (record,)
                except StopIteration:
                    return
                except Exception as error:  # decompressors have errors of their own
                    why = _reason(error)
                    raise UsageError(f"'{self.path}' is no complete MCAP file: {why}") from error
                yield from parts


def _parts(chunk: Chunk) -> list[Any]:
    """The records of a chunk."""
    size = chunk.uncompressed_size
    if size > MAX_RECORD_BYTES:
        raise ValueError(f"a chunk of {size >> 20} MiB, more than {MAX_RECORD_BYTES >> 20} MiB")
    data = _inflated(chunk.data, chunk.compression, size)
    return breakup_chunk(dataclasses.replace(chunk, compression="", data=data), validate_crc=True)


def _inflated(data: bytes, compression: str, size: int) -> bytes:
    """The ``size`` bytes that a chunk states. Raises ValueError where it inflates to more or fewer,
    and for another compression than that of a flight."""
    if compression == "zstd":
        data = zstandard.ZstdDecompressor().stream_reader(data).read(size + 1)
    elif compression:
        raise ValueError(f"a chunk is compressed by {compression[:40]!a}, not by zstd")
    if len(data) != size:
        raise ValueError("a chunk does not inflate to the size that it states")
    return data


def _reason(error: Exception) -> str:
    if isinstance(error, EndOfFile | struct.error):
        return "it ends too early"
    if isinstance(error, MemoryError | OverflowError):
        return "a part claims an absurd size"
    return " ".join(str(error).split())[:200] or "a part is not what it claims"


def _packed(head: list[Any], arrived: Arrived) -> PackedImage:
    tick, time_s, stereo = head
    left, right = (arrived[topic] for topic in IMAGE_TOPICS)
    return PackedImage(
        tick, time_s, _png(left.popleft()), _png(right.popleft()) if stereo else None
    )


def _observation(
    plain: dict[str, Any], arrived: Arrived, packed: tuple[PackedImage, ...]
) -> Observation:
    scans = plain.pop("scans", [])
    return dataclasses.replace(
        from_plain(Observation, plain),
        scans=tuple(_scan(head, arrived[SCAN_TOPIC].popleft()) for head in scans),
        images=tuple(_image(one) for one in packed),
    )


def _scan(head: list[Any], message: bytes) -> LidarScan:
    data = ros.deserialized(message, "std_msgs/msg/UInt8MultiArray").data
    count = int(data[:4].view("<u4")[0])
    planes = data[4 : 4 + 20 * count].reshape(5, 4, count)
    columns = np.ascontiguousarray(planes.transpose(0, 2, 1)).view("<f4")[..., 0]
    start_tick, end_tick, start_time_s, end_time_s = head
    return LidarScan(
        start_tick=start_tick,
        end_tick=end_tick,
        start_time_s=start_time_s,
        end_time_s=end_time_s,
        directions=_frozen(np.ascontiguousarray(columns[:3].T)),
        ranges=_frozen(columns[3].copy()),
        time_offsets=_frozen(columns[4].copy()),
        intensity=_frozen(data[4 + 20 * count :].copy()),
    )


def _image(packed: PackedImage) -> CameraImage:
    right = packed.right_png
    return CameraImage(
        tick=packed.tick,
        time_s=packed.time_s,
        rgb=unpack_image(packed.png),
        right_rgb=None if right is None else unpack_image(right),
    )


def _text(message: bytes) -> str:
    return str(ros.deserialized(message, "std_msgs/msg/String").data)


def _png(message: bytes) -> NDArray[np.uint8]:
    return ros.deserialized(message, "sensor_msgs/msg/CompressedImage").data


def unpack_image(png: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(H, W, 3) RGB of a PNG file. Raises DamagedError where it is none; of its data no more is
    inflated than its pixels need."""
    try:
        with PngImageFile(io.BytesIO(png.tobytes())) as image:
            if image.width * image.height > MAX_PIXELS:
                raise DamagedError(f"an image has more than {MAX_PIXELS} pixels")
            return _frozen(np.array(image.convert("RGB")))
    except (OSError, SyntaxError, ValueError, zlib.error) as error:
        raise DamagedError(f"an image cannot be decoded ({error})") from None


def _frozen(array: NDArray[Any]) -> NDArray[Any]:
    array.setflags(write=False)
    return array


_POSITIVE = (
    "tick_hz", "imu_ticks", "camera_ticks", "lidar_scan_ticks", "camera.width", "camera.height",
    "camera.fx", "camera.fy", "vehicle.mass_kg", "vehicle.thrust_coefficient",
)  # fmt: skip


def _not_nan(constant: str) -> float:
    if constant == "NaN":
        raise DamagedError("a value of the rig is not a number")
    return float(constant)


def check_rig(rig: SensorRig) -> None:
    """Raises DamagedError for a rig that no flight has."""
    for name in _POSITIVE:
        if not 0 < attrgetter(name)(rig) < math.inf:
            raise DamagedError(f"{name} of the rig is not positive")
    if rig.tick_hz > 10**6 or rig.camera.width * rig.camera.height > MAX_PIXELS:
        raise DamagedError("rates or image size of the rig are absurd")
    if rig.camera_ticks > rig.tick_hz:
        raise DamagedError("the camera of the rig has no rate")


def _check(obs: Observation, rig: SensorRig, before: int) -> None:
    """Raises DamagedError unless the observation is one of ``rig`` and follows that of the tick
    ``before``. Its messages may say anything: faults change them."""
    if not before < obs.tick < _MAX_TICK:
        raise DamagedError(f"the observation of tick {obs.tick} is out of order")
    if abs(obs.time_s - obs.tick / rig.tick_hz) > 1e-6 * max(1.0, obs.time_s):
        raise DamagedError(f"the time of tick {obs.tick} is another")
    if obs.rotor_speed_radps.shape != rig.vehicle.rotor_spin.shape:
        raise DamagedError("there is not one rotor speed for each rotor")
    for name in ("imu", "gps", "barometer", "magnetometer", "rangefinder"):
        for message in getattr(obs, name):
            for field in dataclasses.fields(message):
                value = getattr(message, field.name)
                if isinstance(value, np.ndarray) and value.shape != (3,):
                    raise DamagedError(f"{field.name} of {name} is no vector")
    if any(len(scan.intensity) != len(scan.ranges) for scan in obs.scans):
        raise DamagedError("a scan has not one intensity for each range")
    size = (rig.camera.height, rig.camera.width, 3)
    for image in obs.images:
        if any(eye is not None and eye.shape != size for eye in (image.rgb, image.right_rgb)):
            raise DamagedError("an image is not of the camera's size")
