import json
from pathlib import Path
from textwrap import dedent
from typing import Any

import pytest
from click.shell_completion import ShellComplete

from touchdown.experiments.cli import main as cli
from touchdown.experiments.cli.console import print_result
from touchdown.experiments.cli.fly import ESTIMATORS
from touchdown.experiments.config.schema import Config
from touchdown.experiments.flight import wiring
from touchdown.experiments.io.results import RunResult

from support.command import RunCli, lines_of

ROOT = Path(__file__).parents[3]
HEAVY = ("mujoco", "open3d", "cv2", "rerun", "numba", "matplotlib", "scipy", "torch", "ray")


def test_importing_the_command_line_imports_nothing_heavy() -> None:
    names = f"[m for m in {HEAVY!r} if m in sys.modules]"
    script = f"import sys, touchdown.experiments.cli.main; print({names})"
    assert lines_of(script) == ["[]"]


def test_the_program_ends_without_searching_what_is_left() -> None:
    script = """
        import atexit, gc, sys
        atexit.register(lambda: print("frozen:", gc.get_freeze_count() > 0))
        from touchdown.experiments.cli.main import main
        sys.argv = ["touchdown", "--version"]
        main()
    """
    assert lines_of(dedent(script))[-1] == "frozen: True"


@pytest.mark.parametrize(("arguments", "fragments"), [
    (("lnd",), ["unknown command 'lnd'", "did you mean 'land'"]),
    (("scenes",), ["needs a command", "render"]),
    (("land",), ["SCENE", "touchdown land --help"]),
    (("land", "crossroad", "--sed", "1"), ["--sed"]),
    (("land", "crossroad", "--seed", "x"), ["--seed", "integer"]),
    (("land", "crossroad", "--seed", "-4"), ["seed = -4", "within 0 to"]),
    (("land", "crossrod"), ["unknown scene 'crossrod'", "did you mean 'crossroad'"]),
    (("land", "no/such.xml"), ["no/such.xml"]),
    (("land", "crossroad", "--estimator", "lvio"), ["lvio", "did you mean 'livo'", "oracle"]),
    (("land", "crossroad", "--estimator", "no_lab.vio:build"), ["no_lab.vio:build"]),
    (("land", "crossroad", "--wind-kmh", "-3"), ["wind.mean_kmh = -3", "within 0 to 450"]),
    (("fly", "crossroad", "--wind-kmh", "nan"), ["finite"]),
    (("land", "crossroad", "--light", "noon"), ["--light", "day", "overcast", "dusk", "night"]),
    (("fly", "crossroad", "--light", "nigth"), ["--light", "nigth", "night"]),
    (("land", "crossroad", "--site", "3"), ["X,Y"]),
    (("land", "crossroad", "--site", "nan,1"), ["finite"]),
    (("land", "crossroad", "--set", "wind.mean_kph=3"), ["did you mean 'wind.mean_kmh'"]),
    (("land", "crossroad", "--config", "gone.toml"), ["gone.toml", "does not exist"]),
    (("view", "gone"), ["flight.rrd", "does not exist"]),
    (("scenes", "render", "crossrod"), ["did you mean 'crossroad'"]),
    (("scenes", "render", "crossroad", "--out", "a.txt"), [".png"]),
    (("scenes", "render"), ["SCENE", "--all"]),
    (("scenes", "render", "crossroad", "--all"), ["SCENE", "--all"]),
    (("scenes", "check", "crossrod"), ["did you mean 'crossroad'"]),
    (("scenes", "check", "--seeds", "0"), ["--seeds"]),
])  # fmt: skip
def test_invalid_input_is_one_line_and_nothing_is_written(
    arguments: tuple[str, ...], fragments: list[str], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, run_cli: RunCli,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    code, out, err = run_cli(*arguments)
    assert code == 2 and out == ""
    assert err.startswith("touchdown: error: ") and err.count("\n") == 1
    for fragment in fragments:
        assert fragment in err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["land", "fly"])
def test_the_light_of_an_option_is_that_of_the_flight(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lights: list[str] = []

    def flown(config: Config, *_: Any) -> RunResult:
        lights.append(config.light)
        return _result("COMPLETED")

    monkeypatch.setattr("touchdown.experiments.flight.run.fly_with_usage_errors", flown)
    for number, words in enumerate((["--light", "night"], ["--set", "light=dusk"], [])):
        cli.main([command, "flat", *words, "--out", str(tmp_path / str(number)), "--quiet"])
    assert lights == ["night", "dusk", "day"]


def _result(outcome: str, **landing: Any) -> RunResult:
    tree = {
        "outcome": outcome, "reason": "", "scene": "crossroad", "seed": 0, "estimator": "oracle",
        "wind_kmh": 12.0, "landing": landing or None,
        "timing": {"wall_s": 2.0, "sim_s": 4.0, "real_time_factor": 2.0, "stage_ms": {}},
    }  # fmt: skip
    return RunResult.model_validate(tree)


def _changed(result: RunResult, **values: Any) -> RunResult:
    return RunResult.model_validate(result.plain() | values)


@pytest.mark.parametrize(("result", "code"), [
    (_result("LANDED", safe_geometry=True), 0), (_result("LANDED", safe_geometry=False), 1),
    (_result("TIPPED", safe_geometry=True), 1), (_result("NO_SITE"), 1), (_result("GROUNDED"), 1),
    (_result("COMPLETED"), 0),
])  # fmt: skip
def test_exit_code_follows_the_outcome(
    result: RunResult, code: int, monkeypatch: pytest.MonkeyPatch, run_cli: RunCli
) -> None:
    def fly(_config: Any, _out: Path, progress: Any, _live: Any) -> RunResult:
        progress(0.0, "TAKEOFF", "climbing")
        return result

    monkeypatch.setattr("touchdown.experiments.flight.run.fly", fly)
    got, out, err = run_cli("land", "crossroad", "--json")
    assert got == code and json.loads(out)["outcome"] == result.outcome
    assert "TAKEOFF" in err
    got, out, err = run_cli("land", "crossroad", "--quiet")
    assert got == code and result.outcome in out
    assert err == ""


@pytest.mark.parametrize(("options", "code"), [((), 2), (("--force",), 0), (("--log-sensors",), 0)])
def test_a_sensor_log_is_not_replaced_by_a_run_without(
    options: tuple[str, ...], code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    run_cli: RunCli,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("touchdown.experiments.flight.run.fly", lambda *_: _result("COMPLETED"))
    run = tmp_path / "runs" / "crossroad-livo-0-fly"
    run.mkdir(parents=True)
    (run / "sensors.mcap").write_bytes(b"precious")
    got, _, err = run_cli("fly", "crossroad", "--quiet", *options)
    assert got == code and err.count("\n") == (1 if code else 0)
    if code:
        assert "sensors.mcap" in err and "--out" in err and "--force" in err
    assert run_cli("fly", "crossroad", "--quiet", "--out", "elsewhere")[0] == 0


@pytest.mark.parametrize(
    ("kind", "classifier", "remark"),
    [("road", "off", True), ("building", "off", True), ("lawn", "off", False), ("road", "", False)],
)
def test_risky_ground_without_ground_classification_is_remarked_on(
    kind: str, classifier: str, remark: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    result = _result("LANDED", class_true=kind, safe_geometry=True)
    print_result(_changed(result, classifier=classifier), None)
    out = capsys.readouterr().out
    assert "ground class" in out and kind in out
    assert (f"a {kind} is risky ground; ground classification was off" in out) == remark


def test_the_first_three_candidates_and_the_reason_are_printed(
    capsys: pytest.CaptureFixture[str],
) -> None:
    sites = [
        {"rank": rank, "accepted": True, "rule": "lower_value", "reason": "", "value": 1.0 / rank,
         "position_m": [10.0 * rank, -5.0, 0.0], "slope_deg": 0.3, "clearance_m": None,
         "class_predicted": "lawn", "class_probability": 0.97}
        for rank in (1, 2, 3, 4)
    ]  # fmt: skip
    earlier = {"time_s": 61.2, "candidates": 3, "why": "Site 1 won", "given_up": "a wire"}
    choice = {"time_s": 80.0, "selector": "risk",
              "why": "Site 1 won: more clearance (3.0 against 1.2 m)",
              "candidates": sites, "earlier": [earlier]}  # fmt: skip
    print_result(_changed(_result("LANDED"), choice=choice), None)
    out = capsys.readouterr().out
    assert "30.0, -5.0" in out and "40.0, -5.0" not in out
    assert "0.333" in out and "0.3 deg" in out and "lawn 0.97" in out and "lower value" in out
    assert "Site 1 won: more clearance (3.0 against 1.2 m)\n" in out
    assert "before, at 61.2 s: given up: a wire\n" in out


def test_a_lost_estimate_lists_its_events(monkeypatch: pytest.MonkeyPatch, run_cli: RunCli) -> None:
    events = [{"time_s": 1.5 * i, "text": f"scan {i} refused [no returns]"} for i in range(8)]
    lost = _changed(_result("DIVERGED"), estimator="livo", events=events, event_count=8)
    flown = [lost]
    monkeypatch.setattr("touchdown.experiments.flight.run.fly", lambda *_args: flown[-1])
    code, out, _ = run_cli("fly", "crossroad", "--quiet")
    assert code == 1 and "the last of 8 messages of livo:" in out
    assert "  10.5 s  scan 7 refused [no returns]" in out and "scan 2 " not in out
    flown.append(_changed(lost, event_count=900))
    assert "the last of the first 8 of 900 messages" in run_cli("fly", "crossroad")[1]
    flown.append(_changed(lost, outcome="TIPPED"))
    assert "messages of" not in run_cli("fly", "crossroad", "--quiet")[1]


@pytest.mark.parametrize(("words", "wanted"), [
    ("land cro", ["crossroad"]),
    ("fly flat --estimator ", list(ESTIMATORS)),
    ("land flat --selector z", ["zou2024"]),
    ("scenes render sn", ["snow"]),
    ("land ./pla", ["./pla"]),  # a file
])  # fmt: skip
def test_a_shell_completes_scenes_and_parts(words: str, wanted: list[str]) -> None:
    *before, last = words.split(" ")
    completer = ShellComplete(cli.cli, {}, "touchdown", "_TOUCHDOWN_COMPLETE")
    found = completer.get_completions(before, last)
    assert [item.value for item in found] == wanted
    assert {item.type for item in found} == {"file" if "/" in last else "plain"}
    assert ESTIMATORS == wiring.ESTIMATORS
