"""Writes ROS 2 messages to an MCAP file, with the definitions of their types beside them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

from mcap.writer import CompressionType, Writer

from touchdown.experiments.io import ros2_messages as ros

_CHUNK_BYTES = 4 << 20
_FOREVER = "{sec: 9223372036, nsec: 854775807}"
_LATCHED = (
    "- history: 1\n  depth: 1\n  reliability: 1\n  durability: 1\n"
    f"  deadline: {_FOREVER}\n  lifespan: {_FOREVER}\n"
    f"  liveliness: 1\n  liveliness_lease_duration: {_FOREVER}\n"
    "  avoid_ros_namespace_conventions: false\n"
)
"""keep last, reliable, transient local: as rosbag2 stores what a static transform is offered with,
so that a player offers it to those who come later. Numbers: newer versions read them, too."""


class RosBag:
    """Appends messages to ``path``; complete after ``close``. Memory does not grow with the number
    of messages but for the file's index (a kilobyte a second of flight).

    ``types``: message type by topic. ``latched``: topics whose last message stays valid.
    """

    def __init__(
        self,
        path: Path,
        types: Mapping[str, str],
        library: str = "touchdown",
        checksums: bool = True,
        latched: frozenset[str] = frozenset(),
    ) -> None:
        self._types = types
        self._latched = latched
        self._file: BinaryIO = path.open("wb")
        self._writer = Writer(
            self._file,
            chunk_size=_CHUNK_BYTES,
            compression=CompressionType.ZSTD,
            enable_crcs=checksums,
        )
        self._writer.start(profile="ros2", library=library)
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self.counts: Counter[str] = Counter()
        """messages so far, by topic"""

    def note(self, name: str, facts: dict[str, str]) -> None:
        """A metadata record."""
        self._writer.add_metadata(name, facts)

    def put(self, topic: str, log_ns: int, publish_ns: int, data: bytes) -> None:
        if topic not in self._channels:
            self._channels[topic] = self._register(topic)
        self._writer.add_message(
            self._channels[topic],
            log_time=log_ns,
            data=data,
            publish_time=publish_ns,
            sequence=self.counts[topic],
        )
        self.counts[topic] += 1

    def close(self) -> None:
        try:
            self._writer.finish()
        finally:
            self._file.close()

    def _register(self, topic: str) -> int:
        kind = self._types[topic]
        if kind not in self._schemas:
            text = ros.definition(kind).encode()
            self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", text)
        offered = {"offered_qos_profiles": _LATCHED if topic in self._latched else ""}
        return self._writer.register_channel(topic, "cdr", self._schemas[kind], offered)


def tick_ns(tick: int, tick_hz: int) -> int:
    """Nanoseconds since the start, rounded; not negative."""
    return max(0, (2 * tick * 10**9 + tick_hz) // (2 * tick_hz))
