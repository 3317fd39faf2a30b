"""Worker process of a campaign: flies one run after the other.

A worker takes tasks from a `multiprocessing` connection in the place of its stdin and answers each
with the row of the run, or with a failure. It is started by a guard
(`touchdown.experiments.external.processes`) on the same machine, and ends with it.
"""

import contextlib
import datetime
import errno
import faulthandler
import gc
import os
import pkgutil
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from touchdown.experiments.campaign.plan import config_for, config_sha
from touchdown.experiments.campaign.results_table import make_row
from touchdown.experiments.config.schema import Config
from touchdown.experiments.errors import UsageError
from touchdown.experiments.external.processes import (
    SUPERVISOR,
    adopt_orphans,
    descendants,
    memory_bytes,
    release_memory,
)
from touchdown.experiments.io.results import RunResult
from touchdown.sim.files.child import die_with_parent

REMEDIES = {
    errno.ENOSPC: "make room, then give the same command again",
    errno.EDQUOT: "make room, then give the same command again",
    errno.EROFS: "name another --out",
}
"""Errors that end a campaign, and their remedies."""

REAL_RUNNER = "touchdown.experiments.campaign.worker:run_task"


@dataclass(frozen=True, kw_only=True, slots=True)
class Task:
    """A run to be flown."""

    run_id: str
    values: Mapping[str, Any]
    """dotted keys of the configuration"""
    folder: str
    """absolute path of the folder in which the run directory is made, as ``run_id``"""
    record: bool = False
    """a finished run is flown once more, for its recording"""
    runner: str = REAL_RUNNER
    """MODULE:FUNCTION that takes a configuration and an output directory, fills it and returns the
    result"""


@dataclass(frozen=True, slots=True)
class Failure:
    """The reason of a failed attempt. ``kind``: error (raised), input (raised for bad input), disk,
    died (crashed by itself), killed (by somebody else), time, memory."""

    kind: str
    error: str
    traceback: str = ""


def fly(task: Task) -> dict[str, Any]:
    """Flies a task into its folder and returns the row of the run. Raises whatever the flight
    raises."""
    config = config_for(task.values, f"run {task.run_id}")
    if task.record:
        config = config.model_copy(update={"record": True})
    started = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    wall, cpu = time.perf_counter(), time.process_time()
    shutil.rmtree(task.folder, ignore_errors=True)
    os.makedirs(task.folder)
    run: Callable[[Config, Path], RunResult] = pkgutil.resolve_name(task.runner)
    result = run(config, Path(task.folder) / task.run_id)
    release_memory()
    return make_row(
        result,
        task.run_id,
        "fly" if config.landing.survey_only else "land",
        config_sha(config),
        wall_s=time.perf_counter() - wall,
        cpu_s=time.process_time() - cpu,
        started_utc=started,
        worker_memory_mb=memory_bytes([os.getpid()]) / 1e6,
    )


def run_task(config: Config, out: Path) -> RunResult:
    """The runner of real campaigns: flies without progress reports."""
    # Here, as the process that starts the workers flies nothing.
    from touchdown.experiments.flight.run import fly_with_usage_errors

    return fly_with_usage_errors(config, out, lambda _time_s, _phase, _note: None)


def serve() -> None:
    """Main loop of a worker: flies the tasks that arrive until the connection ends. An answer is
    ``(row or failure, whether processes of the run are left)``, the first one tells that it is
    ready."""
    die_with_parent(int(os.environ.get(SUPERVISOR, os.getppid())))
    adopt_orphans()
    faulthandler.enable()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the supervisor decides
    connection = Connection(os.dup(0))
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)  # programs that a run starts get no tasks
    os.register_at_fork(after_in_child=connection.close)
    gc.freeze()  # what the imports made lives on: collecting after a run need not look at it
    connection.send(({}, False))
    with contextlib.suppress(EOFError):
        while True:
            task = connection.recv()
            _forget_random_state()
            answer: dict[str, Any] | Failure
            try:
                answer = fly(task)
            except Exception as error:
                answer = failure_of(error)
            # A run must not depend on processes that the run before it has left.
            connection.send((answer, bool(descendants(os.getpid()))))


def failure_of(error: Exception) -> Failure:
    """What an exception of a flight means for the campaign."""
    cause = error.__cause__ or error
    kind, text = "error", f"{type(error).__name__}: {' '.join(str(error).split())}"
    if isinstance(cause, OSError) and cause.errno in REMEDIES:
        kind, text = "disk", f"{os.strerror(cause.errno)}; {REMEDIES[cause.errno]}"
    elif isinstance(error, UsageError):
        kind, text = "input", " ".join(str(error).split())
    return Failure(kind, text, "".join(traceback.format_exception(error)))


def _forget_random_state() -> None:
    """Resets the random generator of OpenCV: a run must not depend on the runs before it."""
    if "cv2" in sys.modules:
        sys.modules["cv2"].setRNGSeed(0)
