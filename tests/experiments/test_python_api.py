"""The Python interface: names, laziness, arguments, errors."""

import importlib
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import touchdown
from touchdown.experiments.config.schema import Config
from touchdown.experiments.config.slots import SLOTS, part_of
from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.provenance import versions
from touchdown.experiments.io.results import RunResult
from touchdown.experiments.reporting.sql import run_sql

from support.command import lines_of

ROOT = Path(__file__).parents[2]
SHORT = {
    "survey.legs": 1, "survey.leg_length_m": 4.0, "survey.duration_s": 3.0, "survey.height_m": 4.0,
    "mapper.enabled": False, "record": False,
}  # fmt: skip


def test_every_name_is_there() -> None:
    assert all(callable(getattr(touchdown, name)) for name in touchdown.__all__)
    assert set(dir(touchdown)) >= {*touchdown.__all__, "__version__"}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert touchdown.__version__ == versions()["touchdown"] == project["version"]
    with pytest.raises(AttributeError, match="no attribute 'hover'"):
        _ = touchdown.hover  # type: ignore[attr-defined]


def test_importing_loads_no_simulator() -> None:
    script = (
        "import sys, touchdown; "
        "print([m for m in ('mujoco', 'numpy', 'pydantic', 'cv2') if m in sys.modules]); "
        "touchdown.load_config; "
        "print([m for m in ('mujoco', 'cv2', 'open3d', 'numba', 'click') if m in sys.modules])"
    )
    assert lines_of(script) == ["[]", "[]"]


def test_numpy_values_tuples_and_paths_are_taken() -> None:
    overrides = {"landing.site_xy_m": np.array([1.0, 2.0]), "bias.xy_m": (0.5, np.float64(1.0))}
    config = touchdown.load_config(scene=Path("my/scene.xml"), overrides=overrides)
    assert config.landing.site_xy_m == (1.0, 2.0) and config.bias.xy_m == (0.5, 1.0)
    assert config.scene == str(Path("my/scene.xml"))


@pytest.mark.parametrize(("call", "words"), [
    (lambda: touchdown.fly("crossrod"), "did you mean 'crossroad'"),
    (lambda: touchdown.land(seed=-1), "seed = -1 in the argument seed must be within"),
    (lambda: touchdown.fly(estimator="liwo"), "did you mean 'livo'"),
    (lambda: touchdown.fly(overrides={"survey.hight_m": 3}), "survey.hight_m' in overrides"),
    (
        lambda: touchdown.land(overrides={"survey.height_m": -3.0}),
        "survey.height_m = -3 in overrides must be within",
    ),
    (lambda: touchdown.land("flat", selector=3), "the argument selector is a int; give a name"),
    (lambda: touchdown.land("flat", selector="riks"), "did you mean 'risk'"),
    (lambda: touchdown.fly("flat", selecter="risk"), "no argument selecter (did you mean 'sel"),
    (lambda: touchdown.load_config("gone.toml"), "gone.toml' does not exist"),
    (lambda: touchdown.fly("flat", out="."), "out .: is the working directory"),
    (lambda: touchdown.load_runs("gone"), "'gone' is no directory"),
    (lambda: touchdown.replay("gone"), "'gone' is no run directory"),
    (lambda: touchdown.check_estimator("liwo"), "did you mean 'livo'"),
    (lambda: touchdown.check_estimator("no_module:build"), "no_module"),
    (lambda: touchdown.check_estimator("gps", seconds=0.0), "seconds = 0 must be positive"),
])  # fmt: skip
def test_mistakes_raise_one_line(call: Any, words: str) -> None:
    with pytest.raises(UsageError) as caught:
        call()
    assert words in str(caught.value) and "\n" not in str(caught.value)


def test_flights_are_configured_by_their_arguments(monkeypatch: pytest.MonkeyPatch) -> None:
    flown: list[tuple[Config, Path | None]] = []

    def fly(config: Config, out: Path | None, _progress: Any, _live: Any) -> RunResult:
        flown.append((config, out))
        return RunResult(outcome="COMPLETED", scene=config.scene, seed=0, estimator="gps")

    monkeypatch.setattr("touchdown.experiments.flight.run.fly_with_usage_errors", fly)
    base = touchdown.load_config(scene="lake", seed=5, overrides={"survey.height_m": 20.0})
    assert touchdown.fly(base, seed=6, out="x").is_success
    touchdown.land(base)
    touchdown.land("forest", estimator="zou2024", overrides={"wind.mean_kmh": 0})
    (first, out), (second, none), (third, _) = flown
    assert (first.scene, first.seed, first.survey.height_m) == ("lake", 6, 20.0)
    assert first.landing.survey_only and out == Path("x") and second == base and none is None
    assert (third.scene, third.estimator, third.wind.mean_kmh) == ("forest", "zou2024", 0.0)


def test_each_slot_takes_a_name_a_function_and_any_other_callable(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    lqr = importlib.import_module("examples.lqr")
    given: dict[str, Any] = {kind: lqr.build for kind in SLOTS}
    config = touchdown.load_config(**given)
    assert {part_of(config, kind) for kind in SLOTS} == {"examples.lqr:build"}
    built: list[str] = []

    def build(params: Any, rig: Any) -> Any:
        built.append(params["note"])
        return lqr.build({}, rig)

    overrides = SHORT | {"external.controller.note": "mine"}
    result = touchdown.fly("flat", estimator="gps", controller=build, overrides=overrides)
    assert result.outcome == "COMPLETED" and built == ["mine"] and result.parts is not None
    name = str(result.parts.controller)
    assert name.startswith("given_") and name.endswith(":build") and result.parts_sha is not None
    assert name[6:18] == result.parts_sha.controller
    other = touchdown.load_config(controller=lambda params, rig: lqr.build(params, rig))
    assert other.control.controller not in (name, "cascade")


def test_fly_load_runs_and_replay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    phases: list[str] = []
    released: list[int] = []
    watched = "touchdown.experiments.flight.observers.release_pages"
    monkeypatch.setattr(watched, lambda: released.append(1))
    out = tmp_path / "runs" / "one"
    result = touchdown.fly(
        "flat", estimator="gps", seed=2, overrides=SHORT | {"log.sensors": True, "scene_seed": 0},
        out=out,
        progress=lambda _time_s, phase, _note: phases.append(phase),
    )  # fmt: skip
    assert result.outcome == "COMPLETED" and "SURVEY" in phases
    assert result.timing is not None
    assert len(released) == 1 + int(result.timing.sim_s // 5.0), "free memory is given back"
    assert touchdown.load_runs(tmp_path) == [result]
    assert result.settings_set is not None and "lidar.preset" not in result.settings_set
    assert result.settings_set["survey.legs"] == 1 and result.settings_set["scene_seed"] == 0
    key, path = "gps_estimator.baro_sigma_m", out.with_name("two")
    again = touchdown.replay(out, overrides={key: 1.0}, out=path)
    assert again.settings_set == result.settings_set | {key: 1.0}
    assert again.replay_of == str(out) and again.profile == "field"
    flown, replayed = touchdown.load_runs(tmp_path)
    assert (flown.path, replayed.path) == (out, path)
    assert flown.settings.keys() == replayed.settings.keys() == {key}
    assert replayed.settings[key] == 1.0 != flown.settings[key]
    query = f"select path, \"{key}\" from runs where run_id like '%two'"
    assert run_sql(tmp_path, query).rows == [(str(path), 1.0)]
    assert again.position_error_m is not None and result.position_error_m is not None
    assert again.position_error_m.mean != result.position_error_m.mean
