"""Names of run directories, and which runs are replaced there."""

from pathlib import Path
from typing import Any

import pytest

from touchdown.experiments.config.loading import dump_config, load_config
from touchdown.experiments.config.schema import Config
from touchdown.experiments.config.settings import difference_text, name_ending, settings_of
from touchdown.experiments.errors import UsageError
from touchdown.experiments.flight.replacing import check_kept
from touchdown.experiments.io.results import RunResult

from support.command import RunCli

LIDAR = ["lidar.preset=mid360"]


def result_of(config: Config, **more: Any) -> RunResult:
    named = {key: getattr(config, key) for key in ("scene", "seed", "estimator", "preset")}
    return RunResult(outcome="LANDED", profile=config.profile, **named, **more)


@pytest.mark.parametrize(("overrides", "options", "ending"), [
    ([], {}, "-land"),
    (LIDAR, {"preset": "short", "profile": "harsh"}, "-land-short-harsh-mid360"),
    (["record=false", "sim.threads=1", "log.sensors=true"], {}, "-land"),
    ([], {"wind_kmh": 20.5, "site": (12.5, -3.0)}, "-land-mean_kmh=20.5-site_xy_m=12.5_-3"),
    (["landing.site_recheck=false"], {"selector": "a.b:c"}, "-land-a.b.c-site_recheck=false"),
])  # fmt: skip
def test_a_name_says_what_is_not_by_default(
    overrides: list[str], options: dict[str, Any], ending: str
) -> None:
    assert name_ending(load_config(None, overrides, **options), "land") == ending


def test_many_settings_are_a_digest_of_keys_and_values() -> None:
    many = ["survey.legs=1", "light=night", "wind.mean_kmh=1", "survey.height_m=9"]
    name, other = (
        name_ending(load_config(None, [*many[:3], last]), "fly")
        for last in (many[3], "survey.height_m=8")
    )
    assert name.startswith("-fly-") and len(name) == 13 and name != other


def test_a_run_of_another_configuration_is_not_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run_cli: RunCli
) -> None:
    def fly(config: Config, out: Path, *_: Any) -> RunResult:
        out.mkdir(parents=True, exist_ok=True)
        result = result_of(config, settings_set=settings_of(config))
        (out / "result.json").write_text(result.to_json())
        return result

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("touchdown.experiments.flight.run.fly_with_usage_errors", fly)
    flat = ("land", "flat", "--quiet", "--out", "x")
    for _ in range(2):
        run_cli(*flat, "--set", LIDAR[0])
    code, out, err = run_cli(*flat, "--seed", "3")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "seed (0, now 3), lidar.preset (mid360, now not set)" in err and "--force" in err
    _, out, _ = run_cli(*flat, "--seed", "3", "--force", "--set", LIDAR[0], "--selector", "zou2024")
    assert "seed 3" in out and "lidar.preset=mid360" in out and "landing.selector=" not in out
    code, _, err = run_cli("fly", *flat[1:], "--seed", "3")
    assert code == 2 and "landing.survey_only (not set, now true)" in err


def test_what_an_earlier_version_flew_is_read_from_its_configuration(tmp_path: Path) -> None:
    config = load_config(None, LIDAR)
    (tmp_path / "result.json").write_text(result_of(config).to_json())
    (tmp_path / "config.json").write_text(dump_config(config))
    check_kept(tmp_path, config, force=False)
    with pytest.raises(UsageError, match=r"lidar\.preset \(mid360, now not set\)"):
        check_kept(tmp_path, load_config(None), force=False)
    with pytest.raises(UsageError, match=r"replay_of \(not set, now log"):
        check_kept(tmp_path, config, force=False, replayed=Path("log"))


def test_a_difference_names_four_keys_and_counts_the_rest() -> None:
    old: dict[str, Any] = {"a": 1, "b": "x", "c": None}
    assert difference_text(old, {"a": 1.0, "b": "y"}) == "b (x, now y)"
    text = difference_text(old, dict.fromkeys("abcdef", 2))
    assert text.startswith("a (1, now 2), b (x, now 2), ") and text.endswith(" and 2 more")
