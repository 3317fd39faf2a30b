"""A process beside the flights of a reproduction: it draws while they are flown, on one core."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any

from touchdown.experiments.campaign.executor import SINGLE_THREAD
from touchdown.experiments.campaign.worker import die_with_parent
from touchdown.experiments.errors import UsageError

Notes = Callable[[str], None]

_teller: Connection | None = None
"""in the process beside: where it sends what it notes"""


def tell(note: str) -> None:
    """Of the process beside, to the ``notes`` of its `Beside`."""
    assert _teller is not None
    _teller.send(note)


class Beside:
    """One piece of work in a process of its own, which takes one of the slots that flights wait
    for. Leaving the context by an error ends the process at once."""

    def __init__(self, slots: threading.Semaphore, notes: Notes) -> None:
        self._slots, self._notes = slots, notes
        self._work: Future[None] | None = None

    def __enter__(self) -> Beside:
        return self

    def start(self, work: Callable[..., None], *arguments: Any) -> None:
        """``work`` and its arguments must be picklable; it may `tell`."""
        fresh = multiprocessing.get_context("spawn")
        told, teller = fresh.Pipe(duplex=False)
        self._pool: Executor = ProcessPoolExecutor(
            1, fresh, initializer=_begin, initargs=(os.getpid(), teller)
        )
        self._slots.acquire()
        self._work = self._pool.submit(work, *arguments)
        self._work.add_done_callback(lambda _work: self._slots.release())
        teller.close()  # the other process has its own: when that is gone, reading ends
        self._reader = threading.Thread(target=self._read, args=(told,), daemon=True)
        self._reader.start()

    def wait(self) -> None:
        """Until the work is done. Raises what it raised; UsageError when its process was killed."""
        if self._work is None:
            return
        try:
            self._work.result()
        except BrokenProcessPool as error:
            raise UsageError(
                "the process that draws beside the flights was ended from outside; the same "
                "command goes on where it was"
            ) from error

    def check(self) -> None:
        """Raises what the work raised, if it has ended."""
        if self._work is not None and self._work.done():
            self.wait()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._work is None:
            return
        if kind is not None:
            for process in multiprocessing.active_children():
                process.terminate()
        self._pool.shutdown(cancel_futures=True)
        self._reader.join()

    def _read(self, told: Connection) -> None:
        with told, contextlib.suppress(EOFError, OSError):
            while True:
                self._notes(told.recv())


def _begin(parent: int, teller: Connection) -> None:
    """Without its parent the process is gone, and Ctrl-C is for the parent."""
    global _teller
    die_with_parent(parent)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # what is half-written is taken away
    os.environ.update(SINGLE_THREAD)
    _teller = teller
