"""Profiles and presets: their place in the order of sources, in config.json, in campaigns."""

import dataclasses
import json
from pathlib import Path

import pytest

from touchdown.estimator.api import CalibrationPriors
from touchdown.experiments import python_api
from touchdown.experiments.campaign.plan import load_plan
from touchdown.experiments.config import profiles
from touchdown.experiments.config.loading import dump_config, load_config
from touchdown.experiments.config.profiles import PROFILES, effects, profile_values
from touchdown.experiments.config.schema import Config
from touchdown.experiments.errors import UsageError
from touchdown.experiments.flight.replay import replay_config

KIND = {"camera.noise_sigma": 3.0, "wind.mean_kmh": 14.0}
UNKIND = {**KIND, "wind.mean_kmh": 18.0, "camera.gain": 0.5}


@pytest.fixture
def two(monkeypatch: pytest.MonkeyPatch) -> None:
    """A field of two keys, and a harsh that changes one of them and adds a third."""
    values = {"field": KIND, "harsh": UNKIND}
    monkeypatch.setattr(profiles, "profile_values", lambda name: values.get(name, {}))


def test_ideal_is_the_schema_itself() -> None:
    assert load_config(profile="ideal") == Config(profile="ideal")


@pytest.mark.usefixtures("two")
def test_a_run_is_repeated_and_moved_to_another_profile(tmp_path: Path) -> None:
    flown = load_config(None, ["camera.noise_sigma=9"], profile="harsh", wind_kmh=3.0)
    file = tmp_path / "config.json"
    file.write_text(dump_config(flown))
    assert load_config(file) == flown
    moved = load_config(file, profile="field")
    # what its user had chosen stays; what its profile had set goes
    assert (moved.camera.noise_sigma, moved.wind.mean_kmh, moved.camera.gain) == (9.0, 3.0, 1.0)
    assert load_config(file, ["profile=ideal"]).camera.noise_sigma == 9.0


@pytest.mark.usefixtures("two")
def test_a_wrong_value_of_a_profile_names_the_profile(monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = {"field": {"camera.gain": -1.0}}
    monkeypatch.setattr(profiles, "profile_values", lambda name: wrong.get(name, {}))
    with pytest.raises(UsageError, match=r"camera\.gain = -1 in profile field"):
        load_config(profile="field")


@pytest.mark.usefixtures("two")
def test_field_is_flown_where_nothing_names_a_profile(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text("[camera]\ngain = 0.8\n")
    for config in (load_config(), load_config(file), python_api.load_config(file)):
        assert (config.profile, config.wind.mean_kmh) == ("field", KIND["wind.mean_kmh"])
    assert load_config(profile_default="ideal").wind == Config().wind
    assert load_config(file, ["profile=harsh"], profile_default="ideal").wind.mean_kmh == 18.0


@pytest.mark.usefixtures("two")
def test_a_run_of_a_version_before_profiles_stays_ideal(tmp_path: Path) -> None:
    old = json.loads(dump_config(Config(seed=3)))
    del old["profile"], old["harsh_effects"], old["camera"]["noise_sigma"]
    file = tmp_path / "config.json"
    file.write_text(json.dumps(old))
    ideal = Config(seed=3)
    assert load_config(file) == python_api.load_config(file) == ideal
    assert replay_config(tmp_path) == ideal and replay_config(tmp_path, fresh=True) == ideal
    moved = load_config(file, profile="field")
    assert moved.wind.mean_kmh == KIND["wind.mean_kmh"]
    assert python_api.load_config(file, overrides={"profile": "field"}) == moved


def test_effects_together_are_the_world_of_harsh_and_the_estimators_of_field() -> None:
    grouped = [key for group in effects().values() for key in group]
    assert len(grouped) == len(set(grouped))
    field, harsh = load_config(), load_config(profile="harsh")
    everything = load_config(None, [f"harsh_effects={json.dumps(list(effects()))}"])
    names = ("livo", "zou2024", "flown_imu", "calibration_prior", "stereo_vo")
    assumed = {name: getattr(field, name) for name in names}
    update = {"profile": "harsh", "harsh_effects": ()}
    assert everything.model_copy(update=update) == harsh.model_copy(update=assumed) != harsh


@pytest.mark.parametrize("profile", PROFILES)
def test_all_estimators_have_the_priors_of_livo(profile: str) -> None:
    config = load_config(profile=profile)
    for field in dataclasses.fields(CalibrationPriors):
        priors = (config.livo, config.zou2024, config.calibration_prior)
        assert len({getattr(params, field.name) for params in priors}) == 1, field.name


def test_one_effect_is_added_to_a_profile() -> None:
    config = load_config(None, ['harsh_effects=["shutter"]'])
    plain = load_config()
    assert config.camera.readout_s == profile_values("harsh")["camera.readout_s"]
    assert config.camera.readout_s > plain.camera.readout_s and config.imu == plain.imu
    by_hand = load_config(None, ['harsh_effects=["shutter"]', "camera.readout_s=0.001"])
    assert by_hand.camera.readout_s == 0.001
    with pytest.raises(UsageError, match=r"unknown effect 'shuter'.*'shutter'"):
        load_config(None, ['harsh_effects=["shuter"]'])


CAMPAIGN = 'name = "a"\nmode = "land"\n[axes]\nscene = ["crossroad"]\nseeds = "3-4"\n'


def test_a_preset_lies_over_the_profile_and_under_files_and_options(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text('preset = "short"\n[survey]\nleg_length_m = 10.0\n')
    config = load_config(file, ["survey.height_m=12"], profile="harsh")
    assert (config.survey.leg_length_m, config.survey.height_m) == (10.0, 12.0)
    assert (config.preset, config.survey.legs) == ("short", 1)
    assert load_config(file, preset="whole").survey.legs == 3


@pytest.mark.parametrize("profile", ["ideal", "field"])
def test_a_run_is_moved_to_another_preset_with_what_its_author_chose(
    tmp_path: Path, profile: str
) -> None:
    file = tmp_path / "config.json"
    flown = load_config(None, ["survey.climb_turn_deg=90"], profile=profile, preset="short")
    file.write_text(dump_config(flown))
    assert load_config(file) == flown
    whole = load_config(file, preset="whole")
    assert (whole.survey.legs, whole.survey.climb_turn_deg) == (3, 90.0)
    assert whole.profile == profile


def test_mistakes_name_the_preset() -> None:
    with pytest.raises(UsageError, match=r"preset = .*unknown.*did you mean 'short'"):
        load_config(None, ["preset=shrot"])
    with pytest.raises(UsageError, match=r"does not fit into 4.5 s.*survey\.legs=3, preset short"):
        load_config(None, ["survey.legs=3"], preset="short")


def test_a_campaign_takes_a_preset_as_axis_key_or_option(tmp_path: Path) -> None:
    file = tmp_path / "a.toml"
    file.write_text(CAMPAIGN)
    assert {run.values["preset"] for run in load_plan(file, preset="short").runs} == {"short"}
    file.write_text(CAMPAIGN + 'preset = ["whole", "short"]\n')
    names = [run.run_id for run in load_plan(file).runs]
    assert names[:2] == ["crossroad-livo-s3-whole", "crossroad-livo-s3-short"]
    with pytest.raises(UsageError, match="'preset' in --preset short is an axis already"):
        load_plan(file, preset="short")
