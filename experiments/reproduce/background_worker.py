"""Background process of a reproduction: it renders on one core while flights run."""

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
from touchdown.experiments.errors import UsageError
from touchdown.sim.files.child import die_with_parent

Notes = Callable[[str], None]

_sender: Connection | None = None
"""in the background process: the end of the pipe to which it sends messages"""


def send_note(note: str) -> None:
    """Sends a message from the background process to the ``notes`` of its `BackgroundWorker`."""
    assert _sender is not None
    _sender.send(note)


class BackgroundWorker:
    """One task in a separate process, which occupies one of the slots of the flights. An error in
    the context ends the process at once."""

    def __init__(self, slots: threading.Semaphore, notes: Notes) -> None:
        self._slots, self._notes = slots, notes
        self._work: Future[None] | None = None

    def __enter__(self) -> BackgroundWorker:
        return self

    def start(self, work: Callable[..., None], *arguments: Any) -> None:
        """Starts ``work``, which must be picklable like its arguments; it may call `send_note`."""
        fresh = multiprocessing.get_context("spawn")
        receiver, sender = fresh.Pipe(duplex=False)
        self._pool: Executor = ProcessPoolExecutor(
            1, fresh, initializer=_begin, initargs=(os.getpid(), sender)
        )
        self._slots.acquire()
        self._work = self._pool.submit(work, *arguments)
        self._work.add_done_callback(lambda _work: self._slots.release())
        sender.close()  # the other process has its own: reading ends with it
        self._reader = threading.Thread(target=self._read, args=(receiver,), daemon=True)
        self._reader.start()

    def wait(self) -> None:
        """Waits for the end of the work. Raises its error; UsageError if its process was killed."""
        if self._work is None:
            return
        try:
            self._work.result()
        except BrokenProcessPool as error:
            raise UsageError(
                "the background process was killed; run the same command again to continue"
            ) from error

    def check(self) -> None:
        """Raises the error of the work, if it has ended with one."""
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

    def _read(self, receiver: Connection) -> None:
        with receiver, contextlib.suppress(EOFError, OSError):
            while True:
                self._notes(receiver.recv())


def _begin(parent: int, sender: Connection) -> None:
    """Makes the process end with its parent and ignore Ctrl-C, which the parent handles."""
    global _sender
    die_with_parent(parent)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # removes partial files
    os.environ.update(SINGLE_THREAD)
    _sender = sender
