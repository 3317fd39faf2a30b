"""`touchdown ensemble`: a network of several."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from touchdown.experiments.cli import main as cli
from touchdown.landing.classification.engine import OnnxClassifier
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
            image = np.clip(rng.normal(colour, 25.0, (16, 16, 3)), 0, 255).astype(np.uint8)
            cv2.imwrite(str(home / name / f"{number}.png"), image[..., ::-1])
    return home


def test_two_networks_classify_together(
    images: Path, tmp_path: Path, says: Says, capsys: pytest.CaptureFixture[str]
) -> None:
    seeing = write_colour_network(tmp_path / "seeing.onnx", miss_costs=(("water", 3.0),))
    blind = write_colour_network(tmp_path / "blind.onnx", per_colour=BLIND)
    out = tmp_path / "both.onnx"
    command = ["ensemble", str(seeing), str(blind), "--data", str(images), "--out", str(out)]
    report = json.loads(says(0, *command, "--quiet", "--json").out)
    assert report["top1_alone"][0] == report["top1"] == 1.0 > report["top1_alone"][1]
    assert report["networks"] == ["seeing.onnx", "blind.onnx"]
    assert report["weights"][0] > 1.0  # surer than it is: all is right
    facts = OnnxClassifier(out).facts
    assert facts.network == "by colour+by colour"
    assert facts.miss_costs == (("water", 3.0),) and facts.limits.min_probability == 0.5
    scored = ["evaluate", str(out), "--data", str(images), "--no-cost", "--quiet", "--json"]
    found = json.loads(says(0, *scored).out)
    assert found["network"] == "by colour+by colour" and found["top1"] == 1.0
    assert found["decision"]["unsafe_taken_for_safe"] == 0
    given = [*command, "--weight", "0.5", "--weight", "0.5", "--miss-cost", "road=2"]
    assert cli.main([*given, "--quiet"]) == 0
    assert "seeing.onnx: weight 0.500, validation top-1 1.0000" in capsys.readouterr().out
    assert OnnxClassifier(out).facts.miss_costs == (("road", 2.0),)


def test_what_is_no_ensemble_is_refused_in_one_line(
    images: Path, tmp_path: Path, says: Says
) -> None:
    one = write_colour_network(tmp_path / "1.onnx")
    scenes = write_colour_network(tmp_path / "2.onnx", labels="d_scene")
    large = write_colour_network(tmp_path / "3.onnx", size=32)
    out = tmp_path / "out.onnx"
    for arguments, text in (
        ((one, "--out", out), "1 networks given, 2 to 8 needed"),
        ((one, one, "--out", tmp_path / "out.json"), "ends in .onnx"),
        ((one, one, "--out", one), "is one of the networks"),
        ((one, scenes, "--out", out), "'2.onnx' predicts the classes of 'd_scene', the first"),
        ((one, large, "--out", out), "'3.onnx' sees images of 32 pixels, the first network of 16"),
        ((one, one, "--out", out, "--weight", "1"), "--weight: 1 given for 2 networks"),
        ((one, one, "--out", out, "--miss-cost", "lava=2"), "miss cost of 'lava'"),
    ):
        line = says(2, "ensemble", *map(str, arguments), "--data", str(images), "--quiet").err
        assert text in line and line.count("\n") == 1 and not out.exists()
