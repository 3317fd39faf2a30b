"""Work on files of other people in a child process, a copy of this one with hard limits.

Libraries in C cannot be interrupted, and what they need does not follow from the size of a file.
The child has limits of memory and processor time, writes no file, opens no socket, prints nothing,
and ends with this process.
"""

import contextlib
import ctypes
import faulthandler
import os
import pickle
import resource
import select
import signal
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator
from typing import Any, NoReturn, TypeVar, cast

import psutil

Found = TypeVar("Found")

CPU_S, MEMORY_BYTES = 15, 4 << 30
WAIT_S = 120.0
"""Ends what only waits; the processor time counts, not that of other programs."""
_PR_SET_PDEATHSIG = 1


class LimitError(ValueError):
    """A file takes more than a child may take, or ends it."""


def run_limited(work: Callable[[], Found], file: object, doing: str, remedy: str) -> Found:
    """Returns what ``work`` returns, from a child process that has `CPU_S` of a processor,
    `MEMORY_BYTES` beside what this process holds, and `WAIT_S` in all.

    file, doing, remedy: of the message, such as "to compile it". Raises ValueError and OSError that
    ``work`` raises, LimitError for one line that names file, limit and remedy, and RuntimeError
    with the traceback of any other error.
    """
    reader, writer = os.pipe()
    parent = os.getpid()
    child = os.fork()
    if child == 0:
        _answer(work, writer, parent)
    os.close(writer)
    answer, waited = None, False
    try:
        with open(reader, "rb") as pipe:
            waited = not select.select([pipe], [], [], WAIT_S)[0]
            # The child has the rights of this process: what it says is trusted as much.
            with contextlib.suppress(EOFError, pickle.UnpicklingError):
                answer = None if waited else pickle.load(pipe)
    finally:
        os.kill(child, signal.SIGKILL)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if answer is not None and not isinstance(answer[1], MemoryError):
        found, error = answer
        if error is not None:
            raise error
        return cast(Found, found)
    if waited:
        reason = f"needs more than {WAIT_S:.0f} s {doing}"
    elif code == -signal.SIGXCPU:
        reason = f"needs more than {CPU_S} s of a processor {doing}"
    elif answer is not None or code == -signal.SIGKILL:
        reason = f"needs more than {MEMORY_BYTES >> 30} GiB of memory {doing}"
    else:
        reason = f"ends the process that tries {doing} (exit code {code})"
    raise LimitError(f"'{file}' {reason}; {remedy}")


def _answer(work: Callable[[], Any], writer: int, parent: int) -> NoReturn:
    """In the child: answers with a pair, what ``work`` returns and the error that it raises."""
    answer: tuple[Any, BaseException | None] = (None, None)
    try:
        die_with_parent(parent)
        faulthandler.disable()
        warnings.simplefilter("ignore")
        for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGALRM):
            signal.signal(number, signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that waits decides
        sys.stdout = sys.stderr = open(os.devnull, "w")  # noqa: SIM115  to the end of the process
        os.dup2(sys.stdout.fileno(), 1)
        os.dup2(sys.stdout.fileno(), 2)
        _limit()
        answer = (work(), None)
    except (ValueError, OSError, MemoryError) as error:
        answer = (None, error)
    except BaseException:
        answer = (None, RuntimeError(traceback.format_exc()))
    try:
        with open(writer, "wb") as pipe:
            pickle.dump(answer, pipe, pickle.HIGHEST_PROTOCOL)
    finally:
        os._exit(0)


def _limit() -> None:
    """Limits this process and what it starts, for good."""
    # Not of the address space, of which libraries reserve much and use little.
    held = getattr(psutil.Process().memory_info(), "data", 0)
    for kind, maximum in (
        (resource.RLIMIT_CPU, CPU_S),
        (resource.RLIMIT_DATA, held + MEMORY_BYTES),
        (resource.RLIMIT_FSIZE, 0),
        (resource.RLIMIT_CORE, 0),
    ):
        hard = resource.getrlimit(kind)[1]
        maximum = maximum if hard == resource.RLIM_INFINITY else min(maximum, hard)
        resource.setrlimit(kind, (maximum, hard))
    sys.addaudithook(_refuse_sockets)


@contextlib.contextmanager
def limited_memory(more_bytes: int) -> Iterator[None]:
    """Lets this process take ``more_bytes`` beyond what it has; MemoryError after that."""
    before, most = resource.getrlimit(resource.RLIMIT_DATA)
    info = psutil.Process().memory_info()
    wanted = getattr(info, "data", info.rss) + more_bytes
    least = min(one for one in (wanted, before, most) if one != resource.RLIM_INFINITY)
    resource.setrlimit(resource.RLIMIT_DATA, (least, most))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (before, most))


def _refuse_sockets(event: str, _arguments: tuple[Any, ...]) -> None:
    if event.startswith("socket."):
        raise PermissionError("a file of somebody else gets no network")


def die_with_parent(parent: int, number: signal.Signals = signal.SIGKILL) -> None:
    """Linux sends this process the signal ``number`` when the thread that started it, of process
    ``parent``, ends."""
    prctl(_PR_SET_PDEATHSIG, number)
    if os.getppid() != parent:
        os._exit(1)  # it was dead before


def prctl(option: int, value: int) -> None:
    """Sets an option of this process; nothing where the system has none."""
    libc = ctypes.CDLL(None, use_errno=True)
    if hasattr(libc, "prctl"):
        libc.prctl(option, ctypes.c_ulong(value), 0, 0, 0)
