"""Sensor logs that claim less than they inflate to, or more than a flight has."""

import contextlib
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk, Header

from touchdown.experiments.errors import UsageError
from touchdown.experiments.io import sensor_log_reader
from touchdown.experiments.io.sensor_log_reader import DamagedError, SensorLogReader, unpack_image
from touchdown.sim.api import SensorNeeds

from support.hostile_files import png
from support.replay_support import make_run
from support.sensor_logs import Entry, read_log, write_log

MAGIC = b"\x89MCAP0\r\n"
BOMB = 1 << 25


def _log(path: Path, data: bytes, size: int, compression: str = "zstd") -> Path:
    """A log of one chunk that states to inflate to ``size`` bytes."""
    builder = RecordBuilder()
    Header(profile="ros2", library="x").write(builder)
    Chunk(
        compression=compression, data=data, message_end_time=0, message_start_time=0,
        uncompressed_crc=0, uncompressed_size=size,
    ).write(builder)  # fmt: skip
    path.write_bytes(MAGIC + builder.end())
    return path


@pytest.mark.parametrize(("size", "compression", "message"), [
    (100, "zstd", "does not inflate to the size that it states"),
    (6 << 30, "zstd", "a chunk of 6144 MiB, more than 128 MiB"),
    (100, "lz4", "is compressed by 'lz4'"),
])  # fmt: skip
def test_chunks_are_inflated_within_limits(
    tmp_path: Path, size: int, compression: str, message: str
) -> None:
    log = _log(tmp_path / "a.mcap", zstandard.compress(bytes(BOMB)), size, compression)
    with pytest.raises(UsageError, match=f"is no complete MCAP file: .*{message}") as caught:
        SensorLogReader(log)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("png", "message"), [
    (png(8, 8, inflated=BOMB), ""),
    (png(8, 8, inflated=200, text=bytes(1 << 20)), ""),
    (png(9000, 9000), "has more than 67108864 pixels"),
    (png(2**31 - 1, 2**31 - 1), "has more than 67108864 pixels"),
    (png(8, 8, data=bytes(175) + b"\5"), "cannot be decoded"),
    (png(8, 8, methods=(0, 1, 0)), "cannot be decoded"),
    (png(8, 8, inflated=200)[:-30], "cannot be decoded"),
    (b"GIF", "cannot be decoded"),
])  # fmt: skip
def test_no_more_of_an_image_is_inflated_than_its_pixels_need(png: bytes, message: str) -> None:
    tracemalloc.start()
    with pytest.raises(DamagedError, match=message) if message else contextlib.nullcontext():
        assert unpack_image(np.frombuffer(png, np.uint8)).shape == (8, 8, 3)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 23


def test_a_record_that_states_too_much_is_not_read(tmp_path: Path) -> None:
    path = _log(tmp_path / "a.mcap", b"", 0, "")
    path.write_bytes(path.read_bytes() + b"\x05" + (1 << 30).to_bytes(8, "little"))
    with pytest.raises(UsageError, match=r"is no complete MCAP file: .*limit"):
        SensorLogReader(path)


def test_messages_without_their_observation_are_not_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_run(tmp_path / "run", seconds=0.3, needs=SensorNeeds(lidar=True, gps=True))
    path = run / "sensors.mcap"
    sound = read_log(path)
    scans = [entry for entry in sound.entries if entry.topic == sensor_log_reader.SCAN_TOPIC]
    assert scans and list(SensorLogReader(path))

    def refused(message: str, *added: Entry) -> None:
        sound.entries[:0] = added
        write_log(path, sound)
        del sound.entries[: len(added)]
        with pytest.raises(UsageError, match=message):
            list(SensorLogReader(path))

    refused("a message belongs to no observation", scans[0])
    monkeypatch.setattr(sensor_log_reader, "MAX_OBSERVATION_BYTES", 3 * len(scans[0].data))
    refused("an observation has more than", *[scans[0]] * 4)
    monkeypatch.setattr(sensor_log_reader, "MAX_TEXT_BYTES", 10)
    refused("an observation has an absurd size")
