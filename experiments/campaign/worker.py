"""Worker process of a campaign: flies runs and moves their directories into place.

A worker reads tasks from stdin and answers on stdout, one JSON object per line. It is started by
a guard (`touchdown.experiments.campaign.guard`) on the same machine, and ends with it.
"""

from __future__ import annotations

import datetime
import errno
import faulthandler
import gc
import importlib
import json
import os
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from touchdown.experiments.campaign.guard import SUPERVISOR
from touchdown.experiments.campaign.plan import config_for, config_sha
from touchdown.experiments.campaign.results_table import (
    CAMPAIGN_RUN_FILES,
    FAILED,
    ROW_FILE,
    RUNS,
    is_whole,
    make_row,
    write_table,
)
from touchdown.experiments.config.schema import Config
from touchdown.experiments.errors import UsageError
from touchdown.experiments.external.processes import (
    adopt_orphans,
    descendants,
    memory_bytes,
    release_memory,
)
from touchdown.experiments.io.foreign import inside
from touchdown.experiments.io.results import RunResult, load_result
from touchdown.experiments.io.run_directory import foreign_entries, put_in_place
from touchdown.sim.files.child import die_with_parent

PARTIAL = ".partial"
"""Folder of a campaign's directory in which runs are flown; those of dead processes are swept."""

RECORDING = "flight.rrd"
_NO_SPACE = {
    errno.ENOSPC: "make room, then give the same command again",
    errno.EDQUOT: "make room, then give the same command again",
    errno.EROFS: "name another --out",
}
"""Errors that end a campaign, and their remedies."""

REAL_RUNNER = "touchdown.experiments.campaign.worker:run_task"

Notify = Callable[[dict[str, Any]], None]


@dataclass(frozen=True, kw_only=True, slots=True)
class Task:
    """A run to be flown; serialised as JSON for workers."""

    run_id: str
    values: Mapping[str, Any]
    """dotted keys of the configuration"""
    directory: str
    """absolute, of the campaign"""
    record_failures: bool = False
    """fly an unsuccessful run once more, for its recording"""
    runner: str = REAL_RUNNER
    """MODULE:FUNCTION that takes a configuration and an output directory, fills it and returns the
    result"""

    def dump(self) -> str:
        return json.dumps(asdict(self))


def execute(task: Task, notify: Notify) -> None:
    """Flies a task unless that is done already, and reports ``finished`` through ``notify``.

    The run directory appears under ``runs/`` whole, with its row, or not at all. Raises whatever
    the flight raises.
    """
    run_dir = inside(Path(task.directory) / RUNS, task.run_id)
    config = config_for(task.values, f"run {task.run_id}")
    if is_whole(run_dir):
        result = load_result(run_dir / "result.json")
    else:
        result = _fly_into_place(task, config, run_dir)
    (Path(task.directory) / FAILED / f"{task.run_id}.json").unlink(missing_ok=True)
    notify({"event": "finished", "outcome": result.outcome, "success": result.is_success})
    if wants_recording(task, run_dir, result):
        _add_recording(task, config, run_dir)


def wants_recording(task: Task, run_dir: Path, result: RunResult) -> bool:
    """True if a finished run is to be flown again for its recording."""
    missing = not (run_dir / RECORDING).exists()
    return task.record_failures and missing and not result.is_success


def _fly_into_place(task: Task, config: Config, run_dir: Path) -> RunResult:
    """Flies and moves the run directory, with its row in it, into place."""
    started = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    wall, cpu = time.perf_counter(), time.process_time()
    staging = _staging(task)
    try:
        out = staging / task.run_id
        result = _runner(task)(config, out)
        release_memory()
        row = make_row(
            result,
            task.run_id,
            "fly" if config.landing.survey_only else "land",
            config_sha(config),
            wall_s=time.perf_counter() - wall,
            cpu_s=time.process_time() - cpu,
            started_utc=started,
            worker_memory_mb=memory_bytes([os.getpid()]) / 1e6,
        )
        write_table([row], out / ROW_FILE)
        run_dir.parent.mkdir(exist_ok=True)
        _move(out, run_dir)
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    return result


def _move(out: Path, run_dir: Path) -> None:
    if run_dir.is_dir():
        if is_whole(run_dir):
            return  # another shard was first, with the same flight
        check_replaceable(run_dir)
    put_in_place(out, run_dir, CAMPAIGN_RUN_FILES)


def check_replaceable(run_dir: Path) -> None:
    """Raises UsageError where the directory of a run holds what would be lost with it."""
    if foreign := foreign_entries(run_dir, CAMPAIGN_RUN_FILES):
        raise UsageError(
            f"'{run_dir}' holds '{foreign[0]}', which no run writes, where a run of the campaign "
            "is to be put; move it elsewhere"
        )


def _add_recording(task: Task, config: Config, run_dir: Path) -> None:
    """The same flight once more: it is the same to the bit, and now it is recorded."""
    staging = _staging(task)
    try:
        out = staging / task.run_id
        _runner(task)(config.model_copy(update={"record": True}), out)
        for name in ("truth.tum", "estimate.tum"):
            if (out / name).read_bytes() != (run_dir / name).read_bytes():
                raise RuntimeError(f"run {task.run_id} did not repeat itself: {name} differs")
        os.replace(out / RECORDING, run_dir / RECORDING)
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def _staging(task: Task) -> Path:
    path = inside(Path(task.directory) / PARTIAL, f"{task.run_id}.{os.getpid()}")
    shutil.rmtree(path, ignore_errors=True)
    path.mkdir(parents=True)
    return path


def _runner(task: Task) -> Callable[[Config, Path], RunResult]:
    module, _, function = task.runner.partition(":")
    runner: Callable[[Config, Path], RunResult] = getattr(importlib.import_module(module), function)
    return runner


def run_task(config: Config, out: Path) -> RunResult:
    """The runner of real campaigns: flies without progress reports."""
    # Here, as the process that starts the workers flies nothing.
    from touchdown.experiments.flight.run import fly_with_usage_errors

    return fly_with_usage_errors(config, out, lambda _time_s, _phase, _note: None)


# ----------------------------------------------------------------------------------------- worker


def serve() -> None:
    """Main loop of a worker: flies the tasks from stdin until it ends."""
    die_with_parent(int(os.environ.get(SUPERVISOR, os.getppid())))
    adopt_orphans()
    faulthandler.enable()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the supervisor decides
    tasks = os.fdopen(os.dup(0), encoding="utf-8")
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    # Keeps the output of libraries out of the answers, and tasks from programs that they start.
    os.dup2(2, 1)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.register_at_fork(after_in_child=lambda: os.close(answers.fileno()))

    def notify(message: dict[str, Any]) -> None:
        answers.write(json.dumps(message) + "\n")
        answers.flush()

    gc.freeze()  # what the imports made lives on: collecting after a run need not look at it
    notify({"event": "ready"})
    for line in tasks:
        _forget_random_state()
        try:
            execute(Task(**json.loads(line)), notify)
        except Exception as error:
            notify(_error_message(error))
        else:
            # A run must not depend on processes that the run before it has left.
            notify({"event": "idle", "spent": bool(descendants(os.getpid()))})


def _error_message(error: Exception) -> dict[str, Any]:
    cause = error.__cause__ or error
    text = " ".join(str(error).split())
    if isinstance(cause, OSError) and cause.errno in _NO_SPACE:
        kind, text = "disk", f"{os.strerror(cause.errno)}; {_NO_SPACE[cause.errno]}"
    elif isinstance(error, UsageError):
        kind = "input"
    else:
        kind, text = "error", f"{type(error).__name__}: {text}"
    return {
        "event": "error",
        "kind": kind,
        "error": text,
        "traceback": "".join(traceback.format_exception(error)),
    }


def _forget_random_state() -> None:
    """Resets the random generator of OpenCV: a run must not depend on the runs before it."""
    if "cv2" in sys.modules:
        sys.modules["cv2"].setRNGSeed(0)
