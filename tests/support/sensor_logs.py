"""Sensor logs as lists of messages that may be changed."""

from dataclasses import dataclass
from pathlib import Path

from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap.writer import Writer


@dataclass(frozen=True, slots=True)
class Entry:
    """A message of a log."""

    topic: str
    schema: str
    definition: bytes
    time: int
    data: bytes


@dataclass(slots=True)
class Log:
    metadata: dict[str, str]
    entries: list[Entry]


def read_log(path: Path) -> Log:
    with path.open("rb") as file:
        metadata = next(r.metadata for r in StreamReader(file).records if hasattr(r, "metadata")
                        and getattr(r, "name", "") == "touchdown")  # fmt: skip
    with path.open("rb") as file:
        entries = [
            Entry(channel.topic, schema.name if schema else "", schema.data if schema else b"",
                  message.log_time, message.data)
            for schema, channel, message in make_reader(file).iter_messages(log_time_order=False)
        ]  # fmt: skip
    return Log(metadata, entries)


def write_log(path: Path, log: Log) -> None:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="damaged")
        writer.add_metadata("touchdown", log.metadata)
        channels: dict[tuple[str, str], int] = {}
        for entry in log.entries:
            key = (entry.topic, entry.schema)
            if key not in channels:
                schema = writer.register_schema(entry.schema, "ros2msg", entry.definition)
                channels[key] = writer.register_channel(entry.topic, "cdr", schema)
            time = max(0, entry.time)
            writer.add_message(channels[key], log_time=time, data=entry.data, publish_time=time)
        writer.finish()
