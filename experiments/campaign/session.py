"""A session of a campaign: flies the remaining runs with an engine, moves what it has flown into
place, and sums up the results."""

import os
import shutil
import socket
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from touchdown.experiments.campaign import expectations
from touchdown.experiments.campaign.directory import (
    PARTIAL,
    Shard,
    add_session,
    check_external_code,
    flown_for_s,
    flying_now,
    locked,
    parts_named,
    read_plan_file,
    settle_plan,
    sweep,
    write_failure,
)
from touchdown.experiments.campaign.executor import Engine, Event, LocalEngine
from touchdown.experiments.campaign.plan import Plan, PlannedRun, runs_of_shard
from touchdown.experiments.campaign.results_table import (
    CAMPAIGN_RUN_FILES,
    CRASHED,
    FAILED,
    RESULTS_FILE,
    ROW_FILE,
    RUNS,
    check_rows,
    finished_ids,
    is_whole,
    refresh,
    write_table,
)
from touchdown.experiments.campaign.worker import REAL_RUNNER, REMEDIES, Failure, Task
from touchdown.experiments.errors import UsageError
from touchdown.experiments.external.loading import check_external
from touchdown.experiments.io.results import load_result
from touchdown.experiments.io.run_directory import put_in_place, unknown_entries, utc_now
from touchdown.experiments.io.untrusted import inside, shown

RECORDING = "flight.rrd"
_SECONDS_PER_SCAN = 0.1


class Watcher:
    """Receives the progress of a campaign; the base class ignores it."""

    def start(self, todo: Sequence[Task], done: int, jobs: int) -> None:
        """Called before the first run; ``done`` runs were finished earlier."""

    def record(self, todo: Sequence[Task]) -> None:
        """Called before unsuccessful runs are flown once more, for their recordings."""

    def see(self, event: Event) -> None:
        """Takes an event of `Arrivals`."""

    def end(self) -> None:
        """Called after the last run, or when the campaign is stopped."""


def fly_campaign(
    plan: Plan,
    directory: Path,
    engine: Engine,
    *,
    shard: Shard | None = None,
    watcher: Watcher | None = None,
    runner: str = REAL_RUNNER,
) -> dict[str, Any]:
    """Flies the runs of a plan that ``directory`` lacks, and returns `summary` with the key
    ``missing``: the names of the runs that were to be flown and have no row at the end.

    Finished runs are never repeated; runs that crashed are tried again. Stopping it at any moment,
    by whatever means, and calling it again gives the rows of an undisturbed campaign. ``shard`` (i,
    n) flies the i-th of n parts, i from 1. Raises UsageError for a directory that is in use, that
    belongs to another campaign, or whose disk is full; for an external estimator that is not
    available, or whose code differs from that of the finished runs."""
    from touchdown.experiments.flight.wiring import check_estimator_name
    from touchdown.experiments.io.provenance import git_revision

    watcher = watcher or Watcher()
    real = runner == REAL_RUNNER
    if real:
        for name in {str(run.values["estimator"]): None for run in plan.runs}:
            check_estimator_name(name)
        for kind, name in parts_named(plan):
            check_external(name, kind)
    with locked(directory, shard):
        if real:
            check_external_code(plan, directory)
        check_rows(directory)
        for run_id in {run.run_id for run in plan.runs} - finished_ids(directory):
            check_replaceable(directory / RUNS / run_id)
        plan = settle_plan(plan, directory, git_revision())
        mine = runs_of_shard(plan, shard)
        sweep(directory, [run.run_id for run in mine], whole=shard is None)
        left = _left(mine, directory)
        session: dict[str, Any] = {
            "started_utc": utc_now(),
            "host": socket.gethostname(),
            "engine": engine.name,
            "jobs": engine.jobs,
            "shard": None if shard is None else f"{shard[0]}/{shard[1]}",
        }
        started = time.perf_counter()

        def fly(runs: Sequence[PlannedRun], *, record: bool) -> None:
            tasks = [_task(run, directory, runner, record=record) for run in runs]
            if record:
                watcher.record(tasks)
            else:
                watcher.start(tasks, len(mine) - len(tasks), engine.jobs)
            shas = {run.run_id: run.config_sha for run in runs}
            if tasks:
                engine.run(tasks, plan.limits, Arrivals(tasks, shas, directory, watcher.see).see)

        try:
            fly(left, record=False)
            if plan.record == "failures":
                fly(_unrecorded(mine, directory), record=True)
        finally:
            watcher.end()
            sweep(directory, [run.run_id for run in mine], whole=shard is None)
            session |= {"finished_utc": utc_now(), "wall_s": time.perf_counter() - started}
            session["runs"] = len(left) - len(_left(left, directory))
            if left:
                add_session(directory, session, not _without_row(plan.runs, directory))
        refresh(directory, must_write=True)
        return summary(directory) | {"missing": _without_row(mine, directory)}


def _left(runs: Sequence[PlannedRun], directory: Path) -> list[PlannedRun]:
    finished = finished_ids(directory)
    return [run for run in runs if run.run_id not in finished]


def _unrecorded(runs: Sequence[PlannedRun], directory: Path) -> list[PlannedRun]:
    finished = finished_ids(directory)
    return [
        run
        for run in runs
        if run.run_id in finished and lacks_recording(directory / RUNS / run.run_id)
    ]


def _task(run: PlannedRun, directory: Path, runner: str, *, record: bool) -> Task:
    folder = inside(directory.resolve() / PARTIAL, f"{run.run_id}.{os.getpid()}")
    return Task(
        run_id=run.run_id, values=run.values, folder=str(folder), record=record, runner=runner
    )


def _without_row(runs: Sequence[PlannedRun], directory: Path) -> list[str]:
    """Names of the runs that are neither finished nor recorded as crashed."""
    known = finished_ids(directory) | {path.stem for path in (directory / FAILED).glob("*.json")}
    return [run.run_id for run in runs if run.run_id not in known]


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


def summary(directory: Path) -> dict[str, Any]:
    """Returns the progress and the cost of a campaign.

    ``wall_s`` includes the session in progress; ``left_s`` is the time left by the mean duration
    of the finished runs, None where none is known or nobody flies.
    ``estimators`` gives processor and wall seconds of the finished runs of each, and the fraction
    of their wall time by stage: ``set_up`` is loading, building and writing, ``rest`` the loop
    itself. ``expectations`` are `experiments.campaign.expectations.Verdict`; ``as_expected``
    is true if every finished run is as expected. Raises UsageError where ``directory`` is no
    campaign.
    """
    document = read_plan_file(directory)
    verdicts = expectations.judge_campaign(directory)
    planned = {run["run_id"] for run in document["runs"]}
    rows = [row for row in refresh(directory) if row["run_id"] in planned]
    crashed = [row for row in rows if row["outcome"] == CRASHED]
    flying, remaining = flying_now(directory), len(planned) - len(rows)
    took = [row["wall_s"] for row in rows if row["wall_s"] is not None]
    known = bool(took and flying)
    return {
        "name": document["name"],
        "mode": document["mode"],
        "directory": str(directory),
        "results": str(directory / RESULTS_FILE),
        "runs": len(planned),
        "finished": len(rows) - len(crashed),
        "crashed": len(crashed),
        "remaining": remaining,
        "flying": flying,
        "left_s": remaining * fmean(took) / len(flying) if known else None,
        "outcomes": dict(sorted(Counter(row["outcome"] for row in rows).items())),
        "errors": {row["run_id"]: row["reason"] for row in crashed},
        "wall_s": sum(session["wall_s"] for session in document["sessions"])
        + (flown_for_s(directory) if flying else 0.0),
        "estimators": _costs([row for row in rows if row["outcome"] != CRASHED]),
        "git_revisions": sorted({row["git_revision"] for row in rows if row["git_revision"]}),
        "idle_conditions": expectations.idle_conditions(rows),
        "expectations": expectations.as_json(verdicts),
        "as_expected": expectations.all_as_expected(verdicts),
    }


def _costs(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Cost of the runs by estimator, in the order of their names."""
    found: dict[str, Any] = {}
    for name in sorted({row["estimator"] for row in rows}):
        mine = [row for row in rows if row["estimator"] == name and row["wall_s"] is not None]
        wall = sum(row["wall_s"] for row in mine)
        found[name] = {
            "runs": len(mine),
            "wall_s": wall,
            "cpu_s": sum(row["cpu_s"] or 0.0 for row in mine),
            "stage_fraction": _stage_fractions(mine, wall) if wall > 0 else {},
        }
    return found


def _stage_fractions(rows: Sequence[Mapping[str, Any]], wall_s: float) -> dict[str, float]:
    prefix = "timing.stage_ms."
    seconds: defaultdict[str, float] = defaultdict(float)
    for row in rows:
        loop_s, sim_s = row["timing.wall_s"] or 0.0, row["timing.sim_s"] or 0.0
        seconds["set_up"] += row["wall_s"] - loop_s
        seconds["rest"] += loop_s
        for key, ms in row.items():
            if key.startswith(prefix) and ms is not None:
                spent = 1e-3 * ms * sim_s / _SECONDS_PER_SCAN
                seconds[key.removeprefix(prefix)] += spent
                seconds["rest"] -= spent
    return {name: value / wall_s for name, value in sorted(seconds.items())}


def default_jobs() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0))


def make_engine(name: str, jobs: int | None, address: str | None = None) -> Engine:
    """The engine of that name: ``local``, or ``ray``, whose cluster is at ``address``. Raises
    UsageError when it is not available."""
    if name == "ray":
        from touchdown.experiments.campaign.executor_ray import RayEngine

        return RayEngine(jobs, address)
    if address is not None:
        raise UsageError("--ray-address goes with --engine ray")
    return LocalEngine(jobs or default_jobs())
