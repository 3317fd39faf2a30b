"""Sensor logs and trajectories that are damaged in every way, from a seed."""

from __future__ import annotations

import json
import shutil
import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from touchdown.experiments.io import ros2_messages as ros
from touchdown.experiments.io.sensor_log import IMAGE_TOPICS, OBSERVATION_TOPIC, SCAN_TOPIC

Rng = np.random.Generator
_NUMBERS = (float("nan"), float("inf"), -1, 0, 1e300, -(2**63), 10**30, "x", None, [], {}, True)


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


# ------------------------------------------------------------------------------------------- bytes


def truncated(rng: Rng, data: bytearray) -> bytes:
    return bytes(data[: rng.integers(len(data))])


def flipped(rng: Rng, data: bytearray) -> bytes:
    for at in rng.integers(len(data), size=int(rng.integers(1, 65))):
        data[at] ^= int(rng.integers(1, 256))
    return bytes(data)


def zeroed(rng: Rng, data: bytearray) -> bytes:
    at = int(rng.integers(len(data)))
    size = int(rng.integers(1, 5000))
    data[at : at + size] = bytes(len(data[at : at + size]))
    return bytes(data)


def repeated(rng: Rng, data: bytearray) -> bytes:
    one, two = sorted(rng.integers(len(data), size=2))
    return bytes(data[:two] + data[one:])


def empty(rng: Rng, _data: bytearray) -> bytes:
    return [b"", b"\x89MCAP0\r\n", b"\x89MCAP0\r\n" * 2, rng.bytes(3000)][int(rng.integers(4))]


def huge_lengths(rng: Rng, data: bytearray) -> bytes:
    """A record, or the content of a chunk, says that it is larger than any memory."""
    places, at = [], 8
    while at + 9 <= len(data) - 8:
        places.append((data[at], at))
        at += 9 + struct.unpack_from("<Q", data, at + 1)[0]
    size = int(rng.choice([2**31, 2**33, 2**40, 2**62]))
    chunks = [place for kind, place in places if kind == 0x06]
    if rng.random() < 0.5 and chunks:
        struct.pack_into("<Q", data, int(rng.choice(chunks)) + 9 + 16, size)
    else:
        struct.pack_into("<Q", data, places[int(rng.integers(len(places)))][1] + 1, size)
    return bytes(data)


def wrong_checksum(rng: Rng, data: bytearray) -> bytes:
    at = 8
    while data[at] != 0x06:
        at += 9 + struct.unpack_from("<Q", data, at + 1)[0]
    struct.pack_into("<I", data, at + 9 + 24, int(rng.integers(1, 2**32)))
    return bytes(data)


# ---------------------------------------------------------------------------------------- messages


def missing_topic(rng: Rng, log: Log) -> None:
    topics = sorted({entry.topic for entry in log.entries})
    gone = topics[int(rng.integers(len(topics)))] if rng.random() < 0.4 else SCAN_TOPIC
    gone = str(rng.choice([gone, OBSERVATION_TOPIC, IMAGE_TOPICS[0]]))
    log.entries = [entry for entry in log.entries if entry.topic != gone]


def unordered(rng: Rng, log: Log) -> None:
    if rng.random() < 0.3:
        log.entries.reverse()
        return
    for _ in range(int(rng.integers(1, 400))):
        one, two = rng.integers(len(log.entries), size=2)
        log.entries[one], log.entries[two] = log.entries[two], log.entries[one]


def duplicated(rng: Rng, log: Log) -> None:
    log.entries = [e for e in log.entries for _ in range(1 + int(rng.random() < 0.1))]


def other_types(rng: Rng, log: Log) -> None:
    """Messages hold the content of others."""
    for _ in range(5):
        one, two = rng.integers(len(log.entries), size=2)
        swapped = replace(log.entries[one], data=log.entries[two].data)
        log.entries[one] = swapped
    schemas = sorted({entry.schema for entry in log.entries})
    other = schemas[int(rng.integers(len(schemas)))]
    log.entries = [replace(e, schema=other) if rng.random() < 0.01 else e for e in log.entries]


def short_messages(rng: Rng, log: Log) -> None:
    for at in rng.integers(len(log.entries), size=5):
        entry = log.entries[at]
        log.entries[at] = replace(entry, data=entry.data[: rng.integers(len(entry.data) + 1)])


def wrong_observations(rng: Rng, log: Log) -> None:
    """Numbers, keys and structure of some observations are not what they were."""
    places = [i for i, entry in enumerate(log.entries) if entry.topic == OBSERVATION_TOPIC]
    for at in rng.choice(places, size=3):
        message = ros.deserialized(log.entries[at].data, "std_msgs/msg/String")
        plain = json.loads(message.data)
        spoil(rng, plain)
        text = json.dumps(plain) if rng.random() < 0.9 else "[" * 100_000
        data = bytes(ros.serialized(ros.text_message(text)))
        log.entries[at] = replace(log.entries[at], data=data)


def wrong_metadata(rng: Rng, log: Log) -> None:
    key = str(rng.choice(["rig", "rig", "sensed", "shared", "format"]))
    if rng.random() < 0.2 or key == "format":
        log.metadata[key] = str(rng.choice(["", "null", "[]", "{", "2", "[" * 5000, "1e999"]))
        return
    plain = json.loads(log.metadata[key])
    spoil(rng, plain)
    log.metadata[key] = json.dumps(plain)


def wrong_images(rng: Rng, log: Log) -> None:
    small, grey = np.zeros((3, 4, 3), np.uint8), np.zeros((48, 64), np.uint8)
    files = [cv2.imencode(".png", image)[1] for image in (small, grey)]
    large = files[0].copy()
    large[16:24] = np.frombuffer(struct.pack(">II", 60000, 60000), np.uint8)
    files += [large, np.zeros(0, np.uint8), np.frombuffer(rng.bytes(100), np.uint8)]
    chosen = files[int(rng.integers(len(files)))]
    data = bytes(ros.serialized(ros.compressed_image_message(0, "camera", chosen)))
    places = [i for i, entry in enumerate(log.entries) if entry.topic == IMAGE_TOPICS[0]]
    log.entries[rng.choice(places)] = replace(log.entries[rng.choice(places)], data=data)


def wrong_scans(rng: Rng, log: Log) -> None:
    places = [i for i, entry in enumerate(log.entries) if entry.topic == SCAN_TOPIC]
    for at in rng.choice(places, size=2):
        message = ros.deserialized(log.entries[at].data, "std_msgs/msg/UInt8MultiArray")
        data = bytearray(message.data.tobytes())
        if rng.random() < 0.5:
            struct.pack_into("<I", data, 0, int(rng.choice([0, 1, 2**31, 2**32 - 1])))
        else:
            nan = np.full(len(data) // 8, rng.choice([np.nan, np.inf, 1e30]), "<f4").tobytes()
            data[4 : 4 + len(nan)] = nan
        packed = bytes(ros.serialized(ros.bytes_message(bytes(data))))
        log.entries[at] = replace(log.entries[at], data=packed)


def spoil(rng: Rng, plain: Any) -> None:
    """Changes, removes or adds one value somewhere in ``plain``."""
    while True:
        keys = list(plain) if isinstance(plain, dict) else list(range(len(plain)))
        if not keys:
            return
        key = keys[int(rng.integers(len(keys)))]
        if isinstance(plain[key], dict | list) and plain[key] and rng.random() < 0.8:
            plain = plain[key]
            continue
        if rng.random() < 0.2:
            del plain[key]
        else:
            plain[key] = _NUMBERS[int(rng.integers(len(_NUMBERS)))]
        return


# ------------------------------------------------------------------------------------ trajectories


def wrong_trajectory(rng: Rng, text: str) -> bytes:
    """A TUM file with NaN, infinities, disorder, garbage."""
    lines = text.splitlines()
    kind, at = int(rng.integers(12)), int(rng.integers(len(lines)))
    words = lines[at].split()
    place = int(rng.integers(8))
    if kind <= 3:
        words[place] = ("nan", "inf", "-1e308", "x")[kind]
        lines[at] = " ".join(words)
    elif kind == 4:
        lines = [line.rpartition(" ")[0] for line in lines]
    elif kind == 5:
        rng.shuffle(lines)
    elif kind == 6:
        return [b"", b"\n \n", b"# nothing\n", rng.bytes(500), b"0"][int(rng.integers(5))]
    elif kind == 7:
        lines = ["nan nan nan nan nan nan nan nan" for _ in lines]
    elif kind == 8:
        lines = [" ".join([*line.split()[:4], "0", "0", "0", "0"]) for line in lines]
    elif kind == 9:
        lines = [line for line in lines for _ in range(2)]
    elif kind == 10:
        lines = lines[:1]
    else:
        lines[at] = "9" * 5000 + lines[at]
    return ("\n".join(lines) + "\n").encode()


BYTES: tuple[Callable[[Rng, bytearray], bytes], ...] = (
    truncated, flipped, zeroed, repeated, empty, huge_lengths, wrong_checksum,
)  # fmt: skip
MESSAGES: tuple[Callable[[Rng, Log], None], ...] = (
    missing_topic, unordered, duplicated, other_types, short_messages, wrong_observations,
    wrong_metadata, wrong_images, wrong_scans,
)  # fmt: skip
KINDS = (*(one.__name__ for one in (*BYTES, *MESSAGES)), "trajectories")


def damage(run: Path, out: Path, kind: str, seed: int) -> None:
    """Copies the run directory ``run`` to ``out``, damaged."""
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    shutil.copytree(run, out)
    log = out / "sensors.mcap"
    by_name = {one.__name__: one for one in (*BYTES, *MESSAGES)}
    if kind == "trajectories":
        for name in ("truth", "estimate") if rng.random() < 0.5 else ("truth",):
            file = out / f"{name}.tum"
            file.write_bytes(wrong_trajectory(rng, file.read_text()))
    elif by_name[kind] in BYTES:
        log.write_bytes(by_name[kind](rng, bytearray(log.read_bytes())))  # type: ignore[arg-type]
    else:
        content = read_log(log)
        by_name[kind](rng, content)  # type: ignore[arg-type]
        write_log(log, content)
