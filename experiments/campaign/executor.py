"""Executors of the runs of a campaign: worker processes, each watched by a supervisor.

An engine decides where workers run; a supervisor watches one of them, wherever it is: its time, its
memory, its death, and the processes that an estimator starts in it.
`experiments.campaign.executor_ray` puts the same supervisors on a Ray cluster.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import queue
import select
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Protocol

from touchdown.experiments.campaign.directory import clear_partial, write_failure
from touchdown.experiments.campaign.guard import SUPERVISOR
from touchdown.experiments.campaign.plan import Limits
from touchdown.experiments.campaign.worker import Task
from touchdown.experiments.external.processes import descendants, memory_bytes
from touchdown.experiments.flight.platform import rendering_backend

Event = dict[str, Any]
"""``run_id`` and ``event``: started, finished (``outcome``, ``success``), failed (``error``), retry
(``error``), unrecorded (``error``)."""

SINGLE_THREAD = {
    **dict.fromkeys(
        (
            "OMP_NUM_THREADS",
            "OPENBLAS_NUM_THREADS",
            "MKL_NUM_THREADS",
            "NUMBA_NUM_THREADS",
            "NUMEXPR_NUM_THREADS",
            "OPENCV_FOR_THREADS_NUM",
            "RAYON_NUM_THREADS",
            "TBB_NUM_THREADS",
        ),
        "1",
    ),
    "LP_NUM_THREADS": "0",  # Mesa's rasteriser draws on the calling thread
    "MUJOCO_GL": rendering_backend(),
}
"""Environment of a worker: as many of them run as there are cores."""

RUNS_PER_WORKER = 50
"""A worker is replaced after so many runs, whatever the libraries forgot to free."""

MAX_KILLED = 5
"""Times that a run is started over since somebody else killed its worker."""

_POLL_S, _PAUSE_S = 0.25, 0.005
_END_S = 15.0
"""for the guard to end what an estimator started"""
_START_UP_S = 300.0
"""for a worker to load what it needs, on a machine that is busy"""


class Engine(Protocol):
    """Runs tasks somewhere. Every task ends in one ``finished`` or ``failed`` event."""

    name: str
    jobs: int
    patience_s: float
    """until files that its workers have written are seen here"""

    def run(self, tasks: Sequence[Task], limits: Limits, notify: Callable[[Event], None]) -> None:
        """Returns when every task has ended. ``notify`` is called in the calling thread. Raises
        EngineStoppedError when going on makes no sense. Workers are gone when it leaves, however
        it does."""


class EngineStoppedError(RuntimeError):
    """Going on with the campaign makes no sense: its disk is full or read-only."""


@dataclass(frozen=True, slots=True)
class Failure:
    """The reason of a failed attempt. ``kind``: error (raised), input (raised for bad input), disk,
    died (crashed by itself), killed (by somebody else), time, memory."""

    kind: str
    error: str
    traceback: str = ""


_GUARD = (
    "import sys; sys.path.sort(key=lambda entry: entry == ''); "  # here comes last: hides nothing
    "from touchdown.experiments.campaign.guard import guard; guard()"
)


def local_environment() -> dict[str, str]:
    """The environment of workers here: one thread each, and modules found as in this process."""
    path = os.pathsep.join(entry or os.getcwd() for entry in sys.path)
    return {**os.environ, **SINGLE_THREAD, "PYTHONPATH": path}


class Supervisor:
    """Owns one worker process and replaces it when it is lost. Used from one thread."""

    def __init__(
        self,
        limits: Limits,
        environment: Mapping[str, str],
        directory: str,
        stop: threading.Event | None = None,
    ) -> None:
        """``directory`` is the one that relative paths of scenes start from."""
        self._limits = limits
        self._environment = dict(environment)
        self._directory = directory
        self._stop = stop or threading.Event()
        self._worker: subprocess.Popen[bytes] | None = None
        self._log: IO[bytes] | None = None
        self._runs = 0

    def complete(self, task: Task, notify: Callable[[Event], None]) -> None:
        """Flies a task to its end, repeating what crashed, and records what crashed too often."""
        crashes = kills = 0
        notify({"event": "started", "run_id": task.run_id})
        finished = False

        def note(event: Event) -> None:
            nonlocal finished
            finished = True
            notify({**event, "run_id": task.run_id})

        while not self._stop.is_set():
            failure = self._attempt(task, note)
            if failure is None or self._stop.is_set():
                return
            if finished:
                notify({"event": "unrecorded", "run_id": task.run_id, "error": failure.error})
                return
            if failure.kind == "disk":
                raise EngineStoppedError(failure.error)
            kills += failure.kind == "killed"
            crashes += failure.kind in ("error", "died")
            may_repeat = failure.kind in ("error", "died", "killed")
            if not may_repeat or crashes > self._limits.retries or kills > MAX_KILLED:
                write_failure(task, failure.kind, failure.error, failure.traceback, crashes + kills)
                notify({"event": "failed", "run_id": task.run_id, "error": failure.error})
                return
            notify({"event": "retry", "run_id": task.run_id, "error": failure.error})

    def close(self) -> None:
        """Ends the worker, at once, and every process that it started."""
        if self._worker is not None:
            if self._worker.returncode is None:
                os.kill(self._worker.pid, signal.SIGTERM)  # the guard, which ends them all
                self._collect()
            for pipe in (self._worker.stdin, self._worker.stdout, self._log):
                if pipe is not None:
                    with contextlib.suppress(OSError):
                        pipe.close()
        self._worker = None

    # ------------------------------------------------------------------------------- one attempt

    def _attempt(self, task: Task, note: Callable[[Event], None]) -> Failure | None:
        """None when the task is done, or when all is to stop."""
        if self._runs >= RUNS_PER_WORKER:
            self.close()
        failure = None
        try:
            if self._worker is None:
                self._start()
                failure = self._watch(note, _START_UP_S)
            if failure is None and not self._stop.is_set():
                self._give(task)
                failure = self._watch(note, self._limits.run_timeout_s)
        except BrokenPipeError:
            failure = self._death()
        if failure is not None or self._stop.is_set():
            self.close()
            clear_partial(Path(task.directory), task.run_id)
        return failure

    def _give(self, task: Task) -> None:
        assert self._worker and self._worker.stdin and self._log
        os.ftruncate(self._log.fileno(), 0)
        self._worker.stdin.write(task.dump().encode() + b"\n")
        self._worker.stdin.flush()
        self._runs += 1

    def _watch(self, note: Callable[[Event], None], limit_s: float) -> Failure | None:
        """Follows the worker until it can take a task, is dead, or is over a limit."""
        assert self._worker and self._worker.stdout
        pipe, since, rest = self._worker.stdout, time.monotonic(), b""
        while not self._stop.is_set():
            # The pipe may outlive the worker: in processes that a library of it forked.
            dead = self._has_ended()  # before a look for its last words
            if select.select([pipe], [], [], 0.0 if dead else _POLL_S)[0]:
                chunk = os.read(pipe.fileno(), 65536)
                if not chunk:
                    return self._death()
                *lines, rest = (rest + chunk).split(b"\n")
                for message in map(json.loads, lines):
                    if message["event"] in ("ready", "idle"):
                        if message.get("spent"):
                            self.close()
                        return None
                    if message["event"] == "error":
                        return Failure(message["kind"], message["error"], message["traceback"])
                    note(message)
                    since = time.monotonic()  # what follows is the recording
            elif dead:
                return self._death()
            if time.monotonic() - since > limit_s:
                return Failure("time", f"took longer than {limit_s:g} s")
            limit = self._limits.memory_gb * 1e9
            if memory_bytes(descendants(self._worker.pid), limit) > limit:
                return Failure("memory", f"took more than {self._limits.memory_gb:g} GB of memory")
        return None

    def _start(self) -> None:
        self._log = tempfile.TemporaryFile()  # noqa: SIM115  closed with the worker
        fcntl.fcntl(self._log, fcntl.F_SETFL, os.O_APPEND)
        self._runs = 0
        self._worker = subprocess.Popen(
            [sys.executable, "-c", _GUARD],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            env={**self._environment, SUPERVISOR: str(os.getpid())},
            cwd=self._directory,
            start_new_session=True,  # Ctrl-C is for the parent
        )

    def _has_ended(self) -> bool:
        """True if the guard has ended. Its process id stays its own until it is collected."""
        assert self._worker
        flags = os.WEXITED | os.WNOHANG | os.WNOWAIT
        return os.waitid(os.P_PID, self._worker.pid, flags) is not None

    def _collect(self) -> int:
        """Waits for the guard to end, with all that it guards, and returns its exit code."""
        assert self._worker
        deadline = time.monotonic() + _END_S
        while not self._has_ended() and time.monotonic() < deadline:
            time.sleep(_PAUSE_S)
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._worker.pid, signal.SIGKILL)  # should somebody have killed the guard
        return self._worker.wait()

    def _death(self) -> Failure:
        assert self._log
        code = self._collect()
        self._log.seek(0)
        tail = self._log.read()[-8000:].decode(errors="replace")
        if code >= 0:
            return Failure("died", f"the worker exited with code {code}", tail)
        name = signal.Signals(-code).name
        kind = "killed" if -code in (signal.SIGKILL, signal.SIGTERM) else "died"
        return Failure(kind, f"the worker was ended by {name}", tail)


# ------------------------------------------------------------------------------------------ local


class LocalEngine:
    """Worker processes on this machine, each with a thread that watches it."""

    name = "local"
    patience_s = 0.0

    def __init__(self, jobs: int, slots: threading.Semaphore | None = None) -> None:
        """A run is begun when one of the ``slots`` is free, which others may take too."""
        self.jobs = jobs
        self._slots = slots or threading.Semaphore(jobs)

    def run(self, tasks: Sequence[Task], limits: Limits, notify: Callable[[Event], None]) -> None:
        stop = threading.Event()
        waiting: queue.SimpleQueue[Task] = queue.SimpleQueue()
        events: queue.SimpleQueue[Event | BaseException | None] = queue.SimpleQueue()
        for task in tasks:
            waiting.put(task)

        def work() -> None:
            supervisor = Supervisor(limits, local_environment(), os.getcwd(), stop)
            try:
                while not stop.is_set():
                    if self._slots.acquire(timeout=_POLL_S):
                        try:
                            supervisor.complete(waiting.get_nowait(), events.put)
                        finally:
                            self._slots.release()
            except queue.Empty:
                pass
            except BaseException as error:
                events.put(error)
            finally:
                # The worker must be gone before this thread is: Linux kills it then anyway.
                supervisor.close()
                events.put(None)

        threads = [threading.Thread(target=work) for _ in range(min(self.jobs, len(tasks)))]
        for thread in threads:
            thread.start()
        try:
            working = len(threads)
            while working:
                event = events.get()
                if isinstance(event, BaseException):
                    raise event
                if event is None:
                    working -= 1
                else:
                    notify(event)
        finally:
            stop.set()
            for thread in threads:
                thread.join()
