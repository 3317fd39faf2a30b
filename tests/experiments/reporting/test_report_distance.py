from pathlib import Path

import numpy as np
import pytest

from touchdown.experiments.reporting.flights import frame_of, load_flights
from touchdown.experiments.reporting.report_tables import accuracy_tables
from touchdown.experiments.reporting.trajectories import add_trajectory_columns, error_by_distance

from support.report_support import TIMES_S, write_run, write_tum


def drift(run: Path, per_metre: float) -> None:
    """After a climb of 2 m, along x at 8 m/s; the estimate errs by a share of the way."""
    truth = np.zeros((len(TIMES_S), 3))
    truth[1:, 2] = 2.0
    truth[1:, 0] = 8.0 * (TIMES_S[1:] - TIMES_S[1])
    estimate = truth.copy()
    estimate[1:, 1] = per_metre * truth[1:, 0]
    write_tum(run / "truth.tum", truth)
    write_tum(run / "estimate.tum", estimate)


def test_a_drift_shows_as_growth(tmp_path: Path) -> None:
    for seed in (0, 1, 2):
        drift(write_run(tmp_path, "lake", "livo", seed), 0.01)
        drift(write_run(tmp_path, "lake", "gps", seed), 0.0)
    found = error_by_distance(tmp_path / "lake-livo-s1")
    # the middles of 0 to 50 m and so on; 158 m are less than nine tenths of the last bin
    assert found == pytest.approx({"0-50": 0.248, "50-100": 0.748, "100-150": 1.248}, abs=0.005)
    rows = load_flights(tmp_path)
    add_trajectory_columns(rows)
    _, table = accuracy_tables(frame_of(rows))
    assert table.header == ["method", "0-50 m", "50-100 m", "100-150 m"]
    for method, error in (("livo", 1.248), ("gps", 0.0)):
        figure = table.numbers[method]["error_by_distance.100-150"]
        assert figure["value"] == pytest.approx(error, abs=0.005)


def test_without_trajectories_there_is_no_table(tmp_path: Path) -> None:
    assert error_by_distance(tmp_path) == {}
    write_run(tmp_path, "lake", "livo", 0)  # 48 m: one bin shows no growth
    rows = load_flights(tmp_path)
    add_trajectory_columns(rows)
    assert [table.key for table in accuracy_tables(frame_of(rows))] == ["table2"]
