"""Sensor logs return observations equal to the bit, and other tools read them."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer

from touchdown.experiments.errors import UsageError
from touchdown.experiments.external.synthetic_stream import SyntheticStream, synthetic_rig
from touchdown.experiments.io.ros2_messages import stamp_ns, tick_ns
from touchdown.experiments.io.run_directory import SENSORS_FILE
from touchdown.experiments.io.sensor_log import SensorLog
from touchdown.experiments.io.sensor_log_reader import SensorLogReader
from touchdown.sim.api import CameraImage, LidarScan, Observation, SensorNeeds

from support.messages import make_scan

ALL = SensorNeeds(
    camera_hz=10, stereo=True, lidar=True, gps=True, barometer=True, magnetometer=True,
    rangefinder=True,
)  # fmt: skip
SECONDS = 0.5


def same(first: Any, second: Any) -> bool:
    """Asserts equality to the bit, NaN included, with the same types."""
    if dataclasses.is_dataclass(first):
        names = [field.name for field in dataclasses.fields(first)]
        return type(first) is type(second) and all(
            same(getattr(first, name), getattr(second, name)) for name in names
        )
    if isinstance(first, np.ndarray):
        kinds = (first.dtype, first.shape) == (second.dtype, second.shape)
        return kinds and first.tobytes() == second.tobytes()
    if isinstance(first, tuple):
        return len(first) == len(second) and all(map(same, first, second))
    return type(first) is type(second) and repr(first) == repr(second)


def write_log(path: Path, stream: list[Observation], needs: SensorNeeds = ALL) -> Path:
    log = SensorLog(path, synthetic_rig(), needs, SensorNeeds(lidar=True))
    for obs in stream:
        log.add(obs)
    log.close()
    return path


@pytest.fixture(scope="module")
def stream() -> list[Observation]:
    return list(SyntheticStream(synthetic_rig(), ALL, SECONDS))


@pytest.fixture(scope="module")
def log(stream: list[Observation], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("log") / SENSORS_FILE, stream)


def test_observations_are_read_back_bit_equal_repeatedly(
    log: Path, stream: list[Observation]
) -> None:
    reader = SensorLogReader(log)
    assert same(reader.rig, synthetic_rig()) and reader.sensed == ALL
    assert reader.shared == SensorNeeds(lidar=True)
    for _ in range(2):
        back = list(reader)
        assert len(back) == len(stream)
        assert all(same(one, other) for one, other in zip(back, stream, strict=True))
    assert any(obs.gps for obs in back) and any(obs.rangefinder for obs in back)
    assert any(image.right_rgb is not None for obs in back for image in obs.images)


def test_faulty_messages_are_read_back_unchanged(tmp_path: Path) -> None:
    """The log holds messages as faults changed them."""
    empty = make_scan(120, np.zeros((0, 3)), [])
    bad = LidarScan(
        start_tick=120, end_tick=60, start_time_s=0.2, end_time_s=0.1,
        directions=np.array([[np.nan, 0.0, 1.0], [1e-42, -0.0, 1.0]], np.float32),
        ranges=np.array([np.nan, np.inf], np.float32),
        time_offsets=np.array([0.0, -1.0], np.float32), intensity=np.array([0, 255], np.uint8),
    )  # fmt: skip
    black = CameraImage(tick=60, time_s=0.1, rgb=np.zeros((240, 424, 3), np.uint8))
    beside = dataclasses.replace(black, tick=62, time_s=0.10312345678901234)
    stream = [
        Observation(
            tick=156, time_s=0.26, scans=(empty, bad), images=(black, beside),
            rotor_speed_radps=np.array([0.1, np.nan, 1 / 3, 1e-300]), battery_fraction=0.1 + 0.2,
        ),
        Observation(tick=159, time_s=0.265, rotor_speed_radps=np.zeros(4), battery_fraction=0.3),
    ]  # fmt: skip
    back = list(SensorLogReader(write_log(tmp_path / SENSORS_FILE, stream)))
    assert all(same(one, other) for one, other in zip(back, stream, strict=True))


def test_other_tools_read_the_stamp_of_an_image() -> None:
    """Nanoseconds of the tick where it is exact, else those of the stamp."""
    assert stamp_ns(61, 61 / 600, 600) == tick_ns(61, 600) == 101666667
    assert stamp_ns(62, 0.10312345678901234, 600) == 103123457
    assert stamp_ns(61, 0.1016666662, 600) == 101666666  # rounded once
    assert stamp_ns(0, -0.001, 600) == 0


def test_invalid_files_are_one_clear_line(tmp_path: Path, log: Path) -> None:
    other, text, cut = (tmp_path / f"{name}.mcap" for name in ("other", "text", "cut"))
    with other.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.finish()
    text.write_text("no such thing")
    cut.write_bytes(log.read_bytes()[: log.stat().st_size // 2])
    for path, words in (
        (tmp_path / "none.mcap", "--log-sensors"), (other, "no sensor log"),
        (text, "no complete MCAP file"), (cut, "no complete MCAP file"),
    ):  # fmt: skip
        with pytest.raises(UsageError, match=words):
            list(SensorLogReader(path))


def test_memory_is_bounded_by_writing_as_it_goes(tmp_path: Path, stream: list[Observation]) -> None:
    path = tmp_path / SENSORS_FILE
    log = SensorLog(path, synthetic_rig(), ALL)
    for _ in range(8):
        for obs in stream:
            log.add(obs)
    written = path.stat().st_size
    log.close()
    assert written > 0.5 * path.stat().st_size
