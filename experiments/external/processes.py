"""Processes that an estimator starts: found in whatever session they are, measured, ended.

Linux only; elsewhere ``descendants`` needs no more than psutil, and orphans are not adopted.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import math
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

from touchdown.sim.files.child import prctl

_PR_SET_CHILD_SUBREAPER = 36
_END_TIMEOUT_S = 10.0
_PAUSE_S = 0.01


def adopt_orphans() -> None:
    """Makes this process the parent of all its descendants whose own parent has ended, so that none
    of them gets out of sight, not even in a session of its own."""
    prctl(_PR_SET_CHILD_SUBREAPER, 1)


def descendants(pid: int) -> list[int]:
    """Process ids of the children of ``pid``, of theirs and so on, without those that have ended
    and wait to be collected. A process that is started meanwhile may be missing."""
    found, waiting = [], [pid]
    while waiting:
        children = _children(waiting.pop())
        waiting += children
        found += [child for child in children if not _is_zombie(child)]
    return found


def memory_bytes(pids: list[int], enough: float = math.inf) -> float:
    """Memory of processes together, bytes: their anonymous and shared pages. Pages of mapped files
    are left out: how many of them are resident depends on the system's page cache. Pages that the
    processes share count once, which takes longer to find out: it is done where the plain sum
    exceeds ``enough``."""
    total = sum(map(_own_bytes, pids))
    if total <= enough or len(pids) == 1:
        return total
    return min(total, sum(map(_proportional_bytes, pids)))


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
    when none is left. Only those of this very process are collected."""
    deadline = time.monotonic() + _END_TIMEOUT_S
    while left := [child for child in descendants(pid) if child not in keep]:
        for child in left:
            with contextlib.suppress(OSError):
                os.kill(child, signal.SIGKILL)
        if time.monotonic() > deadline:
            return  # the kernel does not let go of them
        time.sleep(_PAUSE_S)
        if pid == os.getpid():
            _collect(set(_children(pid)) - keep)


@contextlib.contextmanager
def none_left() -> Iterator[None]:
    """Ends, when the context ends, all processes that were started in it."""
    adopt_orphans()
    before = frozenset(descendants(os.getpid()))
    try:
        yield
    finally:
        end_descendants(os.getpid(), keep=before)


def _children(pid: int) -> list[int]:
    try:
        threads = os.listdir(f"/proc/{pid}/task")
        texts = [Path(f"/proc/{pid}/task/{one}/children").read_text() for one in threads]
    except OSError:
        # The process or its thread has ended, or this kernel does not list children there.
        return _children_by_psutil(pid)
    return [int(word) for text in texts for word in text.split()]


def _children_by_psutil(pid: int) -> list[int]:
    import psutil

    try:
        return [child.pid for child in psutil.Process(pid).children()]
    except psutil.Error:
        return []


def _is_zombie(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].split()[0]
    except (OSError, IndexError):
        return not Path("/proc/self/stat").exists()
    return state in (b"Z", b"X")


def _own_bytes(pid: int) -> float:
    found = _sizes(f"/proc/{pid}/status", "RssAnon", "RssShmem")
    return _own_bytes_by_psutil(pid) if found is None else found


def _proportional_bytes(pid: int) -> float:
    found = _sizes(f"/proc/{pid}/smaps_rollup", "Pss_Anon", "Pss_Shmem")
    return _own_bytes(pid) if found is None else found


def _sizes(file: str, *names: str) -> float | None:
    """Sum of the sizes of these names in a file of /proc, bytes; None where one is missing."""
    try:
        lines = Path(file).read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return None
    sizes = dict(line.split(":", 1) for line in lines if ":" in line)
    if not all(name in sizes for name in names):
        return None
    return sum(1024.0 * int(sizes[name].split()[0]) for name in names)


def _own_bytes_by_psutil(pid: int) -> float:
    """Where /proc does not tell kinds of pages apart: resident memory without what is shared."""
    import psutil

    try:
        memory = psutil.Process(pid).memory_info()
    except psutil.Error:
        return 0.0
    return float(memory.rss - getattr(memory, "shared", 0))


def _collect(pids: set[int]) -> None:
    for pid in pids:
        with contextlib.suppress(OSError):
            os.waitpid(pid, os.WNOHANG)
