"""The shipped network: metadata, and accuracy on unseen scenes."""

import functools
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from touchdown.experiments.classification.data_sets import split_of_layout
from touchdown.experiments.classification.patches import Patch, scene_patches
from touchdown.experiments.flight.wiring import build_classifier
from touchdown.landing.classification import engine, onboard
from touchdown.landing.classification.engine import OnnxClassifier
from touchdown.scenes.api import LAND_CLASSES, SAFE_CLASSES

from support.command import Says
from support.worlds import load_ideal_config

SEED = 900_004
"""of no data set, and one that leaves 4 when divided by 5"""
PICTURES = 24


@functools.cache
def pictures_of(scene: str) -> list[Patch]:
    return scene_patches(scene, SEED, PICTURES, 128, variation=0)


def test_weights_beside_a_shipped_network_are_checked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = tmp_path / "own" / "onboard.onnx"
    shutil.copytree(onboard.ZOU2024.parent, copy.parent)
    with pytest.raises(ValueError, match="lie in another file"):
        OnnxClassifier(copy)
    monkeypatch.setattr(engine, "_TRAINED", copy.parent.resolve())
    with copy.with_name("onboard.onnx.2").open("ab") as weights:
        weights.write(b"?")
    with pytest.raises(ValueError, match=r"onnx\.2', weights of 'onboard\.onnx', is missing"):
        OnnxClassifier(copy)


def test_the_selector_of_the_paper_flies_its_network() -> None:
    for key, network in (
        ("selector=risk", "efficientnet_lite0"),
        ("selector=zou2024", "resnet50_cbam"),
    ):
        chosen = build_classifier(load_ideal_config(None, [f"landing.{key}"]))
        assert chosen is not None and chosen.description()["network"] == network
    assert onboard.SHIPPED.stat().st_size < 20_000_000
    assert "Apache" in onboard.SHIPPED.with_name("efficientnet_lite0.LICENSE").read_text()


@pytest.mark.parametrize("file", [onboard.SHIPPED, onboard.ZOU2024])
@pytest.mark.parametrize("scene", [
    "lake",
    *(pytest.param(name, marks=pytest.mark.slow) for name in ("houses", "footbridge", "pools")),
])  # fmt: skip
def test_accuracy_on_unseen_scenes(scene: str, file: Path) -> None:
    """The bound is far below the scores in `docs/results/ground-classification.md`."""
    classifier = onboard.load_onboard_classifier(file)
    assert split_of_layout(scene, SEED) == "test"
    assert classifier.image_size == 128
    patches = pictures_of(scene)
    prediction = classifier.classify(np.stack([patch.rgb for patch in patches]))
    found = [LAND_CLASSES[best] for best in prediction.probabilities.argmax(axis=1)]
    true = [patch.land_class for patch in patches]
    assert np.mean([a == b for a, b in zip(found, true, strict=True)]) >= 0.75
    safe = np.array([name in SAFE_CLASSES for name in LAND_CLASSES])
    sure = prediction.probabilities[:, safe].sum(axis=1) >= classifier.min_probability
    taken = sure & prediction.in_distribution & safe[prediction.probabilities.argmax(axis=1)]
    assert not any(t and name in ("water", "trees") for t, name in zip(taken, true, strict=True))


def test_commands_without_a_network_use_the_shipped_one(tmp_path: Path, says: Says) -> None:
    home = tmp_path / "pictures"
    patches = pictures_of("lake")[:10]
    for number, patch in enumerate(patches):
        (home / patch.land_class).mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(home / patch.land_class / f"{number}.png"), patch.rgb[..., ::-1])
    whole = ["evaluate", "--data", str(home), "--split", "train", "--no-cost", "--quiet", "--json"]
    report = json.loads(says(0, *whole).out)
    assert report["network"] == "efficientnet_lite0" and report["image_size"] == 128
    assert report["rom_mb"] == pytest.approx(onboard.SHIPPED.stat().st_size / 1e6)
    assert 0 < report["pictures"] <= len(patches)
    picture = next(home.glob("*/*.png"))
    out = tmp_path / "classes"
    (row,) = json.loads(says(0, "classify", picture, "--out", out, "--json").out)["pictures"]
    assert Path(row["classes"]).is_file()
    assert sum(row["shares"].values()) == pytest.approx(1.0, abs=1e-6)


def test_onnx_runtime_keeps_no_record_of_its_use(tmp_path: Path) -> None:
    code = (
        "from touchdown.landing.classification.engine import OnnxClassifier\n"
        "from touchdown.landing.classification.onboard import SHIPPED\n"
        "OnnxClassifier(SHIPPED)"
    )
    environment = {name: value for name, value in os.environ.items() if not name.startswith("ORT_")}
    environment |= {"HOME": str(tmp_path), "XDG_CACHE_HOME": ""}
    subprocess.run([sys.executable, "-c", code], env=environment, check=True)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
