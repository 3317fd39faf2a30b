"""Fuzzing: every input is accepted, or refused in one line that names the remedy.

The short run is part of every test run, the long one (``-m slow``) is 28,500 cases; docs in
CONTRIBUTING. A finding is repeated by its kind and number: the same number is the same input.
"""

import contextlib
import faulthandler
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fuzz import cases, run, worker
from fuzz.kinds import KINDS

FOLDER = os.environ.get("TOUCHDOWN_FUZZ", "")
"""A folder of verdicts that long runs go on from."""


@pytest.fixture(scope="module")
def asked() -> Iterator[run.Server]:
    with run.server() as found:
        yield found


def _check(verdicts: run.Verdicts) -> None:
    print(run.table(verdicts))
    assert not (found := run.findings(verdicts)), "\n\n".join(found[:8])
    codes = Counter(verdict["code"] for verdict in verdicts)
    assert codes[2] and codes[2] < len(verdicts), f"all end in one way: {codes}"


@pytest.mark.parametrize("kind", KINDS)
def test_inputs_are_accepted_or_refused_in_one_line(kind: str, asked: run.Server) -> None:
    _check([asked.ask(kind, number) for number in range(KINDS[kind][0])])


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_many_inputs(kind: str, tmp_path: Path) -> None:
    out = Path(FOLDER) if FOLDER else tmp_path
    numbers = range(run.FIRST, run.FIRST + run.COUNT)
    _check(run.run_kind(kind, numbers, out / f"{kind}.jsonl"))


def _ended(action: Callable[[], object]) -> worker.End:
    def start() -> None:
        os.setsid()
        worker.limit()
        action()

    return worker.watched(start)


def _spin() -> None:
    while True:
        pass


def _swell() -> None:
    with contextlib.suppress(MemoryError):
        bytearray(5 << 30)
        os._exit(0)


def _crash() -> None:
    faulthandler.disable()
    os.abort()


def _desert() -> None:
    subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])


def test_what_passes_a_limit_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker, "CPU_S", 1)
    monkeypatch.setattr(worker, "WAIT_S", 5.0)
    ends = [_ended(action).status for action in (_spin, lambda: time.sleep(600), _swell)]
    assert [os.waitstatus_to_exitcode(end) for end in ends] == [
        -signal.SIGXCPU, -signal.SIGKILL, 99,
    ]  # fmt: skip


def test_a_crash_and_a_process_left_behind_are_seen() -> None:
    crashed = _ended(_crash)
    assert os.waitstatus_to_exitcode(crashed.status) == -signal.SIGABRT
    assert _ended(_desert).left == 1


@pytest.mark.parametrize(("code", "errors", "fault"), [
    (2, "touchdown: error: 'x' does not exist; name a file\n", ""),
    (0, "touchdown: warning: a thing is odd\n", ""),
    (2, "touchdown: error: one thing is bad\ntouchdown: error: two are\n", "2 lines"),
    (2, "", "0 lines"),
    (2, "libpng error: bad\ntouchdown: error: 'x' is no image; give one\n", "foreign"),
    (0, "Traceback (most recent call last)\n", "traceback"),
    (2, "touchdown: error: KeyError: 'x' in the file\n", "class name"),
    (2, "touchdown: error: the name \x1b[31m is bad\n", "ESC"), ("SIGSEGV", "", "SIGSEGV"),
    (3, "", "exit code 3"),
])  # fmt: skip
def test_ends_are_judged(code: int | str, errors: str, fault: str) -> None:
    found = cases.judge(code, errors, "")
    assert fault in " ".join(found) if fault else not found


def test_files_are_judged() -> None:
    before = {"in.txt": "1", "x": "folder", "x/keep.txt": "2"}
    assert not cases.written(0, before, {**before, "out/a": "3"}, ["out"])
    assert cases.written(0, before, {**before, "other": "3"}, ["out"])
    assert cases.written(2, before, {**before, "out/a": "3"}, ["out"])
    assert cases.written(0, before, {"in.txt": "1", "x": "folder"}, ["out"])
    assert cases.written(0, before, {**before, "x/keep.txt": "9"}, ["*"])
    assert "half" in cases.written(0, before, {**before, "out/.a.partial": "3"}, ["out"])[0]
