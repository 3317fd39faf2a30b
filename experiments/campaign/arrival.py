"""Arrival of runs: what an engine has flown is compared with the plan and moved into place."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from touchdown.experiments.campaign.directory import write_failure
from touchdown.experiments.campaign.executor import Event
from touchdown.experiments.campaign.results_table import (
    CAMPAIGN_RUN_FILES,
    FAILED,
    ROW_FILE,
    RUNS,
    is_whole,
    write_table,
)
from touchdown.experiments.campaign.worker import REMEDIES, Failure, Task
from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.results import load_result
from touchdown.experiments.io.run_directory import put_in_place, unknown_entries
from touchdown.experiments.io.untrusted import shown

RECORDING = "flight.rrd"


class Arrivals:
    """Takes the events of an engine. A run directory appears under ``runs/`` whole, with its row,
    or not at all; a run that is not the planned one, or failed, is recorded in ``failed/``.

    ``notify`` gets the events started, retry (``error``), finished (``outcome``, ``success``),
    failed (``error``) and unrecorded (``error``)."""

    def __init__(
        self,
        tasks: Sequence[Task],
        shas: Mapping[str, str],
        directory: Path,
        notify: Callable[[Event], None],
    ) -> None:
        """``shas``: hashes of the planned configurations."""
        self._tasks = {task.run_id: task for task in tasks}
        self._shas, self._directory, self._notify = shas, directory, notify

    def see(self, event: Event) -> None:
        """Takes an event of `touchdown.experiments.campaign.executor`. Raises UsageError where the
        disk is full or read-only."""
        task = self._tasks[event["run_id"]]
        if event["event"] == "finished":
            try:
                event = self._arrived(task, event["row"])
            except UsageError as error:
                event = self._failed(task, Failure("lost", str(error)), 1)
            except OSError as error:
                if error.errno not in REMEDIES:
                    raise
                text = f"{os.strerror(error.errno)}; {REMEDIES[error.errno]}"
                raise UsageError(f"--out {self._directory}: {text}") from error
        elif event["event"] == "failed":
            event = self._failed(task, event["failure"], event["attempts"])
        if event["event"] in ("finished", "failed", "unrecorded"):
            shutil.rmtree(task.folder, ignore_errors=True)
        if not task.record or event["event"] == "unrecorded":
            self._notify(event)

    def _arrived(self, task: Task, row: Mapping[str, Any]) -> Event:
        made, run = Path(task.folder, task.run_id), self._directory / RUNS / task.run_id
        if fault := _difference(made, row, task.run_id, self._shas[task.run_id]):
            raise UsageError(fault)
        if task.record:
            self._add_recording(made, run)
        else:
            write_table([row], made / ROW_FILE)
            run.parent.mkdir(exist_ok=True)
            if not is_whole(run):  # another shard may have been first, with the same flight
                check_replaceable(run)
                put_in_place(made, run, CAMPAIGN_RUN_FILES)
            (self._directory / FAILED / f"{task.run_id}.json").unlink(missing_ok=True)
        return {"event": "finished", "run_id": task.run_id, "outcome": row["outcome"],
                "success": row["success"]}  # fmt: skip

    @staticmethod
    def _add_recording(made: Path, run: Path) -> None:
        """Takes the recording of a second flight, which is the same to the bit."""
        for name in ("truth.tum", "estimate.tum"):
            if (made / name).read_bytes() != (run / name).read_bytes():
                raise UsageError(f"it did not repeat itself: {name} differs")
        os.replace(made / RECORDING, run / RECORDING)

    def _failed(self, task: Task, failure: Failure, attempts: int) -> Event:
        if failure.kind == "disk":
            raise UsageError(f"--out {self._directory}: {failure.error}") from OSError(
                failure.error
            )
        if task.record:
            return {"event": "unrecorded", "run_id": task.run_id, "error": failure.error}
        write_failure(self._directory, task, failure, attempts)
        return {"event": "failed", "run_id": task.run_id, "error": failure.error}


def _difference(made: Path, row: Mapping[str, Any], run_id: str, sha: str) -> str:
    """The reason why a flown run is not the planned one: its directory is incomplete, or its row is
    that of another run, result or configuration. "" if it is."""
    result = load_result(made / "result.json")
    if row["run_id"] != run_id:
        return f"the row that came back is of the run {shown(row['run_id'])}"
    if (row["outcome"], row["seed"]) != (result.outcome, result.seed):
        return "its row and its result.json are of two flights"
    if row["config_sha"] != sha:
        return (
            f"it was flown with the configuration {shown(row['config_sha'])} instead of '{sha}': "
            "the worker has another version of the program; install the same one"
        )
    return ""


def check_replaceable(run_dir: Path) -> None:
    """Raises UsageError where the directory of a run holds what would be lost with it."""
    if run_dir.is_dir() and (unknown := unknown_entries(run_dir, CAMPAIGN_RUN_FILES)):
        raise UsageError(
            f"'{run_dir}' holds '{unknown[0]}', which no run writes, where a run of the campaign "
            "is to be put; move it elsewhere"
        )


def lacks_recording(run_dir: Path) -> bool:
    """True if a finished run was unsuccessful and has no recording."""
    return (
        not (run_dir / RECORDING).exists() and not load_result(run_dir / "result.json").is_success
    )
