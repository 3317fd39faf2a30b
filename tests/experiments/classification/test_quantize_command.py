"""``touchdown quantize`` ends with the figures of what it wrote."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchdown.experiments.cli.main import main
from touchdown.experiments.io.images import write_png

from support.ground_class_support import write_colour_network

_COLOURS = {"lawn": (40, 200, 40), "water": (40, 40, 200), "road": (200, 40, 40)}


def test_quantize_prints_what_it_wrote(
    torch: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("onnx")
    network = write_colour_network(tmp_path / "network.onnx")
    for name, colour in _COLOURS.items():
        (tmp_path / "data" / name).mkdir(parents=True)
        for number in range(8):
            file = tmp_path / "data" / name / f"{name}{number:02d}.png"
            write_png(file, np.full((16, 16, 3), colour, np.uint8))
    out = tmp_path / "small.onnx"
    command = ["quantize", str(network), "--data", str(tmp_path / "data"), "--out", str(out)]
    assert main([*command, "--type", "float16", "--quiet"]) == 0
    printed = capsys.readouterr().out
    assert f"written: {out}" in printed
    assert "top-1 1.0000 before, 1.0000 after" in printed
    assert out.is_file()
