"""``touchdown quantize`` ends with the figures of what it wrote."""

from pathlib import Path
from typing import Any

import pytest

from touchdown.experiments.cli.main import main

from support.ground_class_support import write_colour_network, write_plain_images


def test_quantize_prints_what_it_wrote(
    torch: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("onnx")
    network = write_colour_network(tmp_path / "network.onnx")
    data = write_plain_images(tmp_path / "data", 16)
    out = tmp_path / "small.onnx"
    command = ["quantize", str(network), "--data", str(data), "--out", str(out)]
    assert main([*command, "--type", "float16", "--quiet"]) == 0
    printed = capsys.readouterr().out
    assert f"written: {out}" in printed
    assert "top-1 1.0000 before, 1.0000 after" in printed
    assert out.is_file()
