"""Executors of the runs of a campaign: worker processes, each watched by a supervisor.

An engine decides where workers run; a supervisor watches one of them, wherever it is: its time, its
memory, its death, and the processes that an estimator starts in it. A process pool of
`concurrent.futures` would lose all its runs with one worker, and not tell how that one died.
`experiments.campaign.executor_ray` puts the same supervisors on a Ray cluster.
"""

import contextlib
import fcntl
import multiprocessing
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol

from touchdown.experiments.campaign.campaign_file import Limits
from touchdown.experiments.campaign.worker import Failure, Task
from touchdown.experiments.external.processes import (
    descendants,
    guarded,
    memory_bytes,
    resident_bytes,
)
from touchdown.sim.opengl import rendering_backend

Event = dict[str, Any]
"""``run_id`` and ``event``: started, retry (``error``), finished (``row``; the run directory is in
the folder of the task), failed (``failure``, ``attempts``)."""

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
"""Time for the guard to end what an estimator started."""
_START_UP_S = 300.0
"""Time for a worker to load what it needs, on a machine that is busy."""
_SERVE = "from touchdown.experiments.campaign.worker import serve; serve()"


class Engine(Protocol):
    """Runs tasks somewhere. Every task ends in one ``finished`` or ``failed`` event."""

    name: str
    jobs: int

    def run(self, tasks: Sequence[Task], limits: Limits, notify: Callable[[Event], None]) -> None:
        """Returns when every task has ended. ``notify`` is called in the calling thread. Workers
        are gone when it leaves, however it does."""


class Supervisor:
    """Owns one worker process and replaces it when it is lost. Used from one thread."""

    def __init__(self, limits: Limits, stop: threading.Event | None = None) -> None:
        self._limits, self._stop = limits, stop or threading.Event()
        self._guard: subprocess.Popen[bytes] | None = None
        self._runs = 0

    def complete(self, task: Task, notify: Callable[[Event], None]) -> None:
        """Flies a task to its end, repeating what crashed."""
        crashes = kills = 0
        notify({"event": "started", "run_id": task.run_id})
        while True:
            answer = self._attempt(task)
            if answer is None:
                return
            if not isinstance(answer, Failure):
                notify({"event": "finished", "run_id": task.run_id, "row": answer})
                return
            kills += answer.kind == "killed"
            crashes += answer.kind in ("error", "died")
            may_repeat = answer.kind in ("error", "died", "killed")
            if not may_repeat or crashes > self._limits.retries or kills > MAX_KILLED:
                notify({"event": "failed", "run_id": task.run_id, "failure": answer,
                        "attempts": crashes + kills})  # fmt: skip
                return
            notify({"event": "retry", "run_id": task.run_id, "error": answer.error})

    def close(self) -> None:
        """Ends the worker, at once, and every process that it started."""
        if self._guard is None:
            return
        if self._guard.returncode is None:
            os.kill(self._guard.pid, signal.SIGTERM)  # the guard ends them all
            self._collect(self._guard)
        self._connection.close()
        self._log.close()
        self._guard = None

    # ------------------------------------------------------------------------------- one attempt

    def _attempt(self, task: Task) -> dict[str, Any] | Failure | None:
        """The row of the run, or why there is none; None when all is to stop."""
        if self._runs >= RUNS_PER_WORKER:
            self.close()
        answer: dict[str, Any] | Failure | None = {}
        if self._guard is None:
            self._start()
            answer = self._answer(_START_UP_S)
        if answer == {}:
            os.ftruncate(self._log.fileno(), 0)
            with contextlib.suppress(OSError):  # it is dead, as the answer will say
                self._connection.send(task)
            self._runs += 1
            answer = self._answer(self._limits.run_timeout_s)
        if not isinstance(answer, dict):
            self.close()
        return answer

    def _start(self) -> None:
        self._log = tempfile.TemporaryFile()  # noqa: SIM115  closed with the worker
        fcntl.fcntl(self._log, fcntl.F_SETFL, os.O_APPEND)
        self._runs = 0
        self._connection, theirs = multiprocessing.Pipe()
        path = os.pathsep.join(entry or os.getcwd() for entry in sys.path)
        command, environment = guarded([sys.executable, "-P", "-c", _SERVE])
        self._guard = subprocess.Popen(
            command,
            stdin=theirs.fileno(),
            stdout=self._log,
            stderr=self._log,
            env={**environment, **SINGLE_THREAD, "PYTHONPATH": path},
            start_new_session=True,  # Ctrl-C is for the parent
        )
        theirs.close()

    def _answer(self, limit_s: float) -> dict[str, Any] | Failure | None:
        """Follows the worker until it has answered, is dead, or is over a limit."""
        assert self._guard is not None
        since = time.monotonic()
        while not self._stop.is_set():
            # The connection may outlive the worker: in processes that a library of it forked.
            dead = self._has_ended(self._guard)  # before a look for its last words
            if self._connection.poll(0.0 if dead else _POLL_S):
                try:
                    answer, spent = self._connection.recv()
                except (EOFError, OSError):
                    return self._death(self._guard)
                if spent:
                    self.close()
                return answer  # type: ignore[no-any-return]
            if dead:
                return self._death(self._guard)
            if time.monotonic() - since > limit_s:
                return Failure("time", f"took longer than {limit_s:g} s")
            pids, limit = descendants(self._guard.pid), self._limits.memory_gb * 1e9
            if resident_bytes(pids) > limit and memory_bytes(pids) > limit:
                return Failure("memory", f"took more than {self._limits.memory_gb:g} GB of memory")
        return None

    @staticmethod
    def _has_ended(guard: subprocess.Popen[bytes]) -> bool:
        """True if the guard has ended. Its process id stays its own until it is collected."""
        flags = os.WEXITED | os.WNOHANG | os.WNOWAIT
        return os.waitid(os.P_PID, guard.pid, flags) is not None

    def _collect(self, guard: subprocess.Popen[bytes]) -> int:
        """Waits for the guard to end, with all that it guards, and returns its exit code."""
        deadline = time.monotonic() + _END_S
        while not self._has_ended(guard) and time.monotonic() < deadline:
            time.sleep(_PAUSE_S)
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(guard.pid, signal.SIGKILL)  # should somebody have killed the guard
        return guard.wait()

    def _death(self, guard: subprocess.Popen[bytes]) -> Failure:
        code = self._collect(guard)
        self._log.seek(0)
        tail = self._log.read()[-8000:].decode(errors="replace")
        if code >= 0:
            return Failure("died", f"the worker exited with code {code}", tail)
        name = signal.Signals(-code).name
        kind = "killed" if -code in (signal.SIGKILL, signal.SIGTERM) else "died"
        return Failure(kind, f"the worker was ended by {name}", tail)


class LocalEngine:
    """Worker processes on this machine, each with a thread that watches it."""

    name = "local"

    def __init__(self, jobs: int) -> None:
        self.jobs = jobs

    def run(self, tasks: Sequence[Task], limits: Limits, notify: Callable[[Event], None]) -> None:
        stop = threading.Event()
        waiting: queue.SimpleQueue[Task] = queue.SimpleQueue()
        events: queue.SimpleQueue[Event | None] = queue.SimpleQueue()
        for task in tasks:
            waiting.put(task)

        def work() -> None:
            supervisor = Supervisor(limits, stop)
            try:
                with contextlib.suppress(queue.Empty):
                    while not stop.is_set():
                        supervisor.complete(waiting.get_nowait(), events.put)
            finally:
                # The worker must be gone before this thread is: Linux kills it then anyway.
                supervisor.close()
                events.put(None)

        count = min(self.jobs, len(tasks))
        with ThreadPoolExecutor(max(1, count)) as threads:
            working = [threads.submit(work) for _ in range(count)]
            try:
                for _ in working:
                    while (event := events.get()) is not None:
                        notify(event)
            finally:
                stop.set()
        for thread in working:
            thread.result()
