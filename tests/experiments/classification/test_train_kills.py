"""Trainings of networks that are killed at random moments."""

from pathlib import Path

import pytest

from support.killed_trainings import killed_trainings
from support.labelled_images_support import coloured_folders

ENDS = {"SIGKILL": {0, -9}, "SIGTERM": {0, 143, -15}, "SIGINT": {0, 130, -2}}
"""Exit codes; negative where the signal came before the program took it"""


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    for name in ("torch", "onnx"):
        pytest.importorskip(name)
    return coloured_folders(tmp_path_factory.mktemp("coloured"), 60, 5, 32)


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
