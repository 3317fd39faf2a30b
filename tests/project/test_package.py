"""Metadata of the project: the notice."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_the_notice_names_every_trained_file() -> None:
    notice = (ROOT / "NOTICE").read_text(encoding="utf-8")
    named = re.findall(r"^([\w/.]+\.(?:onnx|gz))$", notice, re.MULTILINE)
    found = [
        path for pattern in ("*.onnx", "*.yml.gz") for path in ROOT.glob(f"[a-z]*/**/{pattern}")
    ]
    trained = {str(path.relative_to(ROOT)) for path in found if "src" not in path.parts}
    assert set(named) == {name for name in trained if not name.startswith(("runs", "build"))}
