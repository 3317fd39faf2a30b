"""`touchdown ensemble`, and an ensemble's file where a network's may stand."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from touchdown.experiments.cli import main as cli
from touchdown.landing.classification.ensemble import read_ensemble
from touchdown.landing.classification.labels import D_LAND

from support.command import Says
from support.ground_class_support import COLOURS, write_colour_network

pytest.importorskip("onnx")

BLIND = np.zeros((len(D_LAND), 3))
"""scores of a network that says the same of every colour"""


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders of images in the colours of their classes, noisy."""
    home = tmp_path_factory.mktemp("pictures")
    rng = np.random.default_rng([8, 3])
    for name, colour in COLOURS.items():
        (home / name).mkdir()
        for number in range(60):
            image = np.clip(rng.normal(colour, 25.0, (32, 32, 3)), 0, 255).astype(np.uint8)
            cv2.imwrite(str(home / name / f"{number}.png"), image[..., ::-1])
    return home


def test_two_networks_classify_together(
    images: Path, tmp_path: Path, says: Says, capsys: pytest.CaptureFixture[str]
) -> None:
    seeing = write_colour_network(tmp_path / "seeing.onnx", miss_costs=(("water", 3.0),))
    blind = write_colour_network(tmp_path / "blind.onnx", size=32, per_colour=BLIND)
    out = tmp_path / "both.json"
    command = ["ensemble", str(seeing), str(blind), "--data", str(images), "--out", str(out)]
    report = json.loads(says(0, *command, "--quiet", "--json").out)
    assert report["top1_alone"][0] == report["top1"] == 1.0 > report["top1_alone"][1]
    assert report["networks"] == ["seeing.onnx", "blind.onnx"]
    facts, members = read_ensemble(out)
    assert [member.weight for member in members] == report["weights"]
    assert report["weights"][0] > 1.0  # surer than it is: all is right
    assert (facts.network, facts.image_size) == ("by colour+by colour", 32)
    assert facts.miss_costs == (("water", 3.0),) and facts.limits.min_probability == 0.5
    scored = ["evaluate", str(out), "--data", str(images), "--no-cost", "--quiet", "--json"]
    found = json.loads(says(0, *scored).out)
    assert found["network"] == "by colour+by colour" and found["top1"] == 1.0
    size = sum(file.stat().st_size for file in (seeing, blind)) / 1e6
    assert found["rom_mb"] == pytest.approx(size)
    assert found["decision"]["unsafe_taken_for_safe"] == 0
    assert "runs in the engine onnx alone" in says(2, *scored, "--engine", "torch").err
    given = [*command, "--weight", "0.5", "--weight", "0.5", "--miss-cost", "road=2"]
    assert cli.main([*given, "--quiet"]) == 0
    assert "seeing.onnx: weight 0.500, validation top-1 1.0000" in capsys.readouterr().out
    facts, members = read_ensemble(out)
    assert [member.weight for member in members] == [0.5, 0.5]
    assert facts.miss_costs == (("road", 2.0),)


def test_what_is_no_ensemble_is_refused_in_one_line(
    images: Path, tmp_path: Path, says: Says
) -> None:
    one = write_colour_network(tmp_path / "1.onnx")
    two = write_colour_network(tmp_path / "2.onnx", labels="d_scene")
    (tmp_path / "apart").mkdir()
    apart = write_colour_network(tmp_path / "apart" / "3.onnx")
    out = tmp_path / "out.json"
    for arguments, text in (
        ((one, "--out", out), "1 networks given, 2 to 8 needed"),
        ((one, one, "--out", tmp_path / "out.onnx"), "ends in .json"),
        ((one, apart, "--out", out), "does not lie in the folder of"),
        ((one, two, "--out", out), "'2.onnx' predicts the classes of 'd_scene', the ensemble"),
        ((one, one, "--out", out, "--weight", "1"), "--weight: 1 given for 2 networks"),
        ((one, one, "--out", out, "--miss-cost", "lava=2"), "miss cost of 'lava'"),
    ):
        line = says(2, "ensemble", *map(str, arguments), "--data", str(images), "--quiet").err
        assert text in line and line.count("\n") == 1 and not out.exists()
