"""The places of mutations in the source, without running their tests."""

import ast
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from mutations.places import Mutation, PlaceError, load, meaning, mutated

ROOT = Path(__file__).parents[2]
MUTATIONS = load(Path(__file__).parent)

SOURCE = '''
SCALE = 2.0


@cached
def gain(x: float,
         y: float = 1.0) -> float:
    """Äußeres"""  # a comment
    if x > 1:  # one
        return x
    elif x > 0:
        y = -y; x = 2 * x
        y = abs(y)
    for i in range(
        3
    ):
        x += i
    return (x * SCALE
            + y)


class Filter:
    size: int = 3

    def step(self):
        def inner():
            self.x = 1

        try:
            inner()
        except ValueError:
            self.x = 2
        self.x = 1
'''


def _change(function: str, statement: str, becomes: str) -> str:
    return mutated(SOURCE, Mutation("m", function, statement, becomes, ()))


@pytest.mark.parametrize(("function", "statement", "becomes", "old", "new"), [
    ("a.py", "SCALE=2.", "SCALE = 3.0", "SCALE = 2.0", "SCALE = 3.0"),
    ("a.py::gain", "return x*SCALE+y", "return y", "(x * SCALE\n            + y)", "y"),
    ("a.py::gain", "y = -y", "pass", "y = -y;", "pass;"),
    ("a.py::gain", "x = 2 * x\ny = abs(y)", "x = 0\ny = 0",
     "x = 2 * x\n        y = abs(y)", "x = 0\n        y = 0"),
    ("a.py::gain", "if x > 1:", "if True:", "if x > 1:  #", "if True:  #"),
    ("a.py::gain", "elif x > 0:", "elif True:", "elif x > 0:", "elif True:"),
    ("a.py::gain", "if x > 0:", "if True:", "elif x > 0:", "elif True:"),
    ("a.py::gain", "for i in range(3):", "for i in [1]:",
     "for i in range(\n        3\n    ):", "for i in [1]:"),
    ("a.py", "def gain(x: float, y: float = 1.0) -> float:", "def gain(y, x):",
     "def gain(x: float,\n         y: float = 1.0) -> float:", "def gain(y, x):"),
    ("a.py::Filter", "size: int = 3", "size: int = 4", "size: int = 3", "size: int = 4"),
    ("a.py::Filter.step.inner", "self.x = 1", "pass", "            self.x = 1\n\n        try",
     "            pass\n\n        try"),
    ("a.py::Filter.step", "self.x = 1", "pass", "2\n        self.x = 1", "2\n        pass"),
    ("a.py::Filter.step", "self.x = 2", "pass", "self.x = 2", "pass"),
])  # fmt: skip
def test_a_statement_is_replaced_and_nothing_else(
    function: str, statement: str, becomes: str, old: str, new: str
) -> None:
    assert SOURCE.count(old) == 1
    assert _change(function, statement, becomes) == SOURCE.replace(old, new)


@pytest.mark.parametrize(("function", "statement"), [
    ("a.py::gain", "x = 3"), ("a.py", "self.x = 1"), ("a.py::lost", "x = 2 * x"),
    ("a.py::step", "self.x = 2"), ("a.py::Filter", "def step(self, more):"),
])  # fmt: skip
def test_a_statement_that_is_not_there_is_an_error(function: str, statement: str) -> None:
    with pytest.raises(PlaceError, match=r"0 times"):
        _change(function, statement, "pass")


def test_a_statement_that_is_there_twice_is_an_error() -> None:
    twice = "def f(x):\n    x += 1\n    if x:\n        x += 1\n"
    with pytest.raises(PlaceError, match="2 times `x \\+= 1`"):
        mutated(twice, Mutation("m", "a.py::f", "x += 1", "pass", ()))


def test_each_place_is_found_once_and_each_mutant_is_a_program(tmp_path: Path) -> None:
    lost = []
    for number, mutation in enumerate(MUTATIONS):
        try:
            text = (ROOT / mutation.path).read_text(encoding="utf-8")
            changed = mutated(text, mutation)
        except (OSError, PlaceError) as error:
            lost.append(f"{mutation.name}: {error}")
            continue
        ast.parse(changed)
        assert meaning(mutation.becomes) != meaning(mutation.statement), mutation.name
        (tmp_path / f"m{number}.py").write_text(changed, encoding="utf-8")
    assert not lost, "\n".join(lost)
    command = [sys.executable, "-m", "ruff", "check", "--isolated", "--no-cache", "--quiet"]
    undefined = ["--select", "F821,F823", "--output-format", "concise", str(tmp_path)]
    done = subprocess.run([*command, *undefined], capture_output=True, text=True)
    numbers = sorted({int(part.split(".py")[0]) for part in done.stdout.split("/m")[1:]})
    assert done.returncode == 0, f"{[MUTATIONS[n].name for n in numbers]}\n{done.stdout}"


def test_names_are_unique_and_the_named_tests_exist() -> None:
    names = Counter(mutation.name for mutation in MUTATIONS)
    known: dict[Path, set[str]] = {}
    assert [name for name, count in names.items() if count > 1] == []
    for mutation in MUTATIONS:
        assert ":" in mutation.name, f"{mutation.name} names no area"
        assert mutation.tests or mutation.survives, mutation.name
        for test in mutation.tests:
            file, *names_within = test.split("::")
            path = ROOT / file
            assert path.exists(), f"{mutation.name}: {file}"
            if path not in known:
                nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
                definitions = (n for n in nodes if isinstance(n, ast.FunctionDef | ast.ClassDef))
                known[path] = {node.name for node in definitions}
            called = {name.partition("[")[0] for name in names_within}
            assert called <= known[path], f"{mutation.name}: {test}"
