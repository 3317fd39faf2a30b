"""A command in a process of its own, for commands that run code of others: code in C, or
``os._exit``, may end the process without a word."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Sequence
from typing import Any

from touchdown.experiments.external.processes import adopt_orphans, end_descendants
from touchdown.sim.files.child import die_with_parent

_COMMANDS = ("fly", "land", "check-estimator", "check-plugin")
_PASSED_ON = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_END_TIMEOUT_S = 20
"""After a signal the command may take this long for its end."""


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
    try:
        answer = os.read(reader, 8)
    except BlockingIOError:
        answer = b""
    if answer:
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
        signal.alarm(_END_TIMEOUT_S)

    for number in _PASSED_ON:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, pass_on)
    signal.signal(signal.SIGALRM, lambda _number, _frame: os.kill(child, signal.SIGKILL))
    return seen
