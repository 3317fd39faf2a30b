"""A process of its own with hard limits, for libraries in C that cannot be interrupted.

It has limited memory and processor time and no network, and ends with the process that started it.
"""

from __future__ import annotations

import ctypes
import errno
import functools
import importlib
import os
import platform
import signal
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

TRIAL_S, TRIAL_MEMORY_BYTES = 15, 4 << 30
_WAIT_S = 120.0
"""The processor time counts, not that of other programs beside it; this ends what only waits."""
NO_MEMORY = 3
"""Exit code of a process that found no memory"""
_ANSWER = b"\0answer:"
_PR_SET_PDEATHSIG, _PR_SET_SECCOMP, _PR_SET_NO_NEW_PRIVS = 1, 22, 38
_SOCKET = {"x86_64": (0xC000003E, 41), "aarch64": (0xC00000B7, 198)}
"""Architecture in a filter of system calls, and its number of the call ``socket``"""
_IO_URING_SETUP, _FOREIGN_CALLS = 425, 0x40000000


class Ended(NamedTuple):
    """The end of a process: its exit code, what it has printed, and what its function has returned;
    None where it did not return."""

    code: int
    output: bytes
    answer: str | None


def run_limited(
    function: Callable[[str], str],
    argument: str,
    data: bytes = b"",
    *,
    cpu_s: int | None = None,
    memory_bytes: int,
    wait_s: float | None = None,
) -> Ended:
    """Calls a function of a module in a new process, which reads ``data`` from its stdin.

    cpu_s: most time of a processor; wait_s: most time in all, after which TimeoutExpired is raised.
    Errors of Python in the process end it; where they are of memory its code is `NO_MEMORY`.
    """
    name = f"{function.__module__}:{function.__name__}"
    words = (name, argument, str(os.getpid()), str(memory_bytes), str(cpu_s or ""))
    done = subprocess.run(
        [sys.executable, "-P", "-m", __name__, *words],
        input=data,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        timeout=wait_s,
        check=False,
    )
    output, answered, answer = done.stdout.rpartition(_ANSWER)
    return Ended(done.returncode, output, answer.decode("utf-8") if answered else None)


@functools.lru_cache(maxsize=32)
def reason_against(check: Callable[[str], str], path: Path, _content: str, doing: str) -> str:
    """Returns the reason why a file cannot be used, "" for none.

    check: a function of a module, called with the path in a process of its own; returns a reason.
    _content: names the content of the file; it is tried once for each. doing: what takes time and
    memory, such as "to compile it".
    """
    try:
        ended = run_limited(
            check, str(path), cpu_s=TRIAL_S, memory_bytes=TRIAL_MEMORY_BYTES, wait_s=_WAIT_S
        )
    except subprocess.TimeoutExpired:
        return f"needs more than {_WAIT_S:.0f} s {doing}"
    if ended.answer is not None:
        return ended.answer.strip()
    if ended.code == -signal.SIGXCPU:
        return f"needs more than {TRIAL_S} s of a processor {doing}"
    if ended.code in (NO_MEMORY, -signal.SIGKILL):
        return f"needs more than {TRIAL_MEMORY_BYTES >> 30} GiB of memory {doing}"
    return f"ends the process that tries {doing} (exit code {ended.code})"


def die_with_parent(parent: int, number: signal.Signals = signal.SIGKILL) -> None:
    """Linux sends this process the signal ``number`` when the thread that started it, of process
    ``parent``, ends."""
    prctl(_PR_SET_PDEATHSIG, number)
    if os.getppid() != parent:
        os._exit(1)  # it was dead before


def prctl(option: int, value: int, pointer: int = 0) -> None:
    """Sets an option of this process; nothing where the system has none."""
    libc = ctypes.CDLL(None, use_errno=True)
    if hasattr(libc, "prctl"):
        libc.prctl(option, ctypes.c_ulong(value), ctypes.c_ulong(pointer), 0, 0)


def limit_process(memory_bytes: int, cpu_s: int | None = None) -> None:
    """Limits this process and what it starts, for good: memory that it writes to, time of the
    processor, no core file, and on Linux no sockets."""
    import resource

    if cpu_s is not None:
        resource.setrlimit(resource.RLIMIT_CPU, (cpu_s, cpu_s + 1))
    # Not of the address space, of which libraries reserve much and use little.
    resource.setrlimit(resource.RLIMIT_DATA, (memory_bytes, memory_bytes))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    if platform.system() == "Linux" and platform.machine() in _SOCKET:
        _refuse_sockets(*_SOCKET[platform.machine()])


def _refuse_sockets(architecture: int, socket: int) -> None:
    """A filter of system calls (seccomp), which a process cannot take off. Calls of another
    architecture end the process: they have other numbers."""
    load, equal, above, answer = 0x20, 0x15, 0x35, 0x06
    filters = (
        (load, 0, 0, 4),
        (equal, 1, 0, architecture),
        (answer, 0, 0, 0x80000000),
        (load, 0, 0, 0),
        (above, 3, 0, _FOREIGN_CALLS),
        (equal, 2, 0, socket),
        (equal, 1, 0, _IO_URING_SETUP),
        (answer, 0, 0, 0x7FFF0000),
        (answer, 0, 0, 0x00050000 | errno.EACCES),
    )
    code = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *one) for one in filters))
    program = ctypes.create_string_buffer(struct.pack("HP", len(filters), ctypes.addressof(code)))
    prctl(_PR_SET_NO_NEW_PRIVS, 1)
    prctl(_PR_SET_SECCOMP, 2, ctypes.addressof(program))


def _answer(name: str, argument: str, parent: str, memory_bytes: str, cpu_s: str) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that waits decides
    die_with_parent(int(parent))
    limit_process(int(memory_bytes), int(cpu_s) if cpu_s else None)
    module, _, function = name.partition(":")
    try:
        answer = getattr(importlib.import_module(module), function)(argument)
    except MemoryError:
        sys.exit(NO_MEMORY)
    sys.stdout.flush()
    sys.stdout.buffer.write(_ANSWER + answer.encode())


if __name__ == "__main__":
    _answer(*sys.argv[1:])
