"""Presets: their place in the order of sources, in config.json, in campaigns."""

from pathlib import Path

import pytest

from touchdown.experiments.campaign.plan import load_plan
from touchdown.experiments.config.loading import dump_config, load_config
from touchdown.experiments.errors import UsageError

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
