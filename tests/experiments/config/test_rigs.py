"""Rigs: files of keys over profile and vehicle, and the survey that follows the swath."""

from __future__ import annotations

from pathlib import Path

import pytest

from touchdown.experiments.cli.common import RIG_NAMES
from touchdown.experiments.config.loading import load_config
from touchdown.experiments.config.rigs import RIGS, rig_values
from touchdown.experiments.errors import UsageError


def test_every_shipped_rig_loads_and_is_offered() -> None:
    assert set(RIG_NAMES) == set(RIGS)
    for name in RIGS:
        assert load_config(rig=name).rig == name


def test_a_rig_stands_over_profile_and_vehicle_and_below_all_else(tmp_path: Path) -> None:
    config = load_config(None, ["lidar.range_sigma_m=0.03"], rig="xt16_side", vehicle="hexarotor")
    assert (config.lidar.preset, config.lidar.range_sigma_m) == ("xt16", 0.03)
    assert config.lidar.texture == 1.0  # of the profile
    assert load_config(rig="fisheye").camera.readout_s == 0.0  # of the rig, 0.015 in the profile
    own = tmp_path / "own.toml"
    own.write_text('[lidar]\npreset = "avia"\n')
    assert load_config(rig=str(own)).lidar.preset == "avia"


def test_a_narrower_swath_has_more_legs_nearer_to_one_another(tmp_path: Path) -> None:
    """Avia: 70.4 degrees across, for 81.7; tan 35.2 / tan 40.85 of 20 m, at the same speed."""
    own = tmp_path / "own.toml"
    own.write_text('[lidar]\npreset = "avia"\n')
    lower = {"survey.legs": 3, "survey.leg_spacing_m": 20.0, "survey.leg_length_m": 50.0,
             "survey.duration_s": 38.0}  # fmt: skip
    found = rig_values({"rig": str(own)}, lower)
    assert found["survey.leg_spacing_m"] == pytest.approx(16.2, abs=0.6)
    assert found["survey.legs"] == 4
    spacing = found["survey.leg_spacing_m"]
    longer = (4 * 50.0 + 3 * spacing) / (3 * 50.0 + 2 * 20.0)
    assert found["survey.duration_s"] == pytest.approx(38.0 * longer, abs=1.0)
    wide = tmp_path / "wide.toml"
    wide.write_text('[lidar]\npreset = "mid360"\nmount_deg = [0.0, -90.0, 0.0]\n')
    assert "survey.legs" not in rig_values({"rig": str(wide)}, lower)
    assert "survey.legs" not in rig_values({"rig": str(own)}, {"survey.legs": 1})


@pytest.mark.parametrize(("text", "words"), [
    ("[survey]\nlegs = 2\n", "'survey.legs' in .* is not of a rig's groups"),
    ('[lidar]\npreset = "vlp16"\n', "lidar.preset"),
    ("[lidar]\nmount_deg = [1.0, 2.0]\n", "lidar.mount_deg"),
])  # fmt: skip
def test_a_rig_that_is_none_is_one_line(tmp_path: Path, text: str, words: str) -> None:
    own = tmp_path / "own.toml"
    own.write_text(text)
    with pytest.raises(UsageError, match=words):
        load_config(rig=str(own))
    with pytest.raises(UsageError, match=r"unknown rig 'tiled' \(did you mean 'tilted'\?\)"):
        load_config(rig="tiled")
