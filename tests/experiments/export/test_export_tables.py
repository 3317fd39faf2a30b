import json
from pathlib import Path

import numpy as np
import pytest

from touchdown.experiments.errors import UsageError
from touchdown.experiments.export.flown_run import ExportOptions, FlownRun
from touchdown.experiments.export.run import export
from touchdown.experiments.io.tum import read_tum

from support.export_support import OFFSET, read_bag
from support.replay_support import LIFT_OFF_S


def test_a_flight_that_never_took_off_has_no_judged_rows() -> None:
    grounded = FlownRun(Path("r"), {"span_s": [None, 21.2]})
    with pytest.raises(UsageError, match=r"'r' never took off.*leave out --judged"):
        grounded.wanted_s(True)
    assert grounded.wanted_s(False) == FlownRun(Path("r"), {}).span_s() == (-np.inf, np.inf)
    assert grounded.span_s()[0] == np.inf, "no row of a table is judged"


def test_trajectories_are_exported_whole_or_for_the_judged_span(run: Path, tmp_path: Path) -> None:
    whole = export(run, "tum", tmp_path / "t.tum", ExportOptions(poses="truth")).out
    assert whole.read_bytes() == (run / "truth.tum").read_bytes()
    judged = export(run, "tum", tmp_path / "e.tum", ExportOptions(judged=True)).out
    times, positions, _ = read_tum(judged)
    all_times, all_positions, _ = read_tum(run / "estimate.tum")
    keep = all_times >= LIFT_OFF_S
    assert np.array_equal(times, all_times[keep]) and np.array_equal(positions, all_positions[keep])


def test_the_table_by_hand(run: Path, tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    table = pandas.read_csv(export(run, "csv", tmp_path / "t.csv", ExportOptions()).out)
    times, positions, quats = read_tum(run / "truth.tum")
    assert np.array_equal(table.time_s, times)
    assert np.array_equal(table[["truth_x_m", "truth_y_m", "truth_z_m"]], positions)
    assert np.allclose(table[[f"truth_q{axis}" for axis in "wxyz"]], quats, atol=1e-9)
    assert np.allclose(table.truth_yaw_deg, np.degrees(0.3), atol=1e-6)
    assert np.allclose(table[["error_x_m", "error_y_m", "error_z_m"]], OFFSET, atol=2e-9)
    assert np.allclose(table.error_yaw_deg, 0.0, atol=1e-6) and table.judged.dtype == bool
    assert np.array_equal(table.judged, times >= LIFT_OFF_S)
    assert np.array_equal(table.phase, np.where(times < 0.7, "INIT", "TAKEOFF"))
    assert table.reference_x_m.isna().all() and table.deviation_m.isna().all()


def test_rows_meet_by_time_and_gaps_stay_empty(run: Path, tmp_path: Path) -> None:
    """As in an interrupted replay and in a run of an earlier version."""
    pandas = pytest.importorskip("pandas")
    short = tmp_path / "short"
    short.mkdir()
    (short / "truth.tum").write_bytes((run / "truth.tum").read_bytes())
    flown = json.loads((run / "result.json").read_text())
    facts = {key: flown.get(key) for key in ("scene", "seed")}
    (short / "result.json").write_text(json.dumps(facts | {"replay_of": str(run)}))
    rows = (run / "estimate.tum").read_text().splitlines(keepends=True)
    (short / "estimate.tum").write_text("".join(rows[5:20]))
    (short / "reference.tum").write_bytes((run / "truth.tum").read_bytes())
    table = pandas.read_csv(export(short, "csv", tmp_path / "t.csv", ExportOptions()).out)
    known = table.estimate_x_m.notna()
    assert known.tolist() == [5 <= number < 20 for number in range(len(table))]
    assert np.allclose(table.error_m[known], 0.5) and table.error_m[~known].isna().all()
    assert np.allclose(table.deviation_m, 0.0) and table.phase.isna().all()
    # and its bag holds the sensors of the flight, with the trajectory of the replay
    found = read_bag(export(short, "mcap", tmp_path / "bag", ExportOptions(images="none")).out)
    assert len(found["/odom"]) == 15 and len(found["/ground_truth/odom"]) == len(table)
    assert len(found["/tf"]) == len(table) and len(found["/lidar/points"]) > 5
