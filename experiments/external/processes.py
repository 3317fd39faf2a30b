"""Processes of code that is not ours: measured, guarded, and ended with all that they start.

A guard is the parent of every process that its program leaves behind, in whatever session, so that
none outlives the program. It is a small process of its own (``python -m`` this module), or the
process of a command, whose copy runs code that may end it without a word.
"""

import contextlib
import ctypes
import gc
import os
import re
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import psutil

from touchdown.sim.files.child import die_with_parent, prctl

SUPERVISOR = "TOUCHDOWN_SUPERVISOR"
"""environment variable: the process whose end a guard, or a worker, does not survive"""
_PR_SET_CHILD_SUBREAPER = 36
_END_TIMEOUT_S, _PAUSE_S = 10.0, 0.01
_SIGNAL_TIMEOUT_S = 20
"""After a signal a command may take this long for its end."""
_COMMANDS = ("fly", "land", "check-estimator", "check-plugin")
_PASSED_ON = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def adopt_orphans() -> None:
    """Makes this process the parent of all its descendants whose own parent has ended, so that none
    of them gets out of sight, not even in a session of its own. On Linux alone."""
    prctl(_PR_SET_CHILD_SUBREAPER, 1)


def descendants(pid: int) -> list[int]:
    """Process ids of the children of ``pid``, of theirs and so on, without those that have ended
    and wait to be collected. A process that is started meanwhile may be missing."""
    found = []
    with contextlib.suppress(psutil.Error):
        for child in psutil.Process(pid).children(recursive=True):
            with contextlib.suppress(psutil.Error):
                found += [child.pid] if child.status() != psutil.STATUS_ZOMBIE else []
    return found


def memory_bytes(pids: Sequence[int]) -> float:
    """Memory of processes together, bytes: their anonymous and shared pages, those that they share
    counted once. Pages of mapped files are left out: how many of them are resident depends on the
    system's page cache."""
    total = 0.0
    for pid in pids:
        try:
            text = Path(f"/proc/{pid}/smaps_rollup").read_text()
            total += sum(1024.0 * int(kb) for kb in re.findall(r"Pss_(?:Anon|Shmem): *(\d+)", text))
        except OSError:  # it has ended, or the system has no such file
            total += resident_bytes([pid])
    return total


def resident_bytes(pids: Sequence[int]) -> float:
    """At least `memory_bytes`, and quick: all resident pages of each process."""
    total = 0.0
    for pid in pids:
        with contextlib.suppress(psutil.Error):
            total += psutil.Process(pid).memory_info().rss
    return total


def release_memory() -> None:
    """Returns to the system what this process has freed: objects that refer to one another are
    collected, and free pages are given back."""
    gc.collect()
    release_pages()


def release_pages() -> None:
    """Makes the C library give back free pages, which it keeps where a block behind them is in use;
    it takes about 1 ms."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # of glibc alone
    if trim is not None:
        trim(0)


def end_descendants(pid: int, keep: frozenset[int] = frozenset()) -> None:
    """Kills the descendants of ``pid`` except ``keep``, however they defend themselves, and returns
    when none is left, or the kernel does not let go of them. Only those of this very process are
    collected."""
    deadline, seen = time.monotonic() + _END_TIMEOUT_S, set[int]()
    while left := [child for child in descendants(pid) if child not in keep]:
        seen.update(left)
        for child in left:
            with contextlib.suppress(OSError):
                os.kill(child, signal.SIGKILL)
        if time.monotonic() > deadline:
            break
        time.sleep(_PAUSE_S)
    for child in seen:
        with contextlib.suppress(OSError):
            os.waitpid(child, os.WNOHANG)


@contextlib.contextmanager
def none_left() -> Iterator[None]:
    """Ends, when the context ends, all processes that were started in it."""
    adopt_orphans()
    before = frozenset(descendants(os.getpid()))
    try:
        yield
    finally:
        end_descendants(os.getpid(), keep=before)


def guarded(program: Sequence[str]) -> tuple[list[str], dict[str, str]]:
    """Command and environment of a program under a guard that ends with this process."""
    command = [sys.executable, "-P", "-m", __name__, *program]
    return command, {**os.environ, SUPERVISOR: str(os.getpid())}


def guard(program: Sequence[str]) -> None:
    """Starts a program on the same pipes and ends as it ends, by the same signal or exit code, when
    no process of it is left. SIGTERM, or the end of the supervisor, ends them all at once."""
    signal.signal(signal.SIGTERM, _end)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the supervisor decides
    die_with_parent(int(os.environ.get(SUPERVISOR, os.getppid())), signal.SIGTERM)
    adopt_orphans()
    worker = subprocess.Popen(program, env={**os.environ, SUPERVISOR: str(os.getpid())})
    for pipe in (0, 1):
        os.close(pipe)  # they close when the worker's ends do
    code = None
    while code is None:
        pid, status = os.waitpid(-1, 0)
        if pid == worker.pid:
            code = os.waitstatus_to_exitcode(status)
    end_descendants(os.getpid())
    if code < 0:
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if code not in (-signal.SIGKILL, -signal.SIGSTOP):
            signal.signal(-code, signal.SIG_DFL)
        os.kill(os.getpid(), -code)
    os._exit(code)


def _end(_signal: int, _frame: Any) -> None:
    end_descendants(os.getpid())
    os._exit(128 + signal.SIGTERM)


def runs_external_code(arguments: Sequence[str]) -> bool:
    """True for a command that may build a part MODULE:FUNCTION."""
    words = arguments[1:]
    named = any(":" in word or word.startswith("--config") for word in words)
    return bool(words) and arguments[0] in _COMMANDS and named


def run_in_child(command: Callable[[], int]) -> tuple[int, str]:
    """Runs ``command`` in a copy of this process and returns its exit code, and the line to print
    where the copy has ended before the command: the code is 1 then. In the copy the call returns,
    too. SIGINT, SIGTERM and SIGHUP are passed on."""
    reader, writer = os.pipe()
    parent = os.getpid()
    sys.stdout.flush()
    signal.pthread_sigmask(signal.SIG_BLOCK, _PASSED_ON)  # until both can take them
    adopt_orphans()  # before the copy can leave any
    child = os.fork()
    if child == 0:
        os.close(reader)
        os.setpgid(0, 0)  # Ctrl-C reaches it once, from its parent
        die_with_parent(parent)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _PASSED_ON)
        try:
            code = command()
        except BaseException:
            os.write(writer, b"1")  # of the program: it prints its traceback
            raise
        os.write(writer, str(code).encode())
        return code, ""
    os.close(writer)
    signals = _pass_on(child)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _PASSED_ON)
    ended = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    signal.alarm(0)
    end_descendants(parent)
    os.set_blocking(reader, False)  # what it has started may hold the other end
    with contextlib.suppress(BlockingIOError):
        if answer := os.read(reader, 8):
            return int(answer), ""
    if signals:
        return 128 + signals[0], ""
    how = f"exit code {ended}" if ended >= 0 else signal.Signals(-ended).name
    return 1, (
        f"the process ended in the middle ({how}): code of an external part has ended it, or "
        "there was no memory left; a part answers or raises"
    )


def _pass_on(child: int) -> list[int]:
    """Passes signals on to ``child``, which is killed if it does not end then. Returns the list
    that they are noted in."""
    seen: list[int] = []

    def pass_on(number: int, _frame: Any) -> None:
        seen.append(number)
        os.kill(child, number)
        signal.alarm(_SIGNAL_TIMEOUT_S)

    for number in _PASSED_ON:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, pass_on)
    signal.signal(signal.SIGALRM, lambda _number, _frame: os.kill(child, signal.SIGKILL))
    return seen


if __name__ == "__main__":
    guard(sys.argv[1:])
