"""Trainings of networks that are killed at random moments."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest

from touchdown.landing.classification.labels import D_LAND

from support.killed_trainings import killed_trainings
from support.labelled_images_support import coloured

ENDS = {"SIGKILL": {0, -9}, "SIGTERM": {0, 143, -15}, "SIGINT": {0, 130, -2}}
"""Exit codes; negative where the signal came before the program took it"""


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    for name in ("torch", "onnx"):
        pytest.importorskip(name)
    home = tmp_path_factory.mktemp("coloured")
    pictures = coloured(60, 5, 32)
    for number, (image, label) in enumerate(zip(pictures.images, pictures.labels, strict=True)):
        path = home / D_LAND[label]
        path.mkdir(exist_ok=True)
        cv2.imwrite(str(path / f"{number}.png"), image[..., ::-1])
    return home


def check(data: Path, folder: Path, name: str, kills: int) -> None:
    found = killed_trainings(data, folder, name, kills)
    print({key: value for key, value in found.items() if key != "err"})
    assert found["kills"] == kills and found["trainings"] >= 1
    assert (found["lost"], found["left"]) == (0, 0)
    assert set(found["ends"]) <= ENDS[name]
    lines = {line for line in found["err"].splitlines() if line}  # the one after ^C is empty
    assert all(line.startswith("touchdown: ") for line in lines), lines


@pytest.mark.slow
@pytest.mark.parametrize("name", ["SIGKILL", "SIGTERM", "SIGINT"])
def test_nothing_that_is_finished_is_lost(data: Path, tmp_path: Path, name: str) -> None:
    check(data, tmp_path / "trainings", name, 20)
