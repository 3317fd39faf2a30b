"""`touchdown train`, `evaluate`, `classify` and `ensemble`, and the file of a network that they
share."""

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from touchdown.experiments.classification import evaluate
from touchdown.experiments.classification.render_dataset import COLUMNS, MANIFEST
from touchdown.experiments.cli import main as cli
from touchdown.experiments.io.images import read_picture
from touchdown.landing.classification import weights
from touchdown.landing.classification.engine import OnnxClassifier
from touchdown.landing.classification.labels import D_LAND

from support.command import Says
from support.ground_class_support import (
    write_colour_network,
    write_noisy_images,
    write_plain_images,
)
from support.labelled_images_support import coloured, coloured_folders

MOBILENET_WEIGHTS = 4_210_008
"""of seven classes"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders of coloured images."""
    return coloured_folders(tmp_path_factory.mktemp("coloured"), 90, 5, 40)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory, folder: Path) -> Path:
    """The network of a short training by the command."""
    for name in ("torch", "onnx", "onnxruntime"):
        pytest.importorskip(name)
    out = tmp_path_factory.mktemp("trained")
    arguments = ["train", "--network", "mobilenet_v3_large", "--data", str(folder), "--out",
                 str(out), "--epochs", "2", "--image-size", "32", "--threads", "1", "--quiet",
                 "--json"]  # fmt: skip
    assert cli.main(arguments) == 0
    return out / "network.onnx"


def test_training_leaves_its_files(trained: Path) -> None:
    names = {path.name for path in trained.parent.iterdir()}
    assert names == {
        "network.onnx", "network.onnx.sha256", "curves.csv", "curves.rrd", "training.json",
        "last.pt",
    }  # fmt: skip
    report = json.loads((trained.parent / "training.json").read_text())
    assert report["epochs"] == 2 and report["parameters"]["network"] == "mobilenet_v3_large"
    curves = (trained.parent / "curves.csv").read_text().splitlines()
    assert len(curves) == 3 and curves[0].startswith("epoch,learning_rate,train_loss,val_loss")


def test_the_file_computes_what_was_trained_in_float16(trained: Path, torch: Any) -> None:
    """2 bytes a weight; the scores are those of the best weights, rounded, at its temperature."""
    from touchdown.landing.classification.learning.training import predict
    from touchdown.landing.classification.networks.registry import build_network

    assert 2 * MOBILENET_WEIGHTS < trained.stat().st_size < 2.2 * MOBILENET_WEIGHTS
    network = build_network("mobilenet_v3_large", 7, 32)
    network.load_state_dict(torch.load(trained.parent / "last.pt", weights_only=True)["best"])
    with torch.no_grad():
        for weight in network.parameters():
            if weight.ndim >= 2:
                weight.copy_(weight.half().float())
    images = coloured(6, 8).images
    temperature = json.loads((trained.parent / "training.json").read_text())["temperature"]
    expected = predict(network, images, torch.device("cpu")) / temperature
    classifier = OnnxClassifier(trained)
    np.testing.assert_allclose(classifier.scores(images), expected, atol=1e-4)
    for wrong in (images[:, :16], images[0]):
        with pytest.raises(ValueError, match=r"\(N, 32, 32, 3\) uint8 needed"):
            classifier.scores(wrong)


def test_what_a_miss_costs_is_decided_at_the_end(
    trained: Path, folder: Path, tmp_path: Path, torch: Any, says: Says
) -> None:
    """The same training, ended with a cost: the same scores but for one class, ln 10 more."""
    out = tmp_path / "trained"
    shutil.copytree(trained.parent, out)
    arguments = ["train", "--network", "mobilenet_v3_large", "--data", str(folder), "--out",
                 str(out), "--epochs", "2", "--image-size", "32", "--quiet", "--json",
                 "--miss-cost", "water=10"]  # fmt: skip
    report = json.loads(says(0, *arguments).out)
    assert report["parameters"]["miss_costs"] == [["water", 10.0]]
    images = coloured(6, 8).images
    more = np.where(np.array(D_LAND) == "water", np.log(10.0), 0.0)
    plain, dear = (
        OnnxClassifier(path / "network.onnx").scores(images) for path in (trained.parent, out)
    )
    np.testing.assert_allclose(dear - plain, np.broadcast_to(more, (6, 7)), atol=1e-4)
    reports = []
    for file, cost in ((out / "network.onnx", []), (trained, ["--miss-cost", "water=10"])):
        whole = ["evaluate", str(file), "--data", str(folder), "--no-cost", "--quiet", "--json"]
        reports.append(json.loads(says(0, *whole, *cost).out))
    assert reports[0]["miss_costs"] == reports[1]["miss_costs"] == {"water": 10.0}
    assert reports[0]["confusion"] == reports[1]["confusion"]
    assert "miss cost of 'lava'" in says(2, *whole, "--miss-cost", "lava=2").err


def test_evaluating_by_command(trained: Path, folder: Path, says: Says) -> None:
    arguments = ["evaluate", str(trained), "--data", str(folder), "--quiet", "--json"]
    report = json.loads(says(0, *arguments).out)
    assert report["pictures"] == sum(map(sum, report["confusion"]))
    assert report["top1"] == report["hits"] / report["pictures"]
    assert report["rom_mb"] == trained.stat().st_size / 1e6
    assert report["peak_ram_mb"] > 20.0 and report["image_ms"] > 0.0
    assert list(report["by_source"]) == ["d_land"]
    printed = says(0, *arguments[:-1]).out
    assert "true class by row, predicted class by column" in printed
    assert " ms an image on one thread\n" in printed


def test_weight_undoes_what_a_network_claims_too_much() -> None:
    """Right in four of five, which log-odds of ln 4 say; these claim twice as much."""
    scores = np.full((100, len(D_LAND)), -50.0, np.float32)
    scores[:, :2] = 2.0 * np.log(4.0), 0.0
    labels = (np.arange(100) >= 80).astype(int)
    facts = weights.NetworkFacts(network="resnet18", labels="d_land", image_size=32, classes=D_LAND)
    assert evaluate._summary(scores, labels, facts)["weight"] == pytest.approx(0.5, rel=0.01)


def test_rendered_pictures_are_scored_by_scene(trained: Path, tmp_path: Path, says: Says) -> None:
    rows = [("lake", 4, 15.0), ("lake", 9, 14.9), ("pools", 0, 20.0), ("flat", 4, 40.0)]
    lines = [",".join(COLUMNS)]
    for number, (scene, seed, height) in enumerate(rows):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.full((32, 32, 3), 40 * number, np.uint8))
        lines.append(f"{number}.png,lawn,pond,{scene},{seed},test,{height},6.0,1.000")
    (tmp_path / MANIFEST).write_text("\n".join(lines) + "\n")
    arguments = ["evaluate", str(trained), "--data", str(tmp_path), "--no-cost", "--quiet"]
    report = json.loads(says(0, *arguments, "--json").out)
    assert {name: row["pictures"] for name, row in report["by_scene"].items()} == {
        "flat": 1, "lake": 2, "pools": 1, "scenes trained on": 3, "scenes never trained on": 1
    }  # fmt: skip
    assert "scenes never trained on" in says(0, *arguments).out


def test_classifying_by_command(trained: Path, tmp_path: Path, says: Says) -> None:
    photograph = tmp_path / "photograph.png"
    cv2.imwrite(str(photograph), np.full((60, 90, 3), 90, np.uint8))
    out = tmp_path / "classes"
    arguments = ["classify", str(photograph), "--network", str(trained), "--out", str(out)]
    (row,) = json.loads(says(0, *arguments, "--json", "--quiet").out)["pictures"]
    assert sum(row["shares"].values()) == pytest.approx(1.0) and row["window_px"] == 32
    assert read_picture(out / "photograph-classes.png").shape[1] == 90
    refused = says(2, *arguments, "--window", "64").err
    assert "64 pixels do not fit into an image of 90 x 60" in refused


def test_commands_say_what_is_missing(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, says: Says
) -> None:
    """Without torch the other commands work, and this one says what to install."""
    for name in [
        n for n in sys.modules if n.startswith("touchdown.landing.classification.learning")
    ]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torch", None)
    arguments = ["train", "--data", str(folder), "--out", str(tmp_path / "out")]
    output = says(2, *arguments).err
    assert (
        "this needs torch: install it with pip install -c constraints.txt -e '.[train]'" in output
    )
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("arguments", "message"), [
    (["--network", "resnet51"], "unknown network 'resnet51': did you mean"),
    (["--data", "nowhere"], "'nowhere' is not a folder"),
    (["--device", "tpu"], "unknown device 'tpu'"),
    (["--miss-cost", "lava=10"], "miss cost of 'lava': the classes are lawn, field"),
    (["--miss-cost", "water"], "'water' is not of the form CLASS=K, with K above 0"),
    (["--miss-cost", "water=nan"], "'water=nan' is not of the form CLASS=K"),
    (["--network", "inception_v4", "--image-size", "64"], "at least 75 pixels"),
    (["--teacher", "none.onnx"], "'none.onnx' does not exist; name a network"),
])  # fmt: skip
def test_training_refuses(
    arguments: list[str], message: str, torch: Any, folder: Path, tmp_path: Path, says: Says
) -> None:
    pytest.importorskip("onnx")
    out = tmp_path / "out"
    command = ["train", "--out", str(out), "--data", str(folder), "--quiet", *arguments]
    output = says(2, *command).err
    assert message in output and output.count("\n") == 1 and not out.exists()


_SMALL = ("--network", "mobilenet_v3_large", "--image-size", "32", "--batch-size", "2", "--quiet")


def test_a_refused_training_leaves_the_folder_as_it_was(
    torch: Any, tmp_path: Path, says: Says
) -> None:
    """No new one where the start is refused, and another training stays in its own."""
    data = str(write_plain_images(tmp_path / "data", 32))
    (tmp_path / "start").mkdir()
    new, used = tmp_path / "new" / "er", tmp_path / "out"
    command = ("train", "--data", data, *_SMALL, "--out")
    refused = says(2, *command, str(new), "--start-from", str(tmp_path / "start")).err
    assert "network.onnx' does not exist" in refused and not new.parent.exists()
    used.mkdir()
    course = {"identity": {"network": "vgg19"}, "history": [], "best_epoch": -1}
    torch.save({"course": json.dumps(course)}, used / "last.pt")
    refused = says(2, *command, str(used)).err
    assert "holds a training with network 'vgg19', not 'mobilenet_v3_large'" in refused
    assert refused.count("\n") == 1 and [path.name for path in used.iterdir()] == ["last.pt"]


BLIND = np.zeros((len(D_LAND), 3))
"""scores of a network that says the same of every colour"""


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_noisy_images(tmp_path_factory.mktemp("pictures"), 60, 3)


def test_two_networks_classify_together(images: Path, tmp_path: Path, says: Says) -> None:
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
    printed = says(0, *given, "--quiet").out
    assert "seeing.onnx: weight 0.500, validation top-1 1.0000" in printed
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
