"""Code that a file names: the module of an external estimator in a configuration that came with
somebody's results is imported with --allow-code alone."""

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import touchdown
from touchdown.experiments.campaign.plan import load_plan
from touchdown.experiments.campaign.results_table import load_rows
from touchdown.experiments.cli import main as cli
from touchdown.experiments.config.loading import dump_config, load_config
from touchdown.experiments.errors import UsageError
from touchdown.experiments.flight.replay import replay_config

from support.command import Says
from support.replay_support import make_run

MODULE = "payload_of_a_stranger"
NAME = f"{MODULE}:build"
CAMPAIGN = f'name = "test"\n[axes]\nscene = ["flat"]\nestimator = ["{NAME}"]\n'

CAMPAIGN_SCENE = {"estimator": 'scene = ["flat"]\n', "scene": ""}


@pytest.fixture
def unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Somebody's results in the current directory: a run, a campaign's file, and a module that
    writes ``imported`` when it is imported."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / f"{MODULE}.py").write_text(
        "open('imported', 'w').close()\nraise RuntimeError('the end of the import')\n"
    )
    make_run(tmp_path / "run", seconds=0.5, estimator=NAME)
    config = load_config(estimator=NAME, seed=3, record=False)
    (tmp_path / "run" / "config.json").write_text(dump_config(config))
    (tmp_path / "campaign.json").write_text("{}")
    (tmp_path / "campaign.toml").write_text(CAMPAIGN)
    yield tmp_path
    sys.modules.pop(MODULE, None)


COMMANDS = (
    ("fly", "flat", "--config", "run/config.json", "--out", "out"),
    ("land", "flat", "--config", "run/config.json", "--out", "out"),
    ("fly", "--replay", "run", "--out", "out"),
    ("campaign", "campaign.toml", "--out", "out"),
)


@pytest.mark.parametrize("arguments", COMMANDS, ids=" ".join)
def test_results_do_not_bring_code(unpacked: Path, says: Says, arguments: tuple[str, ...]) -> None:
    error = says(2, *list(arguments)).err
    file = "campaign.toml" if arguments[0] == "campaign" else "run/config.json"
    assert error == (
        f"touchdown: error: '{file}' came with results and names code, estimator '{NAME}': the "
        f"module '{MODULE}' would be imported and run, from the current directory too; if you "
        "trust it, give --allow-code, or name the estimator with --estimator\n"
    )
    assert MODULE not in sys.modules and not (unpacked / "imported").exists()
    assert not (unpacked / "out").exists()


@pytest.mark.parametrize("arguments", COMMANDS, ids=" ".join)
def test_allow_code_imports_it(unpacked: Path, says: Says, arguments: tuple[str, ...]) -> None:
    assert "the end of the import" in says(2, *arguments, "--allow-code").err
    assert (unpacked / "imported").exists()


@pytest.mark.parametrize("by", [("--estimator", NAME), ("--set", f"estimator={NAME}")])
def test_an_estimator_of_the_command_line_is_imported(
    unpacked: Path, says: Says, by: tuple[str, ...]
) -> None:
    assert "the end of the import" in says(2, *COMMANDS[0], *by).err


def test_another_estimator_does_without_the_code(unpacked: Path) -> None:
    file = unpacked / "run" / "config.json"
    assert load_config(file, estimator="oracle").estimator == "oracle"
    assert replay_config(unpacked / "run", "livo").estimator == "livo"
    assert not (unpacked / "imported").exists()


def test_a_file_of_the_user_names_code(unpacked: Path, says: Says) -> None:
    own = unpacked / "own"
    own.mkdir()
    (own / "flight.toml").write_text(f'estimator = "{NAME}"\n')
    (own / "many.toml").write_text(CAMPAIGN)
    assert load_config(own / "flight.toml").estimator == NAME
    assert {run.values["estimator"] for run in load_plan(own / "many.toml").runs} == {NAME}
    said = says(2, "fly", "flat", "--config", "own/flight.toml", "--out", "out")
    assert "the end of the import" in said.err


@pytest.mark.parametrize("key", ["estimator", "scene"])
def test_a_toml_beside_results_is_theirs(unpacked: Path, key: str) -> None:
    file, plan = unpacked / "run" / "flight.toml", unpacked / "campaign.toml"
    file.write_text(f'{key} = "{NAME}"\n')
    plan.write_text(f'name = "test"\n[axes]\n{CAMPAIGN_SCENE[key]}{key} = ["{NAME}"]\n')
    for read in (load_config, touchdown.load_config, load_plan):
        with pytest.raises(UsageError, match=f"came with results and names code, {key}"):
            read(plan if read is load_plan else file)
    assert not (unpacked / "imported").exists()
    assert load_config(file, **{key: "gps" if key == "estimator" else "flat"})
    (unpacked / "run" / "config.json").write_text(dump_config(load_config(scene=NAME)))
    if key == "scene":
        assert replay_config(unpacked / "run").scene == NAME  # which a replay does not make
        assert cli.main(["control", "margins", "--config", "run/config.json"]) == 2
        assert not (unpacked / "imported").exists()


def test_python(unpacked: Path) -> None:
    file = unpacked / "run" / "config.json"
    with pytest.raises(UsageError, match="came with results and names code"):
        touchdown.load_config(file)
    with pytest.raises(UsageError, match="came with results and names code"):
        touchdown.replay(unpacked / "run")
    assert touchdown.load_config(file, allow_code=True).estimator == NAME
    assert touchdown.load_config(file, estimator=NAME).estimator == NAME
    assert touchdown.load_config(file, overrides={"estimator": "livo"}).estimator == "livo"
    assert not (unpacked / "imported").exists()


def test_reading_results_imports_nothing(unpacked: Path) -> None:
    (unpacked / "campaign.json").unlink()
    (row,) = load_rows(unpacked)
    assert (row["estimator"], row["mode"]) == (NAME, "land")
    assert row["config_sha"]  # of its configuration
    assert json.loads((unpacked / "run" / "config.json").read_text())["estimator"] == NAME
    assert not (unpacked / "imported").exists()
