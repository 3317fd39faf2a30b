"""``touchdown gap``: reading recordings, and their figures beside those of the simulator."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from touchdown.experiments.errors import UsageError
from touchdown.experiments.gap import motion, page, world
from touchdown.experiments.gap.card import Curves, Row, compared, spread
from touchdown.experiments.gap.page import table, write_card
from touchdown.experiments.gap.vibration import (
    RECORDED_HZ,
    band_rms,
    read_recordings,
    recorded_vibration,
)

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


def test_a_distance_is_that_of_the_medians_and_a_bound_that_of_the_recordings() -> None:
    """Recordings at -1, 0, 0, 1: each lies 0, 0, 1 or 1 from the median of the others."""
    recorded = np.array([[-1.0], [0.0], [0.0], [1.0]]) * np.ones(3)
    assert spread(recorded) == pytest.approx(0.5)
    row = Row(name="one", x="", y="", source="", tuned=False, changed="", measure=lambda _: None)
    near = compared(row, Curves(np.arange(3.0), recorded, np.full((2, 3), 0.4)))
    assert near.distance == pytest.approx(0.4) and near.holds
    far = compared(row, Curves(np.arange(3.0), recorded, np.full((1, 3), -0.6)))
    assert far.distance == pytest.approx(0.6) and not far.holds
    named = replace(row, bound=0.7, explained="a reason", name="two")
    held = compared(named, Curves(np.arange(3.0), recorded, np.full((1, 3), -0.6)))
    text = table([near, far, held], ["three"])
    assert "| **no** |" in text and "a reason" not in text and "No recordings for: three" in text
    missed = compared(replace(named, bound=0.1), held.curves)
    assert "- **two**: a reason" in table([missed], [])


def test_recordings_that_the_model_made_have_its_vibration(tmp_path: Path) -> None:
    write(tmp_path / "flight", recorded_vibration(seconds=60.0, seed=9))
    curves = motion.vibration(tmp_path)
    assert curves is not None and curves.recorded.shape == (1, 30)
    np.testing.assert_allclose(np.median(curves.simulated, axis=0), curves.recorded[0], atol=0.1)
    assert motion.vibration(tmp_path / "flight") is None


def test_the_allan_deviation_of_white_noise_falls_with_the_root_of_time() -> None:
    noise = np.random.default_rng(3).standard_normal((60_000, 2)) * [1.0, 3.0]
    found = motion.allan_deviation(noise, 200.0, np.array([0.005, 0.05, 0.5]))
    expected = np.array([[1.0], [3.0]]) / np.sqrt([1.0, 10.0, 100.0])
    np.testing.assert_allclose(found, expected, rtol=0.1)


def test_a_sensor_at_rest_is_found_before_its_motors_start(tmp_path: Path) -> None:
    """White noise of the sheet's density, then ten times as much."""
    folder = tmp_path / "set" / "mav0" / "imu0"
    folder.mkdir(parents=True)
    noise = np.random.default_rng(1).standard_normal((400, 6)) * np.sqrt(200.0)
    noise *= [1e-3] * 3 + [1e-2] * 3
    noise[60:] *= 10.0
    times = np.arange(400) * 5_000_000
    np.savetxt(
        folder / "data.csv", np.column_stack([times, noise + 1.0]), delimiter=",", fmt="%.9g"
    )
    (folder / "sensor.yaml").write_text(
        "%YAML:1.0\nrate_hz: 200\ngyroscope_noise_density: 1e-3\ngyroscope_random_walk: 0.0\n"
        "accelerometer_noise_density: 1e-2\naccelerometer_random_walk: 0.0\n"
    )
    curves = motion.at_rest(tmp_path)
    assert curves is not None and curves.recorded.shape == (3, 12)
    first = np.median(curves.recorded, axis=0)[[0, 6]]
    np.testing.assert_allclose(first, np.log10(np.sqrt(200.0) * np.array([1e-3, 1e-2])), atol=0.1)
    np.testing.assert_allclose(np.median(curves.simulated, axis=0)[[0, 6]], first, atol=0.15)


def test_a_wave_is_in_the_band_of_its_length() -> None:
    x = np.arange(96.0)
    wave = np.tile(2.0 * np.sin(2.0 * np.pi * x / 12.0), (96, 1)) + 0.5 * x
    periods = np.array([3.0, 6.0, 10.0, 15.0, 40.0])
    found = 10.0 ** world.radial_spectrum(wave, 1.0, periods)
    assert found[2] == pytest.approx(2.0, rel=0.15)  # half the square of the amplitude
    assert found[[0, 1, 3]].max() < 0.02
    share = 10.0 ** world.radial_spectrum(wave, 1.0, periods, relative=True)
    assert share[2] == pytest.approx(1.0, rel=0.15)


def test_a_folder_without_recordings_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="holds no recordings"):
        write_card(tmp_path, tmp_path / "out", lambda _: None)
    assert not (tmp_path / "out").exists()


def test_a_card_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    curves = Curves(np.arange(3.0), np.zeros((1, 3)), np.ones((1, 3)))
    base = Row(name="one", x="", y="y", source="", tuned=True, changed="it", bound=2.0,
               measure=lambda _: curves)  # fmt: skip
    monkeypatch.setattr(page, "ROWS", (base, replace(base, name="two", bound=0.5)))
    found = write_card(tmp_path, tmp_path / "out", lambda _: None)
    assert [one["holds"] for one in found["rows"]] == [True, False]
    assert "tuned on: it" in (tmp_path / "out" / "gap.md").read_text()
    assert (tmp_path / "out" / "gap.png").stat().st_size > 10_000
