"""The runner on a small package."""

import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
from mutations.places import Mutation
from mutations.run import Suite, report
from mutations.trees import CRASHED, KILLED, NOT_FOUND, SURVIVED, TIMED_OUT, Outcome, Tree

FILES = {
    "pyproject.toml": "[tool.pytest.ini_options]\npythonpath = ['src']\n",
    "src/touchdown/__init__.py": "",
    "src/touchdown/sim/__init__.py": "",
    "src/touchdown/sim/model.py": "def twice(x):\n    y = 2 * x\n    z = x\n    return y\n",
    "tests/test_model.py": "from touchdown.sim.model import twice\n\n\n"
    "def test_twice():\n    assert twice(2) == 4\n",
    "tests/test_broken.py": "def test_broken():\n    assert 0\n",
}
MODEL = "sim/model.py::twice"
TEST = "tests/test_model.py"


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")  # they take a second to load
    for name, text in FILES.items():
        path = tmp_path / "project" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    subprocess.run(["git", "init", "-q", tmp_path / "project"], check=True)
    return tmp_path / "project"


def _mutation(statement: str, becomes: str, test: str = TEST, survives: str = "") -> Mutation:
    return Mutation(f"toy: {statement}, {becomes}", MODEL, statement, becomes, (test,), survives)


KILLING, VAIN = _mutation("y = 2 * x", "y = x"), _mutation("z = x", "pass")


def _run(project: Path, *mutations: Mutation, timeout_s: float = 300.0) -> list[tuple[str, str]]:
    """State and first failing test of each."""
    folder = project.parent / "runs"
    folder.mkdir(exist_ok=True)
    outcomes = Suite(project, folder, 2, timeout_s).run(list(mutations))
    found = {outcome.name: (outcome.state, outcome.seen_by) for outcome in outcomes}
    return [found[mutation.name] for mutation in mutations]


def test_mutations_are_seen_and_a_second_call_goes_on(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lost, broken = _mutation("z = y", "pass"), _mutation("return y", "return v")
    states = _run(project, KILLING, lost, broken)
    assert states[0] == (KILLED, "tests/test_model.py::test_twice - assert 2 == 4")
    assert states[1] == (NOT_FOUND, "sim/model.py::twice: 0 times `z = y`")
    assert states[2][0] == CRASHED and "NameError" in states[2][1]
    capsys.readouterr()
    assert _run(project, KILLING, VAIN, lost) == [states[0], (SURVIVED, ""), states[1]]
    (printed,) = capsys.readouterr().out.splitlines()
    assert printed.startswith(f"SURVIVED  {VAIN.name}")
    endless = _mutation("return y", "while True: pass")
    assert _run(project, endless, timeout_s=0.5) == [(TIMED_OUT, "")]
    assert all((project / name).read_text() == text for name, text in FILES.items())
    copies = list(project.parent.glob("runs/tree-?/src/touchdown/sim/model.py"))
    assert [copy.read_text() for copy in copies] == 2 * [FILES["src/touchdown/sim/model.py"]]


def test_kernels_that_hold_mutated_code_are_compiled_again(tmp_path: Path) -> None:
    """``low`` is imported by ``middle``, and that by ``top`` in a function; ``other`` is not."""
    sources = {
        "sim/low": "",
        "sim/middle": "from touchdown.sim.low import x",
        "landing/top": "def f():\n    from touchdown.sim import middle",
        "landing/low": "from touchdown.sim.lower import x",
    }
    tree = Tree(tmp_path / "tree", 1.0)
    for name, text in sources.items():
        path = tree.root / f"src/touchdown/{name}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        folder, module = name.split("/")
        kernel = tmp_path / f"tree-kernels/{folder}_1f/{module}.f-3.py311.nbi"
        kernel.parent.mkdir(parents=True, exist_ok=True)
        kernel.write_text("")
    kept = tree.kernels_without(Path("src/touchdown/sim/low.py"))
    left = [path.relative_to(kept).as_posix() for path in kept.rglob("*.nbi")]
    assert left == ["landing_1f/low.f-3.py311.nbi"]


def test_the_report_counts_and_excuses(capsys: pytest.CaptureFixture[str]) -> None:
    many = [replace(KILLING, name=f"toy: {number}") for number in range(19)]
    killed = [Outcome(m.name, KILLED, 3.0) for m in many[:-1]] + [Outcome(many[-1].name, TIMED_OUT)]
    survived = Outcome(VAIN.name, SURVIVED)
    listed = replace(VAIN, survives="z is not used")
    assert report(many, killed)
    assert not report([*many, VAIN], [*killed, survived])
    assert report([*many, listed], [*killed, survived])
    assert "toy                   19 of  20 killed" in capsys.readouterr().out
    assert not report([*many[1:], listed], [*killed[1:], survived])  # 18 of 19 are too few
    assert "z is not used" in capsys.readouterr().out
    assert not report([*many, listed], [*killed, Outcome(listed.name, NOT_FOUND)])
