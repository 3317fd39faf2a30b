"""Metadata of the project: licence, notice, citation."""

import re
import tomllib
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def test_the_notice_names_every_trained_file() -> None:
    notice = (ROOT / "NOTICE").read_text(encoding="utf-8")
    named = re.findall(r"^([\w/.]+\.(?:onnx|gz))$", notice, re.MULTILINE)
    found = [
        path for pattern in ("*.onnx", "*.yml.gz") for path in ROOT.glob(f"[a-z]*/**/{pattern}")
    ]
    trained = {str(path.relative_to(ROOT)) for path in found if "src" not in path.parts}
    assert set(named) == {name for name in trained if not name.startswith(("runs", "build"))}
    assert "UC Merced" in notice


def test_the_citation_is_of_this_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["cff-version"] == "1.2.0"
    assert citation["version"] == PROJECT["version"]
    assert citation["license"] == PROJECT["license"]
    assert citation["authors"] == PROJECT["authors"]
    (paper,) = citation["references"]
    assert paper["doi"] == "10.3390/app14146079"
    assert [author["family-names"] for author in paper["authors"]] == ["Zou", "Sun", "Kong"]
