"""Runs cases, each in a child of its own, under limits of memory and time.

A warm process holds all modules and forks a child for each case: what a case does to its process,
to C libraries or to the machine ends with it. Memory is measured and not rationed: RLIMIT_AS counts
addresses, of which libraries reserve gigabytes for stacks and pools that they never touch, so that
threads cannot start under a limit of 4 GB. RLIMIT_DATA, at eight times the measured limit, only
guards the machine against a single allocation between two looks.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from touchdown.experiments.external.processes import (
    adopt_orphans,
    descendants,
    end_descendants,
    memory_bytes,
)

from fuzz import cases, kinds
from fuzz.cases import REACHED, Case, Verdict
from fuzz.grounding import Reached

LIMIT_S = 30.0
"""Of processor time; also of the wall clock for a process that waits."""
LAST_S = 150.0
"""Of the wall clock, on a machine that is busy with other things."""
MEMORY_BYTES = 2 << 30
_BACKSTOP = 8 * MEMORY_BYTES
_LARGEST_FILE = 2 << 30
_LOOK_S = 0.02
_TICK = os.sysconf("SC_CLK_TCK")
_CUT = 200_000
"""characters of output that are judged"""


class UnmadeError(RuntimeError):
    """A defect of a generator."""


class Place(NamedTuple):
    """Folders of a case: ``root`` is watched; the command runs in ``work``, deep inside it."""

    root: Path
    work: Path
    tmp: Path
    home: Path
    log: Path

    @classmethod
    def make(cls, folder: Path) -> Place:
        root = folder / "watched"
        place = cls(root, root / "a" / "b" / "work", root / "tmp", root / "home", folder / "log")
        for path in (place.work, place.tmp, place.home, place.log):
            path.mkdir(parents=True)
        for path in (root, root / "a", root / "a" / "b", place.work):
            (path / "x").mkdir()
            (path / "x" / "keep.txt").write_text("somebody's")
        return place


class End(NamedTuple):
    """How a process ended. ``why``: what it was killed for, else empty."""

    status: int
    why: str
    wall_s: float
    cpu_s: float
    memory_bytes: int
    left: int
    """processes that it had started and that outlived it, now ended"""


def run(kind: str, number: int, folder: Path, shared: Path) -> Verdict:
    """Makes a case in the new ``folder``, runs it and returns the verdict. ``shared`` keeps what
    all cases are made from."""
    place = Place.make(folder)
    end = watched(lambda: _make_and_run(kind, number, place, shared))
    errors, output = (_text(place.log / name) for name in ("stderr", "stdout"))
    try:
        case, before = _made(place, errors)
    except UnmadeError:
        case, before = Case(arguments=("?",), noisy=True), {}
        end = end._replace(why=f"the case cannot be made: {cases.last_frame(errors)}")
    code: int | str = os.waitstatus_to_exitcode(end.status)
    code = "reached" if code == REACHED else code
    if isinstance(code, int) and code < 0:
        code = signal.Signals(-code).name
    faults = [end.why]
    if not end.why:
        as_data = "--csv" in case.arguments
        faults = cases.judge(code, errors, output, as_data=as_data, noisy=case.noisy)
    if end.left:
        faults.append(f"left {end.left} processes behind")
    if not end.why:
        base = os.path.relpath(place.work, place.root)
        writes = [w if w == "*" else os.path.normpath(f"{base}/{w}") for w in case.writes]
        faults += cases.written(code, before, cases.fingerprint(place.root), writes)
    return Verdict(
        kind=kind,
        number=number,
        arguments=case.arguments,
        code=code,
        error=errors[:500] if code == 2 else "",
        faults=tuple(faults),
        wall_s=round(end.wall_s, 3),
        cpu_s=round(end.cpu_s, 3),
        memory_mb=end.memory_bytes >> 20,
        text=errors[-3000:] if faults else "",
    )


def _made(place: Place, errors: str) -> tuple[Case, dict[str, str]]:
    """The case that a child has made, and the files before it ran."""
    note = place.log / "case.json"
    if not note.is_file():
        raise UnmadeError(errors)
    tree = json.loads(note.read_text(encoding="utf-8"))
    files = tree.pop("files")
    return Case(**{k: tuple(v) if isinstance(v, list) else v for k, v in tree.items()}), files


def _make_and_run(kind: str, number: int, place: Place, shared: Path) -> None:
    """In the child: what its libraries start does not reach the next case."""
    _enter(place)
    case = kinds.make(kind, number, place.work, shared)
    note = {**dataclasses.asdict(case), "files": cases.fingerprint(place.root)}
    (place.log / "case.json").write_text(json.dumps(note), encoding="utf-8")
    _limit()
    code = _command(case)
    (place.log / "modules").write_text("\n".join(sys.modules), encoding="utf-8")
    os._exit(code)


def _command(case: Case) -> int:
    """Runs a command as a new interpreter would, and returns its exit code."""
    from touchdown.experiments.cli.main import main

    sys.stdout = _stream(1, "strict")
    sys.stderr = _stream(2, "backslashreplace")
    code: Any = 1
    try:
        code = main(list(case.arguments))
    except Reached:
        code = REACHED
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except BaseException:
        traceback.print_exc()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):
            stream.flush()
    return int(code)


def _enter(place: Place) -> None:
    os.setsid()
    for number, path in ((0, os.devnull), (1, place.log / "stdout"), (2, place.log / "stderr")):
        flags = os.O_RDONLY if number == 0 else os.O_WRONLY | os.O_CREAT | os.O_APPEND
        os.dup2(os.open(path, flags, 0o600), number)
    os.chdir(place.work)
    os.environ.update(TMPDIR=str(place.tmp), HOME=str(place.home), COLUMNS="100")
    os.environ.pop("XDG_CACHE_HOME", None)
    tempfile.tempdir = None


def _limit() -> None:
    for limit, most in (
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_DATA, _BACKSTOP),
        (resource.RLIMIT_FSIZE, _LARGEST_FILE),
    ):
        resource.setrlimit(limit, (most, most))


def _stream(number: int, errors: str) -> io.TextIOWrapper:
    """As the interpreter opens it for a file or a pipe."""
    raw = open(number, "wb", closefd=False)  # noqa: SIM115  it is open to the end
    return io.TextIOWrapper(raw, encoding="utf-8", errors=errors, write_through=number == 2)


def watched(start: Callable[[], None]) -> End:
    """Forks, runs ``start`` in the child, and kills it past the limits. Memory is what the child
    takes beside the pages that this process had."""
    adopt_orphans()
    inherited = memory_bytes([os.getpid()])
    others = frozenset(descendants(os.getpid()))
    began = time.monotonic()
    pid = os.fork()
    if pid == 0:
        try:
            start()
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(99)
    why, peak, moved = "", 0.0, (began, 0.0)
    while True:
        done, status, usage = os.wait4(pid, os.WNOHANG)
        now = time.monotonic()
        if done:
            break
        memory, cpu_s = _use([one for one in descendants(os.getpid()) if one not in others])
        memory -= inherited
        peak = max(peak, memory)
        if cpu_s > moved[1] + 0.01 * (now - moved[0]):
            moved = (now, cpu_s)
        why = why or _excess(memory, cpu_s, now - began, now - moved[0])
        if why:
            os.kill(pid, signal.SIGKILL)
        # most cases end within some milliseconds
        time.sleep(min(_LOOK_S, 0.001 + 0.1 * (now - began)))
    left = frozenset(descendants(os.getpid())) - others
    end_descendants(os.getpid(), keep=others)
    return End(
        status=status,
        why=why,
        wall_s=now - began,
        cpu_s=usage.ru_utime + usage.ru_stime,
        memory_bytes=round(peak),
        left=0 if why else len(left),
    )


def _excess(memory: float, cpu_s: float, wall_s: float, idle_s: float) -> str:
    if memory > MEMORY_BYTES:
        return f"took more than {MEMORY_BYTES >> 30} GB"
    if cpu_s > LIMIT_S:
        return f"took longer than {LIMIT_S:g} s"
    if (wall_s > LIMIT_S and idle_s > 5.0) or wall_s > LAST_S:
        return f"waited longer than {LIMIT_S:g} s"
    return ""


def _use(members: list[int]) -> tuple[float, float]:
    """Memory (bytes) and processor time (s) of processes."""
    spent = 0.0
    for pid in members:
        with contextlib.suppress(OSError, ValueError, IndexError):
            fields = Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2].split()
            spent += (int(fields[11]) + int(fields[12])) / _TICK
    return memory_bytes(members, MEMORY_BYTES), spent


def _text(path: Path) -> str:
    with contextlib.suppress(OSError):
        data = path.read_bytes()
        return data[-_CUT:].decode("utf-8", "backslashreplace")
    return ""


def modules_of(folder: Path) -> list[str]:
    """Names of the modules that a case had imported at its end, in the order of their import."""
    return _text(folder / "log" / "modules").split()


def discard(folder: Path) -> None:
    """Removes the folder of a case."""
    shutil.rmtree(folder, ignore_errors=True)
