"""``touchdown bench imu``: reading recordings, and levels beside those of the model."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from touchdown.experiments.benchmarks import imu_spectra
from touchdown.experiments.benchmarks.imu_spectra import (
    RECORDED_HZ,
    band_rms,
    read_recordings,
    recorded_vibration,
)
from touchdown.experiments.errors import UsageError

HEADER = "time,Euler_X,Euler_Y,Euler_Z,Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z"


def write(folder: Path, samples: NDArray[np.float64], header: str = HEADER) -> None:
    """(N, 6) rad/s and m/s^2 as a recording of the steady flight."""
    time = np.arange(len(samples)) / RECORDED_HZ
    turn, force = np.degrees(samples[:, :3]), samples[:, 3:]
    table = np.column_stack([time, np.zeros((len(samples), 3)), force, turn])
    path = folder / "StraightLine" / "path_2"
    path.mkdir(parents=True)
    np.savetxt(path / "IMU_1.csv", table, delimiter=",", header=header, comments="")


def test_power_is_counted_in_its_band() -> None:
    time = np.arange(4000) / RECORDED_HZ
    tone = np.sqrt(2.0) * np.sin(2.0 * np.pi * 35.0 * time)
    found = band_rms(np.tile(tone[:, None], (1, 6)), RECORDED_HZ)
    np.testing.assert_allclose(found[:, 2], 1.0, rtol=0.02)
    assert found[:, [0, 1, 3, 4]].max() < 0.02


def test_columns_and_units_of_a_recording(tmp_path: Path) -> None:
    samples = np.random.default_rng(0).standard_normal((300, 6))
    write(tmp_path, samples)
    found = read_recordings(tmp_path)["StraightLine/path_2/IMU_1"]
    np.testing.assert_allclose(found[:, 1:], samples, atol=1e-9)
    np.testing.assert_allclose(found[:, 0], np.arange(300) / RECORDED_HZ, atol=1e-9)


@pytest.mark.parametrize(("count", "header", "text"), [
    (300, HEADER.replace("Gyr_Y", "Gyro"), "is no recording: .*Gyr_Y"),
    (20, HEADER, "has 20 samples; a spectrum needs 256"),
])  # fmt: skip
def test_unusable_recordings_are_named(tmp_path: Path, count: int, header: str, text: str) -> None:
    write(tmp_path, np.zeros((count, 6)), header)
    with pytest.raises(UsageError, match=text):
        read_recordings(tmp_path)


def test_a_recording_that_was_cut_short_is_named(tmp_path: Path) -> None:
    write(tmp_path, np.zeros((300, 6)))
    (file,) = tmp_path.glob("*/*/IMU_1.csv")
    file.write_bytes(file.read_bytes()[:-60])
    with pytest.raises(UsageError, match="a number is missing"):
        read_recordings(tmp_path)


def test_recorded_and_simulated_levels_stand_side_by_side(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Recordings that the model made have its levels."""
    monkeypatch.setattr(imu_spectra, "_SECONDS", 40.0)
    write(tmp_path, recorded_vibration(seconds=60.0, seed=9))
    found = imu_spectra.measure(tmp_path)
    np.testing.assert_allclose(found["simulated"], found["recorded"], rtol=0.25)
    assert len(imu_spectra.rows(found)) == 1 + len(imu_spectra.AXES)
