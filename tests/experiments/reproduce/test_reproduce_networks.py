"""Parallel trainings of a reproduction."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from touchdown.experiments.errors import UsageError
from touchdown.experiments.reproduce.networks import NETWORKS, PICTURES, train_and_score
from touchdown.experiments.reproduce.plans import QUICK

pytest.importorskip("torch")
pytest.importorskip("onnx")

SIZE = replace(
    QUICK.recognition, networks=("mobilenet_v3_large", "resnet18"), labels=("d_land",),
    image_size=32, epochs=1,
)  # fmt: skip


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("photographs")
    rng = np.random.default_rng(0)
    for number, name in enumerate(("lawn", "road", "water")):
        (home / name).mkdir()
        for image in range(30):
            pixels = rng.integers(60 * number, 60 * number + 60, (32, 32, 3), dtype=np.uint8)
            cv2.imwrite(str(home / name / f"{image}.png"), pixels)
    return home


def made(out: Path, photographs: Path, jobs: int, output: list[str]) -> dict[str, bytes]:
    home = out / f"with {jobs}"
    home.mkdir()
    (home / PICTURES).symlink_to(photographs)
    rows = train_and_score(home, SIZE, [], {"jobs": "any"}, jobs, output.append)
    assert [row["network"] for row in rows] == list(SIZE.networks)
    assert all(row["test"]["pictures"] > 0 and row["test"]["image_ms"] > 0.0 for row in rows)
    return {
        name: (home / NETWORKS / f"{name}-d_land" / "network.onnx").read_bytes()
        for name in SIZE.networks
    }


@pytest.mark.slow
def test_networks_do_not_depend_on_how_many_are_trained_at_a_time(
    photographs: Path, tmp_path: Path
) -> None:
    output: list[str] = []
    assert made(tmp_path, photographs, 2, output) == made(tmp_path, photographs, 1, [])
    assert any("2 of 2 trained" in note for note in output)
    output.clear()
    train_and_score(tmp_path / "with 2", SIZE, [], {"jobs": "any"}, 2, output.append)
    assert not output, "what is there is kept"


def test_a_failed_training_gives_its_reason(tmp_path: Path) -> None:
    (tmp_path / PICTURES).mkdir()
    (tmp_path / PICTURES / "lawn").mkdir()
    with pytest.raises(UsageError, match="is empty: it holds no image"):
        train_and_score(tmp_path, SIZE, [], {}, 2, lambda note: None)
