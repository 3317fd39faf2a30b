"""Fuzzing: every input is accepted, or refused in one line that names the remedy.

The short run is part of every test run, the long one (``-m slow``) is ten thousand cases. A finding
is repeated by its kind and number: the same number is the same input.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from fuzz import fuzz_files as files
from fuzz import fuzz_inputs as inputs
from fuzz import fuzz_runs as runs
from fuzz import fuzzing
from fuzz.fuzzing import Case

MEMORY_BYTES = 9 << 30
SHORT = {"set": 150, "config": 80, "campaign": 60, "argv": 40, "mjcf": 8, "runs": 15, "files": 6}
LONG = {
    "set": 2800,
    "config": 1800,
    "campaign": 1800,
    "argv": 1400,
    "mjcf": 700,
    "runs": 800,
    "files": 300,
    "learn": 100,
}
WHOLE = 300
"""Number of inputs run as separate commands."""
PYTHON = (sys.executable, "-m", "touchdown")


@pytest.fixture(scope="module", autouse=True)
def _limited() -> Iterator[None]:
    """Imports modules before the first time limit starts, and limits the memory of an input."""
    fuzzing.import_heavy()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, hard))
    yield
    resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def _makers(home: Path) -> dict[str, Callable[[np.random.Generator, Path], Case]]:
    return {
        "set": inputs.set_case,
        "config": inputs.config_case,
        "campaign": inputs.campaign_case,
        "argv": inputs.argv_case,
        "mjcf": files.mjcf_case,
        "runs": runs.run_case_of(home),
        "files": files.file_case_of(home),
        "learn": files.learn_case,
    }


def _case(kind: str, number: int, home: Path) -> Case:
    folder = home / f"{kind}{number}"
    folder.mkdir()
    rng = np.random.default_rng([number, len(kind), sum(map(ord, kind))])
    return _makers(home)[kind](rng, folder)


def _run(kind: str, numbers: range, home: Path) -> None:
    if kind == "learn":
        fuzzing.import_heavy("touchdown.landing.classification.learning.training")
    codes: Counter[int | str] = Counter()
    found = []
    with fuzzing.grounded(compile_files=kind != "argv"):
        for number in numbers:
            case = _case(kind, number, home)
            verdict = fuzzing.run_case(case)
            codes[verdict.code] += 1
            if verdict.faults:
                line = fuzzing.as_text(case.arguments)
                found.append(f"{kind} {number}: touchdown {line}\n" + "\n".join(verdict.faults))
    print(kind, dict(codes))
    assert not found, f"{len(found)} of {len(numbers)}:\n\n" + "\n\n".join(found[:5])
    # Both accepted and refused inputs occur, except for commands that need a network file.
    assert codes[2] and (kind == "learn" or sum(codes.values()) > codes[2]), codes


@pytest.mark.parametrize("kind", [kind for kind in SHORT if kind not in ("mjcf", "files")])
def test_inputs_are_accepted_or_refused_in_one_line(kind: str, tmp_path: Path) -> None:
    _run(kind, range(SHORT[kind]), tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(LONG))
def test_ten_thousand_inputs(kind: str, tmp_path: Path) -> None:
    _run(kind, range(10_000, 10_000 + LONG[kind]), tmp_path)


@pytest.mark.slow
def test_whole_commands(tmp_path: Path) -> None:
    """In separate processes, with the output and the signals of C libraries."""
    kinds = ("argv", "mjcf", "config", "campaign", "runs", "files")
    found = []
    for number in range(WHOLE):
        case = _case(kinds[number % len(kinds)], 50_000 + number, tmp_path)
        verdict = whole_command(case)
        if verdict:
            found.append(f"{case.kind} {number}: {fuzzing.as_text(case.arguments)}\n{verdict}")
    assert not found, "\n\n".join(found[:5])


def whole_command(case: Case) -> str:
    """Returns the faults in the end of a command in a separate process, without flights."""
    before = fuzzing.fingerprint(case.folder)
    script = (
        "import sys; from fuzz import fuzzing; from touchdown.experiments import cli\n"
        f"with fuzzing.grounded({case.kind != 'argv'}):\n"
        "    try:\n        code = cli.main(sys.argv[1:])\n"
        "    except fuzzing.Reached:\n        code = 77\n"
        "sys.exit(code)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, *case.arguments],
        cwd=case.folder,
        env={**os.environ, "PYTHONPATH": str(inputs.ROOT)},
        capture_output=True,
        timeout=300,
        check=False,
    )
    code: int | str = "reached" if done.returncode == 77 else done.returncode
    stderr = done.stderr.decode("utf-8", "backslashreplace")
    faults = fuzzing.judge(code, stderr)
    faults += fuzzing.written(code, before, fuzzing.fingerprint(case.folder))
    return "\n".join(faults)
