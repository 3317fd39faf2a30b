"""The directory of a campaign: who may write to it, what it was made for, what is left of runs."""

import contextlib
import fcntl
import json
import os
import shutil
import socket
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from touchdown.experiments.campaign.campaign_file import Expect
from touchdown.experiments.campaign.plan import Plan, PlannedRun, config_for, config_sha
from touchdown.experiments.campaign.results_table import FAILED, RESULTS_FILE, RUNS, refresh
from touchdown.experiments.campaign.worker import Failure, Task
from touchdown.experiments.config.keys import flatten
from touchdown.experiments.config.slots import SLOTS, names_code
from touchdown.experiments.errors import UsageError, reason_of
from touchdown.experiments.external.loading import code_now
from touchdown.experiments.io.run_directory import clear_partials, utc_now, write_text
from touchdown.experiments.io.untrusted import (
    inside,
    is_plain_name,
    read_object,
    refuse_links,
    shown,
)
from touchdown.scenes.api import names_function

PLAN_FILE, SOURCE_FILE, LOCK_FILE = "campaign.json", "campaign.toml", ".lock"
PARTIAL = ".partial"
"""Folder of a campaign's directory in which runs are flown; those of dead processes are swept."""
Shard = tuple[int, int]
_Number = Annotated[float, Field(gt=-1e300, lt=1e300)]


_OWN = (
    LOCK_FILE, PARTIAL, RUNS, FAILED, PLAN_FILE, SOURCE_FILE, RESULTS_FILE,
    f".{PLAN_FILE}", f".{SOURCE_FILE}", f".{RESULTS_FILE}",
)  # fmt: skip
"""Beginnings of the names of all that a campaign writes into its directory."""


@contextlib.contextmanager
def locked(directory: Path, shard: Shard | None) -> Iterator[None]:
    """Makes the directory and keeps others from flying into it, as long as this process lives.

    A whole campaign excludes everybody, a shard excludes the same shard. Raises UsageError, one
    line, before anything is written into a directory of something else.
    """
    if directory.exists():
        _check_is_ours(directory)
    with contextlib.ExitStack() as held:
        try:
            directory.mkdir(parents=True, exist_ok=True)
            held.enter_context(_flock(directory / LOCK_FILE, shared=shard is not None))
            if shard is not None:
                name = f"{LOCK_FILE}-{shard[0]}-of-{shard[1]}"
                held.enter_context(_flock(directory / name, shared=False))
        except BlockingIOError:
            raise UsageError(
                f"'{directory}' is being flown by {_holder(directory)}; wait for it, or name "
                "another --out"
            ) from None
        except OSError as error:
            raise UsageError(f"--out {directory}: {error.strerror}") from error
        yield


@contextlib.contextmanager
def _flock(path: Path, *, shared: bool, sign: bool = True) -> Iterator[None]:
    with path.open("a+" if sign else "r", encoding="utf-8") as file:
        fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
        if sign and not shared:
            file.truncate(0)
            file.write(f"process {os.getpid()} on {socket.gethostname()}")
            file.flush()
        yield


def _holder(directory: Path) -> str:
    with contextlib.suppress(OSError):
        if holder := (directory / LOCK_FILE).read_text(encoding="utf-8"):
            return f"another campaign ({holder})"
    return "another campaign"


def _check_is_ours(directory: Path) -> None:
    if not directory.is_dir():
        raise UsageError(f"--out {directory}: is a file; name a new directory")
    if not (directory / PLAN_FILE).is_file():
        # A campaign that was killed in its first moment leaves these.
        marks = (".lock", ".campaign")
        others = [p.name for p in directory.iterdir() if not p.name.startswith(marks)]
        if set(others) - {SOURCE_FILE}:
            raise UsageError(
                f"--out {directory}: holds something that is no campaign; name another directory"
            )
    check_plain(directory)


def check_plain(directory: Path) -> None:
    """Raises UsageError where a campaign would write, replace or remove through a link, or where a
    file stands in the place of one of its folders."""
    own = [path for path in directory.iterdir() if path.name.startswith(_OWN)]
    refuse_links(own, "a campaign")
    for name in (RUNS, FAILED, PARTIAL):
        folder = directory / name
        if folder.is_dir():
            refuse_links(folder.iterdir(), "a campaign")
        elif folder.exists():
            raise UsageError(f"'{folder}' is a file where a campaign has a folder; remove it")


def read_plan_file(directory: Path) -> dict[str, Any]:
    """``campaign.json``. Raises UsageError where there is none."""
    path = directory / PLAN_FILE
    try:
        document = read_object(path)
    except (FileNotFoundError, NotADirectoryError):
        raise UsageError(f"'{directory}' is no campaign: it holds no {PLAN_FILE}") from None
    except (OSError, ValueError) as error:
        raise UsageError(f"'{path}' cannot be read: {reason_of(error)}") from None
    try:
        _WrittenPlan.model_validate(document, extra="ignore")
    except ValidationError:
        raise UsageError(
            f"'{path}' is damaged or of another program; name another directory, or the campaign's "
            "own"
        ) from None
    names = [run["run_id"] for run in document["runs"]]
    strange = next((name for name in names if not is_plain_name(name)), None)
    if strange is not None or len(set(names)) < len(names):
        fault = "gives two runs one name" if strange is None else f"calls a run {shown(strange)}"
        raise UsageError(
            f"'{path}' {fault}, which no campaign does: it is damaged or of another program; name "
            "another directory"
        )
    return document


class _Written(BaseModel):
    """What `settle_plan` and `add_session` write, as far as it is read back."""

    model_config = ConfigDict(strict=True)


class _WrittenRun(_Written):
    run_id: str
    values: dict[str, Any]


class _WrittenSession(_Written):
    wall_s: _Number


class _WrittenPlan(_Written):
    name: str
    mode: str
    git_revision: Any
    created_utc: str
    sessions: list[_WrittenSession]
    runs: list[_WrittenRun]
    expect: list[Expect] | None = None


def settle_plan(plan: Plan, directory: Path, git_revision: str | None) -> Plan:
    """Writes the plan down, or compares it with the one that the directory was made for.

    A later plan may have more runs; those of before must all be in it, and keep their names.
    Raises UsageError naming what differs.
    """
    document: dict[str, Any] = {
        "name": plan.name,
        "git_revision": git_revision,
        "created_utc": utc_now(),
        "finished_utc": None,
        "sessions": [],
    }
    if (directory / PLAN_FILE).is_file():
        before = read_plan_file(directory)
        plan = replace(plan, runs=_merged(plan.runs, before["runs"], directory))
        document |= {key: before[key] for key in ("git_revision", "created_utc", "sessions")}
    document |= {
        "mode": plan.mode,
        "record": plan.record,
        "limits": plan.limits.model_dump(),
        "expect": [expectation.model_dump(mode="json") for expectation in plan.expect],
        "runs": [
            {"run_id": run.run_id, "values": dict(run.values), "config_sha": run.config_sha}
            for run in plan.runs
        ],
    }
    write_text(directory / SOURCE_FILE, plan.text)
    write_plan_file(directory, document)
    return plan


def write_plan_file(directory: Path, document: Mapping[str, Any]) -> None:
    write_text(directory / PLAN_FILE, json.dumps(document, indent=1) + "\n")


def add_session(directory: Path, session: Mapping[str, Any], complete: bool) -> None:
    """Notes in ``campaign.json`` who flew when. Shards take turns."""
    with (directory / f"{LOCK_FILE}-sessions").open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        document = read_plan_file(directory)
        document["sessions"].append(dict(session))
        document["finished_utc"] = utc_now() if complete else None
        write_plan_file(directory, document)


def _merged(
    runs: Sequence[PlannedRun], before: Sequence[Mapping[str, Any]], directory: Path
) -> tuple[PlannedRun, ...]:
    """``runs`` under the names that they had, which lengthen when an axis gets a second value."""
    # Compared as today's program understands them: defaults may have changed since.
    source = str(directory / PLAN_FILE)
    known = [config_sha(config_for(old["values"], source), but=("record",)) for old in before]
    names = {sha: old["run_id"] for sha, old in zip(known, before, strict=True)}
    planned = [config_sha(config_for(run.values, source), but=("record",)) for run in runs]
    for old, sha in zip(before, known, strict=True):
        if sha not in planned:
            raise UsageError(_difference(old, runs, directory))
    merged = tuple(
        replace(run, run_id=names.get(sha, run.run_id))
        for run, sha in zip(runs, planned, strict=True)
    )
    if len({run.run_id for run in merged}) < len(merged):
        raise UsageError(
            f"'{source}' gives a run the name of another; it is damaged or of another program; "
            "name another --out"
        )
    return merged


def _difference(old: Mapping[str, Any], runs: Sequence[PlannedRun], directory: Path) -> str:
    start = f"'{directory}' was made by another campaign"
    end = "; give it as it was, with more values on its axes if you like, or name another --out"
    same = [run for run in runs if run.run_id == old["run_id"]]
    if not same:
        return f"{start}: its run {old['run_id']} is not in this one{end}"
    then, now = (
        dict(flatten(json.loads(config_for(values, "campaign").model_dump_json())))
        for values in (old["values"], same[0].values)
    )
    key = next(k for k in {**then, **now} if k != "record" and then.get(k) != now.get(k))
    return (
        f"{start}: {key} of run {old['run_id']} was {json.dumps(then.get(key))} and is now "
        f"{json.dumps(now.get(key))}{end}"
    )


def parts_named(plan: Plan) -> list[tuple[str, str]]:
    """(kind, MODULE:FUNCTION) of all external parts of a plan's runs, each once."""
    named = {
        (kind, str(name))
        for run in plan.runs
        for kind, slot in SLOTS.items()
        if names_code(slot, name := run.values.get(slot.key))
    }
    return sorted(named)


def check_external_code(plan: Plan, directory: Path) -> None:
    """Raises UsageError where finished runs were flown with other code of an external part or of a
    scene than there is now: they would not be flown again, and stand beside runs of another
    program. Runs that do not say what they were flown with pass."""
    scenes = sorted({str(run.values["scene"]) for run in plan.runs})
    named = [*parts_named(plan), *(("scene", name) for name in filter(names_function, scenes))]
    now = {(kind, name): code_now(name, kind) for kind, name in named}
    if not now or not (directory / PLAN_FILE).is_file():
        return
    rows = refresh(directory)
    for (kind, name), code in now.items():
        own, sha = (kind, f"{kind}_sha")
        if kind not in ("estimator", "scene"):
            own, sha = (f"parts.{kind}", f"parts_sha.{kind}")
        changed = [
            row["run_id"]
            for row in rows
            if row.get(own) == name and row.get(sha) not in (None, code)
        ]
        if changed:
            raise UsageError(
                f"the code of {name} has changed since runs of '{directory}' were flown "
                f"({len(changed)}), such as {changed[0]}; name another --out, or remove those runs "
                f"({directory / RUNS / changed[0]} and so on) to fly them anew"
            )


def sweep(directory: Path, run_ids: Iterable[str], *, whole: bool) -> None:
    """Takes away what dead processes left of runs; ``whole``: nobody else works in ``directory``,
    and all unfinished files go."""
    if not whole:
        for run_id in run_ids:
            clear_partial(directory, run_id)
        return
    shutil.rmtree(directory / PARTIAL, ignore_errors=True)
    clear_partials(directory)
    clear_partials(directory / FAILED, alone=True)


def clear_partial(directory: Path, run_id: str) -> None:
    """Takes away what a worker that is dead left of a run."""
    folder = directory / PARTIAL
    for path in folder.iterdir() if folder.is_dir() else ():
        if path.name.rpartition(".")[0] == run_id:
            shutil.rmtree(path, ignore_errors=True)


def flying_now(directory: Path) -> list[str]:
    """Names of the runs in the air, as far as the directory tells."""
    folder = directory / PARTIAL
    if not folder.is_dir() or not _is_in_use(directory):
        return []
    return sorted({path.name.rpartition(".")[0] for path in folder.iterdir()})


def flown_for_s(directory: Path) -> float:
    """Seconds since the session in progress began: since its lock was signed."""
    locks = [path for path in directory.glob(f"{LOCK_FILE}*") if not path.name.endswith("sessions")]
    return max(0.0, time.time() - max(path.stat().st_mtime for path in locks)) if locks else 0.0


def _is_in_use(directory: Path) -> bool:
    try:
        with _flock(directory / LOCK_FILE, shared=False, sign=False):
            return False
    except BlockingIOError:
        return True
    except OSError:
        return False


def write_failure(directory: Path, task: Task, failure: Failure, attempts: int) -> None:
    """``failed/RUN.json``: what is known of a run that crashed."""
    from touchdown.experiments.io.provenance import git_revision

    folder = directory / FAILED
    folder.mkdir(exist_ok=True)
    config = config_for(task.values, f"run {task.run_id}")
    record = {
        "run_id": task.run_id,
        "scene": config.scene,
        "estimator": config.estimator,
        "seed": config.seed,
        "unit": config.unit,
        "profile": config.profile,
        "preset": config.preset,
        "wind_kmh": config.wind.mean_kmh,
        "mode": "fly" if config.landing.survey_only else "land",
        "config_sha": config_sha(config),
        "git_revision": git_revision(),
        "kind": failure.kind,
        "error": failure.error,
        "attempts": attempts,
        "failed_utc": utc_now(),
        "traceback": failure.traceback,
        "values": dict(task.values),
    }
    write_text(inside(folder, f"{task.run_id}.json"), json.dumps(record, indent=1) + "\n")
