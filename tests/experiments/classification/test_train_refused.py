"""A training that is refused leaves nothing behind."""

import json
from pathlib import Path
from typing import Any

import pytest

from touchdown.experiments.cli.main import main

from support.ground_class_support import write_plain_images

_TRAIN = ("--network", "mobilenet_v3_large", "--image-size", "32", "--batch-size", "2", "--quiet")


@pytest.fixture
def data(tmp_path: Path) -> str:
    return str(write_plain_images(tmp_path / "data", 32))


def _refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main(["train", *arguments, *_TRAIN]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    return lines[0]


def test_no_folder_is_left_where_the_start_is_refused(
    torch: Any, data: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "start").mkdir()
    out = tmp_path / "new" / "er"
    line = _refused(
        capsys, "--data", data, "--out", str(out), "--start-from", str(tmp_path / "start")
    )
    assert "network.onnx' does not exist" in line and not out.parent.exists()


def test_what_lies_in_the_folder_stays_where_it_is_another_training(
    torch: Any, data: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "out").mkdir()
    course = {"identity": {"network": "vgg19"}, "history": [], "best_epoch": -1}
    torch.save({"course": json.dumps(course)}, tmp_path / "out" / "last.pt")
    line = _refused(capsys, "--data", data, "--out", str(tmp_path / "out"))
    assert "holds a training with network 'vgg19', not 'mobilenet_v3_large'" in line
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["last.pt"]
