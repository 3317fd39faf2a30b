"""Runs cases, each in a child of its own, under limits of memory and time.

A warm process holds all modules and forks a child for each case: what a case does to its process,
to C libraries or to the machine ends with it.
"""

import contextlib
import dataclasses
import gc
import io
import json
import os
import resource
import select
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import psutil

from touchdown.experiments.external.processes import adopt_orphans, descendants, end_descendants

from fuzz import cases, grounding, kinds
from fuzz.cases import REACHED, Case, Verdict
from fuzz.grounding import Reached

CPU_S, WAIT_S = 30, 150.0
MEMORY_BYTES = 4 << 30
"""Beside what the warm process holds. Not of addresses, of which libraries reserve gigabytes for
stacks and pools that they never touch."""
_LARGEST_FILE = 2 << 30
_CUT = 200_000
"""characters of output that are judged"""


class End(NamedTuple):
    """How a process ended."""

    status: int
    wall_s: float
    cpu_s: float
    memory_mb: int
    left: int
    """processes that it had started and that outlived it, now ended"""


_PREPARED: set[str] = set()


def answer(kind: str, number: int, home: Path, keep: bool) -> Verdict:
    """In the warm process: runs a case in ``home``; its folder goes unless ``keep``."""
    if kind not in _PREPARED:
        _prepare(kind)
        _PREPARED.add(kind)
    folder, shared = home / f"{kind}-{number}", home / "shared"
    shared.mkdir(exist_ok=True)
    verdict = run(kind, number, folder, shared)
    # what one case imports, the next ones need not
    grounding.load(*text_of(folder / "log" / "modules").split())
    gc.freeze()
    if not keep:
        shutil.rmtree(folder, ignore_errors=True)
    return verdict


def _prepare(kind: str) -> None:
    """Imports what the cases of a kind need, once."""
    grounding.install(kind in kinds.LEARNING)
    if kind in kinds.LEARNING:
        grounding.load(*grounding.LEARNING)
        import torch

        torch.set_num_threads(1)
    grounding.load(*grounding.SLOW_TO_LOAD.get(kind, ()))
    import cv2

    cv2.setNumThreads(0)  # threads of a pool are not there after a fork


def run(kind: str, number: int, folder: Path, shared: Path) -> Verdict:
    """Makes a case in the new ``folder``, runs it deep inside a folder that is watched, and returns
    the verdict. ``shared`` keeps what all cases are made from."""
    root, log = folder / "watched", folder / "log"
    work = root / "a" / "b" / "work"
    for path in (work, root / "tmp", root / "home", log):
        path.mkdir(parents=True)
    for path in (root, root / "a", root / "a" / "b", work):
        (path / "x").mkdir()
        (path / "x" / "keep.txt").write_text("somebody's")
    end = watched(lambda: _make_and_run(kind, number, folder, shared))
    errors, output = (text_of(log / name) for name in ("stderr", "stdout"))
    code: int | str = os.waitstatus_to_exitcode(end.status)
    if isinstance(code, int):
        code = "reached" if code == REACHED else signal.Signals(-code).name if code < 0 else code
    if (log / "case.json").is_file():
        tree = json.loads((log / "case.json").read_text(encoding="utf-8"))
        before = tree.pop("files")
        case = Case(**{k: tuple(v) if isinstance(v, list) else v for k, v in tree.items()})
        as_data = "--csv" in case.arguments
        faults = cases.judge(code, errors, output, as_data=as_data, noisy=case.noisy)
        base = os.path.relpath(work, root)
        writes = [w if w == "*" else os.path.normpath(f"{base}/{w}") for w in case.writes]
        faults += cases.written(code, before, cases.fingerprint(root), writes)
    else:
        case = Case(arguments=("?",))
        faults = [f"the case cannot be made: {cases.last_frame(errors)}"]
    if end.left:
        faults.append(f"left {end.left} processes behind")
    return Verdict(
        kind=kind, number=number, arguments=case.arguments, code=code,
        error=errors[:500] if code == 2 else "", faults=tuple(faults),
        wall_s=round(end.wall_s, 3), cpu_s=round(end.cpu_s, 3), memory_mb=end.memory_mb,
        text=errors[-3000:] if faults else "",
    )  # fmt: skip


def _make_and_run(kind: str, number: int, folder: Path, shared: Path) -> None:
    """In the child: what its libraries start does not reach the next case."""
    root, log = folder / "watched", folder / "log"
    os.setsid()
    for file, path in ((0, Path(os.devnull)), (1, log / "stdout"), (2, log / "stderr")):
        flags = os.O_RDONLY if file == 0 else os.O_WRONLY | os.O_CREAT | os.O_APPEND
        os.dup2(os.open(path, flags, 0o600), file)
    os.chdir(root / "a" / "b" / "work")
    os.environ.update(TMPDIR=str(root / "tmp"), HOME=str(root / "home"), COLUMNS="100")
    os.environ.pop("XDG_CACHE_HOME", None)
    tempfile.tempdir = None
    case = kinds.make(kind, number, Path.cwd(), shared)
    note = {**dataclasses.asdict(case), "files": cases.fingerprint(root)}
    (log / "case.json").write_text(json.dumps(note), encoding="utf-8")
    limit()
    code = _command(case)
    (log / "modules").write_text("\n".join(sys.modules), encoding="utf-8")
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


def _stream(number: int, errors: str) -> io.TextIOWrapper:
    """As the interpreter opens it for a file or a pipe."""
    raw = open(number, "wb", closefd=False)  # noqa: SIM115  it is open to the end
    return io.TextIOWrapper(raw, encoding="utf-8", errors=errors, write_through=number == 2)


def limit() -> None:
    """Limits this process and what it starts, for good."""
    held = psutil.Process().memory_info().data
    for kind, maximum in (
        (resource.RLIMIT_CPU, round(time.process_time()) + CPU_S),
        (resource.RLIMIT_DATA, held + MEMORY_BYTES),
        (resource.RLIMIT_FSIZE, _LARGEST_FILE),
        (resource.RLIMIT_CORE, 0),
    ):
        # SIGXCPU tells the limit of time apart; at the hard one the kernel kills.
        resource.setrlimit(kind, (maximum, maximum + (kind == resource.RLIMIT_CPU)))


def watched(start: Callable[[], None]) -> End:
    """Forks, runs ``start`` in the child, and kills it after `WAIT_S`."""
    adopt_orphans()
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
    handle = os.pidfd_open(pid)
    if not select.select([handle], [], [], WAIT_S)[0]:
        os.kill(pid, signal.SIGKILL)
    os.close(handle)
    _, status, usage = os.wait4(pid, 0)
    left = frozenset(descendants(os.getpid())) - others
    end_descendants(os.getpid(), keep=others)
    return End(
        status=status, wall_s=time.monotonic() - began, cpu_s=usage.ru_utime + usage.ru_stime,
        memory_mb=usage.ru_maxrss >> 10, left=len(left),
    )  # fmt: skip


def text_of(path: Path) -> str:
    """The end of a file's text; "" without a file."""
    with contextlib.suppress(OSError):
        return path.read_bytes()[-_CUT:].decode("utf-8", "backslashreplace")
    return ""
