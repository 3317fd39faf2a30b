"""Arrival of runs: the row of a run that an engine calls finished is read back and compared with
the plan before the run is counted."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from touchdown.experiments.campaign.directory import write_failure
from touchdown.experiments.campaign.executor import Event
from touchdown.experiments.campaign.results_table import (
    CAMPAIGN_RUN_FILES,
    FAILED,
    RUNS,
    is_whole,
    read_row,
)
from touchdown.experiments.campaign.worker import Task
from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.foreign import shown
from touchdown.experiments.io.results import load_result
from touchdown.experiments.io.run_directory import remove_own

_POLL_S = 0.5


class Arrivals:
    """Passes the events of an engine on to ``notify``. A run that is called finished, but has no
    row of the plan's configuration in the campaign's directory, is recorded and reported as failed.
    """

    def __init__(
        self,
        tasks: Sequence[Task],
        shas: Mapping[str, str],
        patience_s: float,
        notify: Callable[[Event], None],
    ) -> None:
        """``shas``: hashes of the configurations of the runs that are to be flown; others are
        recorded once more only. ``patience_s``: a shared file system shows a new file after this
        long at most."""
        self._tasks = {task.run_id: task for task in tasks}
        self._shas = shas
        self._patience_s = patience_s
        self._notify = notify

    def see(self, event: Event) -> None:
        """Takes an event of `touchdown.experiments.campaign.executor`."""
        task = self._tasks[event["run_id"]]
        directory = Path(task.directory)
        if event["event"] == "finished":
            sha = self._shas.get(task.run_id)
            if reason := self._waited_for(directory, task.run_id, sha):
                run = directory / RUNS / task.run_id
                if sha is not None and run.is_dir() and not run.is_symlink():
                    # Of another program: it would stand for the planned run.
                    remove_own(run, CAMPAIGN_RUN_FILES)
                write_failure(task, "lost", reason, "", 1)
                event = {"event": "failed", "run_id": task.run_id, "error": reason}
        elif event["event"] == "failed":
            record = directory / FAILED / f"{task.run_id}.json"
            if not record.is_file():
                write_failure(task, "lost", str(event["error"]), "", 1)
        self._notify(event)

    def _waited_for(self, directory: Path, run_id: str, sha: str | None) -> str:
        deadline = time.monotonic() + self._patience_s
        while True:
            reason = why_not_arrived(directory, run_id, sha)
            if not reason or time.monotonic() > deadline:
                return reason
            time.sleep(_POLL_S)


def why_not_arrived(directory: Path, run_id: str, sha: str | None) -> str:
    """The reason why a run does not count: its directory is missing or incomplete, or its row is
    that of another run, result or configuration. Empty if it counts."""
    run = directory / RUNS / run_id
    if run.is_symlink() or not is_whole(run):
        return f"its row is not in '{run}', although the worker that flew it reported its end"
    try:
        row, result = read_row(run), load_result(run / "result.json")
    except UsageError as error:
        return str(error)
    if row["outcome"] != result.outcome or row["seed"] != result.seed:
        return f"its row and its result.json in '{run}' are of two flights"
    if sha is not None and row.get("config_sha") != sha:
        return (
            f"it was flown with the configuration {shown(row.get('config_sha'))} instead of "
            f"'{sha}': the worker has another version of the program; install the same one"
        )
    return ""
