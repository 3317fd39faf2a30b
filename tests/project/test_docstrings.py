"""Docstrings are statements: what a thing is, what it does, what it returns."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
FOLDERS = ("sim", "scenes", "estimator", "landing", "controller", "experiments", "src/touchdown")
SOURCES = sorted(
    path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py") if not path.is_symlink()
)
INDIRECT_QUESTION = re.compile(
    r"(What|Whether|How|Which|Where|When|Who|Whose|Why|Is|Are|Does|Do|Can|Has|Have)\b"
    r"(?! (a|an|the|no|every|each) [^.?]*,)"
)


def _docstrings(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """(line, text) of the docstrings of a module and of its public classes and functions."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            name = getattr(node, "name", "")
            text = ast.get_docstring(node)
            if text and not name.startswith("_"):
                yield getattr(node, "lineno", 1), text


def _id(path: Path) -> str:
    return str(path.relative_to(ROOT))


def test_docstrings_are_statements() -> None:
    for path in SOURCES:
        for line, text in _docstrings(ast.parse(path.read_text(encoding="utf-8"))):
            first = text.split("\n\n")[0].strip()
            assert not INDIRECT_QUESTION.match(first), f"{_id(path)}:{line}: {first[:80]}"
            assert not first.endswith("?"), f"{_id(path)}:{line}: {first[:80]}"
