"""The examples that are files of their own run as their page says."""

import importlib
import importlib.util
import sys
import tomllib
from pathlib import Path
from types import ModuleType

import pytest

import touchdown
from touchdown.experiments.external.conformance import check_estimator

ROOT = Path(__file__).parents[2]


def example(name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, name, module)
    spec.loader.exec_module(module)
    return module


def test_the_odometry_keeps_the_contract(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("small_gicp")
    assert touchdown.check_estimator(example("gicp_odometry", monkeypatch).build) == []


@pytest.mark.parametrize("name", ["rko_lio_odometry", "evalio_odometry"])
def test_the_odometries_of_others_keep_the_contract(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip(name.partition("_odometry")[0])
    monkeypatch.syspath_prepend(str(ROOT))
    build = importlib.import_module(f"examples.{name}").build
    spaces = tomllib.loads((ROOT / "examples" / "tuning_spaces.toml").read_text())
    space = spaces[f"examples.{name}:build"]
    shipped = {key.removeprefix("external."): value["default"] for key, value in space.items()}
    low = shipped | {"start_m": 0.5}  # it begins while the check still climbs
    defects = check_estimator(build, params=low)
    assert all(defect.rule == "deterministic" and "evalio" in name for defect in defects)


def test_the_estimator_of_all_sensors_keeps_the_contract(monkeypatch: pytest.MonkeyPatch) -> None:
    assert touchdown.check_estimator(example("all_sensors", monkeypatch).build) == []


def test_a_policy_is_trained_and_judged_before_and_after(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Episodes of six seconds: what a policy does in them differs before and after."""
    pytest.importorskip("stable_baselines3")
    given = ["--steps", "64", "--episodes", "1", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", ["train_ppo.py", *given])
    script = example("train_ppo", monkeypatch)
    make = script.gymnasium.make
    monkeypatch.setattr(
        script.gymnasium, "make", lambda name, **given: make(name, **{**given, "time_limit_s": 6.0})
    )
    script.main()
    before, after, saved = capsys.readouterr().out.splitlines()[-3:]
    assert before.startswith("before: mean return ") and after.startswith("after: mean return ")
    assert before.split(": ")[1] != after.split(": ")[1]  # the policy has changed
    assert Path(saved).stat().st_size > 10_000
