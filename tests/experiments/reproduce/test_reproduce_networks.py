"""Parallel trainings of a reproduction."""

from dataclasses import replace
from pathlib import Path

import pytest

from touchdown.experiments.errors import UsageError
from touchdown.experiments.reproduce.networks import PICTURES, train_and_score
from touchdown.experiments.reproduce.plans import QUICK

pytest.importorskip("torch")
pytest.importorskip("onnx")


def test_a_failed_training_gives_its_reason(tmp_path: Path) -> None:
    (tmp_path / PICTURES).mkdir()
    (tmp_path / PICTURES / "lawn").mkdir()
    two = ("mobilenet_v3_large", "resnet18")
    size = replace(QUICK.recognition, networks=two, labels=("d_land",), image_size=32, epochs=1)
    with pytest.raises(UsageError, match="is empty: it holds no image"):
        train_and_score(tmp_path, size, [], {}, 2, lambda note: None)
