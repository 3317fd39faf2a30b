"""Writer of ROS 2 messages to one MCAP file, as sensor logs need it.

Uses `mcap`, not `rosbags`: it stores the time of measurement beside the time of arrival and a
metadata record ahead of all messages, and may omit checksums.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any, BinaryIO

from mcap.writer import CompressionType, Writer

from touchdown.experiments.io import ros2_messages as ros

_CHUNK_BYTES = 4 << 20


class MessageLog:
    """Appends messages to the file ``path``, which is complete after ``close``. Memory does not
    grow with the number of messages but for the file's index (a kilobyte per second of flight)."""

    def __init__(self, path: Path) -> None:
        self._file: BinaryIO = path.open("wb")
        # Checksums are left to the file system: they cost more than packing.
        self._writer = Writer(
            self._file, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD, enable_crcs=False
        )
        self._writer.start(profile="ros2", library="touchdown")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._counts: Counter[str] = Counter()

    def add_metadata(self, name: str, facts: dict[str, str]) -> None:
        """Writes a metadata record."""
        self._writer.add_metadata(name, facts)

    def put(self, topic: str, log_ns: int, publish_ns: int, message: Any) -> None:
        """Appends a message of `ros2_messages`. All messages of a topic have one type."""
        if topic not in self._channels:
            self._channels[topic] = self._register(topic, message.__msgtype__)
        self._writer.add_message(
            self._channels[topic],
            log_time=log_ns,
            data=bytes(ros.serialized(message)),
            publish_time=publish_ns,
            sequence=self._counts[topic],
        )
        self._counts[topic] += 1

    def close(self) -> None:
        """Writes the index and closes the file."""
        try:
            self._writer.finish()
        finally:
            self._file.close()

    def _register(self, topic: str, kind: str) -> int:
        if kind not in self._schemas:
            text = ros.definition(kind).encode()
            self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", text)
        return self._writer.register_channel(
            topic, "cdr", self._schemas[kind], {"offered_qos_profiles": ""}
        )
