import importlib.metadata
import subprocess
from pathlib import Path
from typing import Any

import cv2
import pytest

from touchdown.experiments.io.provenance import revision_of, versions
from touchdown.scenes import cache


def git(tree: Path, *arguments: str) -> str:
    command = ["git", "-c", "user.name=a", "-c", "user.email=a@example.org", *arguments]
    call = subprocess.run(command, cwd=tree, capture_output=True, text=True, check=True)
    return call.stdout.strip()


def test_the_revision_says_whether_the_tree_had_changes(tmp_path: Path) -> None:
    assert revision_of(tmp_path) is None
    git(tmp_path, "init", "--quiet")
    (tmp_path / "a.py").write_text("x = 1\n")
    git(tmp_path, "add", "a.py")
    git(tmp_path, "commit", "--quiet", "-m", "a")
    git(tmp_path, "tag", "v1")
    head = git(tmp_path, "rev-parse", "HEAD")
    (tmp_path / "notes.txt").write_text("not tracked")
    assert revision_of(tmp_path) == head
    (tmp_path / "a.py").write_text("x = 2\n")
    assert revision_of(tmp_path) == f"{head}-dirty"


def test_any_build_of_opencv_states_its_version(monkeypatch: pytest.MonkeyPatch) -> None:
    installed = importlib.metadata.version

    def version(name: str) -> Any:
        if "opencv" in name:
            raise importlib.metadata.PackageNotFoundError(name)
        return installed(name)

    monkeypatch.setattr(importlib.metadata, "version", version)
    assert versions()["opencv"] == cv2.__version__ and "numpy" in versions()
    before = cache._sources.__wrapped__()
    monkeypatch.setattr(cv2, "__version__", "0")
    assert cache._sources.__wrapped__() != before
