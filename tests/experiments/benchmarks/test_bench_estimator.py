"""Estimator benchmark: errors on equal logs; reference implementations run as intended."""

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from touchdown.experiments.benchmarks import odometry
from touchdown.experiments.benchmarks.odometry_baselines import (
    ScanPoints,
    deskew_by_step,
    run_reference,
)
from touchdown.experiments.cli import main as cli
from touchdown.experiments.errors import UsageError
from touchdown.experiments.flight.replay import open_run
from touchdown.experiments.io.tum import Trajectory
from touchdown.sim.frames import Pose, rotation_from_yaw, so3_exp

from support.command import Says
from support.replay_support import LIFT_OFF_S, make_run, shifted

Array = np.ndarray[Any, np.dtype[np.float64]]
LIDAR = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.1, 0.0, -0.2]))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("runs") / "flown", estimate=shifted([0.03, 0.0, 0.04]))


def test_an_estimator_is_measured_from_lift_off_to_the_end(run: Path) -> None:
    logged = open_run(run)
    whole = odometry.replayed(logged, "livo: tight, all on")
    assert whole["error_m"] < 0.03 and whole["lost_s"] is None and whole["cpu_ms"] > 0.0
    early = odometry.replayed(logged, "livo: tight, all on", LIFT_OFF_S + 0.05)
    assert early["error_m"] != whole["error_m"]


def _room(lidar: Pose, count: int, rng: np.random.Generator) -> Array:
    """(count, 3) returns from the inside of a box of 24 x 16 x 10 m, LIDAR frame."""
    rays = rng.normal(size=(count, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    half = np.array([12.0, 8.0, 5.0])
    with np.errstate(divide="ignore"):
        walls = (np.sign(rays) * half - lidar.translation) / rays
    points = lidar.translation + walls.min(axis=1)[:, None] * rays
    return lidar.inverse().apply(points)


def _flight(time_s: float) -> Pose:
    return Pose(so3_exp(np.array([0.0, 0.02, 0.1]) * time_s), np.array([1.0, 0.5, 0.1]) * time_s)


def _scans(count: int) -> list[ScanPoints]:
    """Scans distorted by motion: each of 40 slices has its own pose."""
    rng = np.random.default_rng(0)
    scans = []
    for number in range(count):
        start_s = 0.1 * number
        fractions = np.repeat((np.arange(40) + 1.0) / 40.0, 150)
        slices = [
            _room(_flight(start_s + 0.1 * fraction) @ LIDAR, 150, rng)
            for fraction in fractions[::150]
        ]
        points = np.concatenate(slices).astype(np.float32)
        scans.append(ScanPoints(points, fractions.astype(np.float32), start_s, start_s + 0.1))
    return scans


@pytest.mark.parametrize(("method", "setting"), [
    ("kiss_icp", {"voxel_m": 0.5, "initial_threshold_m": 0.5}),
    ("small_gicp", {"downsampling_m": 0.25, "voxel_m": 1.0}),
])  # fmt: skip
def test_references_follow_structured_ground(method: str, setting: dict[str, Any]) -> None:
    """Poses are those of the body at the end of the scan, and start at the truth."""
    pytest.importorskip(method)
    whole = setting | {"deskew": True, "start": "lift-off"}
    track = run_reference(method, whole, _scans(15), _flight, LIDAR, survey_s=0.0)
    true = np.array([_flight(time_s).translation for time_s in track.times_s])
    assert track.times_s == pytest.approx(0.1 * np.arange(1, 16))
    assert track.positions[0] == pytest.approx(true[0], abs=1e-9)
    assert np.linalg.norm(track.positions - true, axis=1).max() < 0.1
    assert track.lost_s is None and track.cpu_s > 0.0
    truth = SimpleNamespace(at=lambda times: (true + [0.0, 3.0, 4.0], None))
    row = odometry._reference_row(track, truth)
    assert row["error_m"] == pytest.approx(5.0, abs=0.1) and row["setting"] == whole


def test_constant_velocity_deskewing_undoes_a_share_of_the_step() -> None:
    """A step of 1 m in x and a quarter of a degree about z, seen at start, middle and end."""
    points = np.tile([10.0, 0.0, 0.0], (3, 1))
    step = np.eye(4)
    step[0, 3] = 1.0
    turned = np.eye(4)
    turned[:3, :3] = rotation_from_yaw(np.radians(0.25))
    fractions = np.array([0.0, 0.5, 1.0])
    assert deskew_by_step(points, fractions, step)[:, 0].tolist() == [9.0, 9.5, 10.0]
    expected = -10.0 * np.radians([0.25, 0.125, 0.0])
    assert deskew_by_step(points, fractions, turned)[:, 1] == pytest.approx(expected, abs=1e-9)


def test_missing_references_are_one_line(monkeypatch: pytest.MonkeyPatch, says: Says) -> None:
    for package in ("kiss_icp", "small_gicp"):
        monkeypatch.setitem(sys.modules, package, None)
    captured = says(2, "bench", "estimator", "crossroad")
    assert captured.out == "" and captured.err.count("\n") == 1
    assert "is not installed; pip install -c constraints.txt -e '.[bench]'" in captured.err
    assert cli.main(["bench", "estimator", "--seconds", "-3"]) == 2


def test_scans_are_those_of_the_judged_span(run: Path) -> None:
    logged = open_run(run)
    scans = odometry.logged_scans(logged, 1.5)
    assert [round(scan.end_s, 6) for scan in scans] == [1.0, 1.1, 1.2, 1.3, 1.4]
    assert all(scan.fractions.min() >= 0.0 and scan.fractions.max() <= 1.0 for scan in scans)
    assert all(np.linalg.norm(scan.points, axis=1).min() > 0.0 for scan in scans)


def test_the_true_path_is_interpolated(run: Path) -> None:
    logged = open_run(run)
    path = Trajectory(logged.path / "truth.tum")
    before, after = (logged.truth[tick].translation for tick in (900, 912))
    assert path.pose(1.51).translation == pytest.approx(0.5 * (before + after), abs=1e-12)
    assert path.pose(1.5).translation == pytest.approx(before, abs=1e-12)
    heights = [pose.translation[2] for pose in logged.truth.values()]
    assert max(heights) - path.pose(odometry._survey_s(path)).translation[2] < 0.5


def test_ratios_are_of_the_best_reference_that_is_not_lost() -> None:
    def scene(livo: float, kiss: float, gicp: float, kiss_lost: float | None) -> dict[str, Any]:
        names = ("livo", "livo_no_camera", "zou2024", "kiss_icp", "small_gicp")
        errors = dict(zip(names, (0.001, livo, 1.0, kiss, gicp), strict=True))
        lost = dict.fromkeys(names) | {"kiss_icp": kiss_lost}
        return {"error_m": errors, "lost_s": lost, "cpu_ms": dict.fromkeys(names, 10.0)}

    found = {"a": scene(0.02, 0.1, 0.3, None), "b": scene(0.01, 0.05, 0.2, 7.0)}
    figures = odometry.summary(found)
    ratios = figures["ratio"]
    assert ratios["a"] == pytest.approx(5.0) and ratios["b"] == pytest.approx(20.0)
    assert ratios["geometric_mean"] == pytest.approx(10.0)
    assert figures["error_m"]["b"]["kiss_icp"] == 0.05 and figures["ms_per_0.1s"]["zou2024"] == 10.0


def test_logs_are_named_by_their_scene_and_where_it_is_named_twice_by_the_seed() -> None:
    assert odometry.logs_of(("lake", "forest"), (4,)) == {
        "lake": ("lake", 4), "forest": ("forest", 4),
    }  # fmt: skip
    assert odometry.logs_of(("lake", "forest", "lake"), (1, 2, 3)) == {
        "lake 1": ("lake", 1), "forest": ("forest", 2), "lake 3": ("lake", 3),
    }  # fmt: skip
    with pytest.raises(UsageError, match="3 seeds for 2 scenes; give one, or one each"):
        odometry.logs_of(("lake", "forest"), (1, 2, 3))


def test_ablation_replays_every_variant(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    variants = {"livo: all on": ("livo", {}), "livo: LIDAR only": ("livo", {"use_vision": False})}
    monkeypatch.setattr(odometry, "VARIANTS", variants)
    rows = odometry.ablate_log(open_run(run), 0.4, lambda _text: None)
    assert 0.0 < rows["livo: all on"]["error_m"] < 0.03
    assert rows["livo: LIDAR only"]["error_m"] != rows["livo: all on"]["error_m"]
    lost = {"error_m": 3.0, "lost_s": 12.4, "cpu_ms": 1.0}
    table = odometry.ablation_table({"here": rows, "there": {**rows, "livo: all on": lost}})
    lines = table.splitlines()
    assert lines[0] == "| variant | here | there |"
    assert lines[2].startswith("| livo: all on | 0.0") and lines[2].endswith("| lost at 12 s |")
    assert lines[3].startswith("| livo: LIDAR only | 0.")


def test_ablation_tells_by_how_much_each_part_lowers_the_error() -> None:
    def rows(whole: float, without: float) -> dict[str, Any]:
        figures = {"lost_s": None, "cpu_ms": 1.0}
        return {
            "zou2024: all on": {"error_m": whole, **figures},
            "zou2024: no f_c": {"error_m": without, **figures},
        }

    found = {"a 1": rows(0.1, 0.12), "a 2": rows(0.2, 0.22), "b 1": rows(0.1, 0.12)}
    lines = odometry.ablation_table(found).splitlines()
    assert lines[0] == "| variant | a 1 | a 2 | b 1 | more error, 95 % |"
    assert lines[2].endswith("| – |") and lines[3].endswith("| +0.020 [+0.020, +0.020] |")
    found["b 1"]["zou2024: no f_c"]["lost_s"] = 3.0
    assert odometry.ablation_table(found).endswith("| lost at 3 s | – |")
    assert odometry.variants(["zou2024: no f_c"]) == ["zou2024: all on", "zou2024: no f_c"]
    assert {v.split(":")[0] for v in odometry.variants(["livo"])} == {"livo"}
    with pytest.raises(UsageError, match="--ablate has no 'flow'; name one of: livo, zou2024, "):
        odometry.variants(["flow"])
