"""Replays: bit-equal, without the simulator, judged on the run's truth, refused in one line."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchdown.experiments.config.schema import Config
from touchdown.experiments.errors import UsageError
from touchdown.experiments.flight.replay import open_run, replay, replay_config, seen_by
from touchdown.experiments.io.run_directory import SENSORS_FILE
from touchdown.experiments.io.sensor_log_reader import SensorLogReader
from touchdown.experiments.io.tum import read_tum
from touchdown.sim.api import Observation, SensorNeeds

from support.command import RunCli, python
from support.replay_support import LIFT_OFF_S, make_run

STILL = '''
from support.flight_fakes import make_estimate
from touchdown.sim.api import SensorNeeds
from touchdown.sim.frames import Pose

class Still:
    """Stays at the take-off pose, {offset} m east of it."""
    needs = SensorNeeds({needs})
    def __init__(self, rig):
        start = rig.world_from_body_start
        self.pose = Pose(start.rotation, start.translation + [{offset}, 0.0, 0.0])
    def update(self, obs):
        return make_estimate(obs.time_s, self.pose)

def build(params, rig):
    return Still(rig)
'''


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("runs") / "flown")


def _still(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, needs: str = "", offset: float = 0.0
) -> str:
    (tmp_path / f"{name}.py").write_text(STILL.format(needs=needs, offset=offset))
    monkeypatch.syspath_prepend(str(tmp_path))
    return f"{name}:build"


def test_replays_are_equal_to_the_byte(run: Path, tmp_path: Path) -> None:
    results = []
    for name in ("one", "two"):
        results.append(replay(run, replay_config(run, "livo"), tmp_path / name).plain())
    assert len({(tmp_path / n / "estimate.tum").read_bytes() for n in ("one", "two")}) == 1
    for result in results:
        result.pop("timing")
    assert results[0] == results[1] and results[0]["position_error_m"]["mean"] < 0.02
    assert results[0]["outcome"] == "COMPLETED" and results[0]["nees"]["samples"] > 0
    assert (tmp_path / "one" / "truth.tum").read_bytes() == (run / "truth.tum").read_bytes()


def test_a_replay_needs_no_simulator(run: Path, tmp_path: Path) -> None:
    script = (
        "import sys\n"
        "for name in ('mujoco', 'open3d', 'OpenGL', 'rerun'): sys.modules[name] = None\n"
        "from touchdown.experiments.cli.main import main\n"
        f"sys.exit(main(['fly', '--replay', {str(run)!r}, '--out', {str(tmp_path / 'out')!r},"
        " '--quiet']))"
    )
    done = python("-c", script)
    assert done.returncode == 0, done.stderr
    assert "judged at 50 Hz" in done.stdout


def test_errors_are_those_of_the_true_path_from_lift_off_on(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = _still(tmp_path, monkeypatch, "still_aside", offset=0.25)
    result = replay(run, replay_config(run, name), tmp_path / "out").plain()
    times, true, _ = read_tum(run / "truth.tum")
    expected = np.linalg.norm(true - true[0] - [0.25, 0.0, 0.0], axis=1)[times >= LIFT_OFF_S]
    assert result["position_error_m"]["mean"] == pytest.approx(expected.mean(), abs=1e-8)
    assert result["position_error_m"]["max"] == pytest.approx(expected.max(), abs=1e-8)
    assert result["judged_hz"] == pytest.approx(50.0)
    assert (result["replay_of"], result["flown_by"]) == (str(run), "livo")
    times_out, positions, _ = read_tum(tmp_path / "out" / "estimate.tum")
    assert np.array_equal(times_out, times) and np.ptp(positions, axis=0).max() == 0.0


def test_who_is_lost_has_failed(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run_cli: RunCli
) -> None:
    name = _still(tmp_path, monkeypatch, "still_far", offset=500.0)
    code, out, _ = run_cli(
        "fly", "--replay", run, "--estimator", name, "--out", tmp_path / "far", "--json",
        "--quiet",
    )  # fmt: skip
    assert code == 1 and json.loads(out)["outcome"] == "DIVERGED"


def test_lift_off_is_found_where_a_run_does_not_state_it(tmp_path: Path) -> None:
    logged = open_run(make_run(tmp_path / "old", span_s=None))
    before = logged.truth[round((logged.from_s - 0.02) * 600)].translation[2]
    there = logged.truth[round(logged.from_s * 600)].translation[2]
    start = logged.truth[0].translation[2]
    assert before <= start + 0.1 < there and logged.to_s == np.inf


def test_an_estimator_sees_what_its_own_flight_would_show(tmp_path: Path) -> None:
    everything = SensorNeeds(camera_hz=15, stereo=True, lidar=True, gps=True, rangefinder=True)
    path = make_run(
        tmp_path / "rich", seconds=0.7, needs=everything, shared=SensorNeeds(lidar=True)
    )
    reader = SensorLogReader(path / SENSORS_FILE)

    def seen(**needs: Any) -> list[Observation]:
        return list(seen_by(SensorNeeds(**needs), reader))

    ticks = [i.tick for o in seen(camera_hz=5) for i in o.images]
    assert ticks == [120, 240, 360]
    assert [i.tick for o in seen(camera_hz=15) for i in o.images][:3] == [40, 80, 120]
    images = [i for o in seen(camera_hz=5, stereo=True) for i in o.images]
    assert all(i.right_rgb is not None for i in images)
    blind = seen(gps=True)
    assert not any(o.images or o.rangefinder for o in blind)
    assert any(o.gps for o in blind) and any(o.scans for o in blind)  # scans are shared
    assert all(i.right_rgb is None for o in seen(camera_hz=5) for i in o.images)
    assert sum(len(o.imu) for o in blind) == 140


def test_a_log_may_lack_what_an_estimator_spares(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = _still(tmp_path, monkeypatch, "sparing", "gps=True")
    for overrides in ((), ("bias.xy_m=[0.5, 0.0]",)):
        with pytest.raises(UsageError, match="lacks what sparing:build needs: gps"):
            replay(run, replay_config(run, name, overrides))
    monkeypatch.setattr("sparing.Still.spare_sensors", ("gps",), raising=False)
    for overrides in ((), ("bias.xy_m=[0.5, 0.0]",)):
        assert replay(run, replay_config(run, name, overrides)).outcome == "COMPLETED"


def test_faults_befall_the_messages_of_a_log(run: Path, tmp_path: Path, run_cli: RunCli) -> None:
    faults = ["--fault", "lidar_dropout@0", "--fault", "camera_black@0*2"]
    code, printed, err = run_cli(
        "fly", "--replay", run, "--out", tmp_path / "out", "--json", "--quiet", *faults
    )
    result = json.loads(printed)
    scans, images = result["faults"]
    assert result["event_count"] == len(result["events"]) > 0
    assert code == 0 and err == ""
    assert scans["messages"] == scans["came"] and scans["came"]["scans"] > 2
    assert images["messages"] == {"images": 2} and images["came"]["images"] > 2
    told = json.loads((tmp_path / "out" / "config.json").read_text())["faults"]["events"]
    assert told == faults[1::2]
    usual = replay(run, replay_config(run), tmp_path / "usual")
    assert usual.faults == []
    found = ((tmp_path / name / "estimate.tum").read_bytes() for name in ("out", "usual"))
    assert len(set(found)) == 2


@pytest.mark.parametrize(("arguments", "words"), [
    (["--estimator", "stereo"], "lacks what stereo needs: stereo"),
    (["--estimator", "gps"], "lacks what gps needs: gps, barometer, magnetometer"),
    (["--set", "livo.camera_hz=30"], "images at 30 Hz (it has 10 Hz)"),
    (["--estimator", "oracle"], "needs a flight"),
    (["--estimator", "livvo"], "did you mean 'livo'"),
    (["--seed", "4"], "--seed does not go with --replay"),
    (["--wind-kmh", "4"], "--wind-kmh does not go with --replay"),
    (["--light", "night"], "--light does not go with --replay"),
    (["--log-sensors"], "--log-sensors does not go with --replay"),
    (["--set", "wind.mean_kmh=3"], "the flight is over"),
    (["--fault", "fog@0"], "fault 'fog@0' acts on what is measured"),
    (["--fault", "lidar_gone@0"], "unknown fault 'lidar_gone'"),
])  # fmt: skip
def test_refusals_are_one_line(
    run: Path, tmp_path: Path, arguments: list[str], words: str, run_cli: RunCli
) -> None:
    out = tmp_path / "out"
    code, printed, err = run_cli("fly", "--replay", run, "--out", out, *arguments)
    assert (code, printed, err.count("\n")) == (2, "", 1) and words in err
    assert not out.exists() and list(tmp_path.iterdir()) == []


def test_wrong_directories_are_one_line(run: Path, tmp_path: Path, run_cli: RunCli) -> None:
    for arguments, words in (
        (["fly", "--replay", tmp_path / "none"], "is no run directory"),
        (["fly", "houses", "--replay", run], "was flown over crossroad, not houses"),
        (["fly", "--replay", run, "--out", run], "is the run that is replayed"),
        (["fly"], "missing argument 'SCENE'"),
    ):
        code, _, err = run_cli(*arguments)
        assert code == 2 and words in err and err.count("\n") == 1, err
    silent = make_run(tmp_path / "silent", seconds=0.3)
    (silent / SENSORS_FILE).unlink()
    with pytest.raises(UsageError, match="--log-sensors"):
        replay(silent, replay_config(silent))
    (silent / "truth.tum").write_text("one two\n")
    with pytest.raises(UsageError):
        open_run(silent)


def test_parameters_of_an_earlier_version_are_left_out_with_a_warning(tmp_path: Path) -> None:
    run = make_run(tmp_path / "old", seconds=0.1)
    tree = json.loads((run / "config.json").read_text())
    tree["livo"] |= {"keyframes": 17, "gone_sigma_m": 0.1}
    (run / "config.json").write_text(json.dumps(tree))
    with pytest.warns(UserWarning, match="gone: livo.gone_sigma_m"):
        assert replay_config(run).livo.keyframes == 17
    assert replay_config(run, fresh=True).livo.keyframes == Config().livo.keyframes
    tree["wind"] |= {"gone_kmh": 1.0}
    (run / "config.json").write_text(json.dumps(tree))
    with pytest.raises(UsageError, match="unknown key"):
        replay_config(run, fresh=True)


@pytest.mark.slow
def test_a_flight_is_repeated_to_the_byte_by_its_own_log(tmp_path: Path, run_cli: RunCli) -> None:
    flown, again = tmp_path / "flown", tmp_path / "again"
    short = ["survey.legs=1", "survey.leg_length_m=6.0", "survey.height_m=8.0"]
    short += ["survey.duration_s=6.0", "sim.threads=1"]
    settings = [word for text in short for word in ("--set", text)]
    code, out, _ = run_cli(
        "fly", "crossroad", "--log-sensors", "--no-record", "--quiet", "--json", *settings,
        "--out", flown,
    )  # fmt: skip
    assert code == 0
    result = json.loads(out)
    size_mb = (flown / SENSORS_FILE).stat().st_size / 1e6
    assert size_mb / result["timing"]["sim_s"] <= 15.0
    code, out, _ = run_cli("fly", "--replay", flown, "--out", again, "--quiet", "--json")
    assert code == 0
    assert (again / "estimate.tum").read_bytes() == (flown / "estimate.tum").read_bytes()
    replayed = json.loads(out)["position_error_m"]["mean"]
    assert replayed == pytest.approx(result["position_error_m"]["mean"], abs=1e-3)
