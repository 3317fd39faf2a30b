"""Reader of sensor logs: returns the observations of a flight, equal to the bit."""

from __future__ import annotations

import dataclasses
import io
import json
import struct
import zlib
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
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
from touchdown.experiments.io.sensor_log_checks import (
    MAX_PIXELS,
    DamagedError,
    check_order,
    check_rig,
    damage_reported,
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


Arrived = defaultdict[str, deque[bytes]]
"""messages by topic"""


@dataclass(frozen=True, slots=True)
class PackedImage:
    """One exposure with a `CameraImage`'s stamp, as PNG."""

    tick: int
    time_s: float
    png: NDArray[np.uint8]
    right_png: NDArray[np.uint8] | None


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
            self.rig = from_plain(SensorRig, json.loads(facts["rig"]))
            self.sensed = from_plain(SensorNeeds, json.loads(facts["sensed"]))
            self.shared = from_plain(SensorNeeds, json.loads(facts["shared"]))
            check_rig(self.rig)

    def __iter__(self) -> Iterator[Observation]:
        return self.observations()

    def packed(self) -> Iterator[tuple[Observation, tuple[PackedImage, ...]]]:
        """Observations from the beginning; images separately, as the logged PNG files."""
        return self._read(True, _packed_images)

    def observations(self, images: bool = True) -> Iterator[Observation]:
        """Observations from the beginning; half the time without images."""
        return (obs for obs, _ in self._read(images, lambda _plain, _arrived: ()))

    def _read(
        self, images: bool, take: Callable[[dict[str, Any], Arrived], tuple[PackedImage, ...]]
    ) -> Iterator[tuple[Observation, tuple[PackedImage, ...]]]:
        """Observations, and the images that ``take`` takes out of each before it is made."""
        before = -1
        for plain, arrived in self._arrivals(images):
            with damage_reported(self.path):
                taken = take(plain, arrived)
                obs = _observation(plain, arrived)
                check_order(obs, self.rig, before)
                before = obs.tick
            yield obs, taken

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


def _packed_images(plain: dict[str, Any], arrived: Arrived) -> tuple[PackedImage, ...]:
    left, right = (arrived[topic] for topic in IMAGE_TOPICS)
    images = []
    for tick, time_s, stereo in plain.pop("images", []):
        eyes = [_png(left.popleft()), *([_png(right.popleft())] if stereo else [])]
        for eye in eyes:
            unpack_image(eye)
        images.append(PackedImage(tick, time_s, eyes[0], eyes[1] if stereo else None))
    return tuple(images)


def _observation(plain: dict[str, Any], arrived: Arrived) -> Observation:
    scans, images = plain.pop("scans", []), plain.pop("images", [])
    return dataclasses.replace(
        from_plain(Observation, plain),
        scans=tuple(_scan(head, arrived[SCAN_TOPIC].popleft()) for head in scans),
        images=tuple(_image(head, arrived) for head in images),
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


def _image(head: list[Any], arrived: Arrived) -> CameraImage:
    tick, time_s, stereo = head
    left, right = (arrived[topic] for topic in IMAGE_TOPICS)
    return CameraImage(
        tick=tick,
        time_s=time_s,
        rgb=unpack_image(_png(left.popleft())),
        right_rgb=unpack_image(_png(right.popleft())) if stereo else None,
    )


def _text(message: bytes) -> str:
    return str(ros.deserialized(message, "std_msgs/msg/String").data)


def _png(message: bytes) -> NDArray[np.uint8]:
    png: NDArray[np.uint8] = ros.deserialized(message, "sensor_msgs/msg/CompressedImage").data
    return png


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
