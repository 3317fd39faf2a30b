"""`bench tune`: proposals, what counts as an error, resuming, the file; the shipped keys."""

import dataclasses
import json
import math
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from touchdown.experiments.benchmarks import tuning
from touchdown.experiments.benchmarks.tuning import LOST_M, Trial, Tuning, read_space
from touchdown.experiments.config.loading import load_config
from touchdown.experiments.errors import ExternalPartError, UsageError
from touchdown.experiments.flight.replay import RememberedLog, open_run, seen_by
from touchdown.experiments.flight.wiring import ESTIMATORS
from touchdown.sim.api import SensorNeeds

from support.command import Says
from support.replay_support import make_run

SPACE = {
    "livo.pixel_sigma": {"low": 0.05, "high": 5.0, "log": True},
    "livo.features": {"low": 100, "high": 400},
    "livo.use_closures": {"choices": [True, False]},
}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("runs") / "flown", seconds=1.2)


@pytest.mark.parametrize("name", [name for name in ESTIMATORS if name != "oracle"])
def test_every_shipped_estimator_has_keys_around_what_is_shipped(name: str) -> None:
    config = load_config(profile="field")
    for key, values in read_space(name).items():
        group, _, field = key.partition(".")
        shipped = getattr(getattr(config, group), field)
        assert values["low"] <= shipped <= values["high"] and type(shipped) is type(values["low"])


def test_a_log_in_memory_is_the_log_that_the_estimator_sees(run: Path) -> None:
    logged, needs = open_run(run), SensorNeeds(camera_hz=5)
    reader = logged.sensors
    reader.shared = dataclasses.replace(reader.shared, camera_hz=0)
    kept = list(seen_by(needs, RememberedLog(reader, needs, 1.0)))
    whole = [obs for obs in seen_by(needs, reader) if obs.time_s < 1.0]
    assert [obs.tick for obs in kept] == [obs.tick for obs in whole] and kept[-1].time_s > 0.9
    images = [[image.tick for obs in seen for image in obs.images] for seen in (kept, whole)]
    assert images[0] == images[1] and 3 <= len(images[0]) <= 5
    assert sum(len(obs.scans) for obs in kept) == sum(len(obs.scans) for obs in whole) > 0


def _found(error_of: Any, out: Path, trials: int, run: Path, **given: Any) -> dict[str, Any]:
    def error_m(_self: Tuning, _log: Any, given: tuple[str, ...]) -> float:
        values = dict(text.split("=") for text in given)
        return float(error_of(*map(float, list(values.values())[:2])))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Tuning, "_error_m", error_m)
        return tuning.tune(
            "livo", [run], trials=trials, space=SPACE, until_s=math.inf, seed=2, out=out,
            report=lambda _text: None, **given,
        )  # fmt: skip


def test_the_best_is_found_and_a_tuning_that_was_stopped_ends_alike(
    run: Path, tmp_path: Path
) -> None:
    """An error of 0.1 m at a pixel sigma of 1 and 250 features, more elsewhere."""
    pytest.importorskip("optuna")

    def error(sigma: float, features: float) -> float:
        return float(0.1 * np.exp(np.log(sigma) ** 2 + ((features - 250.0) / 100.0) ** 2))

    whole = _found(error, tmp_path / "whole.json", 25, run)
    assert whole["tried"][0][0] == list(whole["default_settings"].values()) == [0.3, 220, True]
    assert whole["trials"] == 25 and whole["logs"] == [{"scene": "crossroad", "seed": 3}]
    assert whole["default_error_m"] == pytest.approx(error(0.3, 220.0), abs=1e-5)
    assert whole["best_error_m"] < 0.13 and whole["best_error_m"] < 0.4 * whole["default_error_m"]
    errors = [found for _, (found,) in whole["tried"]]
    assert np.median(errors[-10:]) < 0.5 * np.median(errors[1:10])  # later trials know more
    best = whole["best_settings"]
    assert error(best["livo.pixel_sigma"], best["livo.features"]) == pytest.approx(
        whole["best_error_m"], abs=1e-5
    )
    _found(error, tmp_path / "parts.json", 12, run)
    _found(error, tmp_path / "parts.json", 25, run)
    assert (tmp_path / "parts.json").read_text() == (tmp_path / "whole.json").read_text()
    assert json.loads((tmp_path / "whole.json").read_text()) == whole
    with pytest.raises(UsageError, match="with other seed"):
        tuning._resumed(tmp_path / "whole.json", {"seed": 3, "keys": SPACE})
    (tmp_path / "bad.json").write_text("{}")
    with pytest.raises(UsageError, match="is no file of a tuning"):
        tuning._resumed(tmp_path / "bad.json", {"seed": 3, "keys": {}})


def test_a_replay_that_diverges_or_breaks_a_rule_is_lost(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers: dict[str, Any] = {
        "0.1": SimpleNamespace(outcome="COMPLETED", position_error_m=SimpleNamespace(mean=0.25)),
        "0.2": SimpleNamespace(outcome="DIVERGED", position_error_m=SimpleNamespace(mean=0.25)),
        "0.4": SimpleNamespace(outcome="COMPLETED", position_error_m=None),
    }

    def answer(_log: Any, config: Any, until_s: float) -> Any:
        assert until_s == 5.0
        if (key := str(config.livo.pixel_sigma)) not in answers:
            raise ExternalPartError("broken")
        return answers[key]

    monkeypatch.setattr(tuning, "replay", answer)
    tried = Tuning("livo", [run, run], 5.0)
    with pytest.warns(UserWarning, match="counted as lost: broken"):
        errors = [tried.tried({"livo.pixel_sigma": s}).error_m for s in (0.1, 0.2, 0.4, 0.8)]
    assert errors == pytest.approx([0.25, LOST_M, LOST_M, LOST_M])
    assert Trial({}, [0.1, 0.4]).error_m == pytest.approx(0.2)
    with pytest.raises(UsageError, match=r"livo\.sigma: no key of the configuration"):
        tried.defaults({"livo.sigma": {"low": 1, "high": 2}})
    assert tried.defaults({"external.a": {"low": 1, "high": 2, "default": 1}}) == {"external.a": 1}


def test_the_command_tunes_a_log_and_checks_another(run: Path, tmp_path: Path, says: Says) -> None:
    pytest.importorskip("optuna")
    space, out = tmp_path / "space.toml", tmp_path / "tune.json"
    space.write_text('[livo]\n"livo.pixel_sigma" = { low = 0.1, high = 1.0 }\n')
    arguments = ["bench", "tune", "livo", str(run), "--space", str(space), "--trials", "2"]
    arguments += ["--until", "1.1", "--check", str(run), "--out", str(out), "--json"]
    figures = json.loads(says(0, *arguments).out)
    assert figures == json.loads(out.read_text()) and figures["until_s"] == 1.1
    assert figures["keys"] == {"livo.pixel_sigma": {"low": 0.1, "high": 1.0}}
    (check,) = figures["check"]  # the whole log, and not to 1.1 s
    assert check["scene"] == "crossroad" and 0.0 < check["default_error_m"] < 0.1
    assert check["default_error_m"] != figures["default_error_m"]
    printed = says(0, *arguments[:-1], "--quiet").out.splitlines()
    assert printed[0] == "livo: 2 trials of 1 keys, crossroad 3"
    assert printed[1].startswith("as shipped") and printed[-1].startswith("check crossroad 3: ")


@pytest.mark.parametrize(
    ("text", "words"),
    [('[gps]\n"a.b" = 3\n', "no keys of 'livo' to vary; known: gps"),
     ('[livo]\n"a.b" = { low = 3 }\n', "the space of a.b needs low and high, or choices"),
     ("[livo", "cannot be read")],
)  # fmt: skip
def test_a_wrong_space_is_one_line(text: str, words: str, tmp_path: Path) -> None:
    file = tmp_path / "space.toml"
    file.write_text(text)
    with pytest.raises(UsageError, match=words):
        read_space("livo", file)


def test_without_optuna_the_remedy_is_one_line(
    run: Path, monkeypatch: pytest.MonkeyPatch, says: Says
) -> None:
    monkeypatch.setitem(sys.modules, "optuna", None)
    captured = says(2, "bench", "tune", "livo", str(run))
    assert captured.out == "" and captured.err.count("\n") == 1
    assert "optuna is not installed; pip install -c constraints.txt -e '.[tune]'" in captured.err
