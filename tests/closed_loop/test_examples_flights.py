"""Examples that fly from Python."""

import subprocess
import sys
from pathlib import Path

import pytest

from touchdown.experiments.config.loading import load_config
from touchdown.experiments.flight.run import fly

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.mark.slow
def test_the_odometry_flies_and_its_covariance_tells_its_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("small_gicp")
    monkeypatch.syspath_prepend(str(EXAMPLES))
    config = load_config(
        None, ["preset=short", "sim.threads=1", "landing.survey_only=true"],
        scene="crossroad", estimator="gicp_odometry:build",
    )  # fmt: skip
    result = fly(config, None)
    assert result.outcome == "COMPLETED", result.reason
    assert result.position_error_m.mean < 0.6 and result.nees.mean < 14.2


@pytest.mark.slow
def test_flights_are_compared_and_not_flown_twice(tmp_path: Path) -> None:
    command = [
        sys.executable, str(EXAMPLES / "hundred_flights.py"),
        "--flights", "2", "--jobs", "1", "--out", str(tmp_path),
    ]  # fmt: skip
    first = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert "livo: 0.0" in first and "gps: 1." in first and "2 of 2" in first
    assert (tmp_path / "errors.png").stat().st_size > 5_000
    flown = [(tmp_path / name / "result.json").stat().st_mtime for name in ("livo-0", "gps-0")]
    assert subprocess.run(command, capture_output=True, text=True, check=True).returncode == 0
    again = [(tmp_path / name / "result.json").stat().st_mtime for name in ("livo-0", "gps-0")]
    assert flown == again
