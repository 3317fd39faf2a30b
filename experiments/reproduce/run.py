"""Reproduction of all tables and figures of the paper, part by part."""

from __future__ import annotations

import contextlib
import fcntl
import importlib.util
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from touchdown.experiments.campaign.session import Watcher
from touchdown.experiments.errors import UsageError, system_message
from touchdown.experiments.io.run_directory import clear_partials, utc_now, write_text
from touchdown.experiments.io.untrusted import refuse_links
from touchdown.experiments.reproduce.plans import Extent
from touchdown.experiments.reproduce.state import (
    ERROR,
    MARK,
    REPORT,
    STATE,
    PartState,
    Reproduction,
    is_done,
    read_states,
)
from touchdown.experiments.reproduce.steps import PARTS, Done, Job, Notes, Part, part_named
from touchdown.sim.files.opening import no_file

_QUICK, _WHOLE = '"edition": "quick"', '"edition": "whole"'


def reproduce(
    out: Path,
    *,
    quick: bool,
    jobs: int,
    skip: Sequence[str] = (),
    photographs: Sequence[str] = (),
    notes: Notes = lambda _note: None,
    watcher: Callable[[], Watcher] = Watcher,
) -> Reproduction:
    """Runs the parts of the quick or the whole edition that ``out`` lacks and writes
    ``out/report``.

    Parts that are done are not repeated. An error of a part stands in its state and in the report,
    and the other parts follow; an error of the machine (a full disk) ends all. Raises UsageError.
    """
    from touchdown.experiments.io.provenance import UNRECORDED_REMEDY, git_revision
    from touchdown.experiments.reproduce.report import write_reproduction

    skipped = _left_out(skip, photographs)
    wanted = [part for part in PARTS if part.name not in skipped]
    if not wanted:
        raise UsageError("--skip leaves nothing to do")
    if git_revision() is None:
        raise UsageError(f"reproduce needs a git revision to state: {UNRECORDED_REMEDY}")
    if out.is_dir():
        refuse_links(out.rglob("*"), "a reproduction")
    started = time.perf_counter()
    extent = Extent(quick=quick, photographs=tuple(photographs))
    _check_libraries([part for part in wanted if not is_done(part, out, extent)])
    with _locked(out):
        todo = [part for part in wanted if not is_done(part, out, extent)]
        _sign(out, quick=quick)
        for folder in (out, out / REPORT, out / REPORT / "figures"):
            clear_partials(folder, alone=True)
        heads = {p.name: f"[{n}/{len(wanted)}] {p.name}" for n, p in enumerate(wanted, start=1)}
        for part in wanted:
            if part not in todo:
                notes(f"{heads[part.name]}: done already")
        for part in todo:
            job = Job(
                folder=out / part.name, extent=extent, jobs=jobs, notes=notes, watcher=watcher()
            )
            _do(part, job, heads[part.name])
        done = Reproduction(out, quick, read_states(out), skipped, time.perf_counter() - started)
        notes("writing the report")
        write_reproduction(done, out / REPORT)
    return done


def _left_out(skip: Sequence[str], photographs: Sequence[str]) -> tuple[str, ...]:
    """Names of the parts that are not run: those of ``skip``, and those without their images."""
    named = [part_named(name).name for name in skip]
    without = [part.name for part in PARTS if part.needs_photographs and not photographs]
    return tuple(dict.fromkeys([*named, *without]))


def _do(part: Part, job: Job, head: str) -> None:
    """Runs a part and writes its state; ``head`` begins its progress messages."""
    from touchdown.experiments.io.provenance import git_revision

    job.notes(f"{head}: {part.title}, for {', '.join(part.shows)}")
    started = time.perf_counter()
    job.folder.mkdir(parents=True, exist_ok=True)
    clear_partials(job.folder, alone=True)
    done, error = Done({}), ""
    try:
        done = part.run(job)
    except Exception as problem:
        if isinstance(problem, UsageError) and isinstance(problem.__cause__, OSError):
            raise  # the next part would meet it, too
        if isinstance(problem, OSError) and (message := system_message(problem)):
            raise UsageError(f"--out {job.folder}: {message}") from problem
        kind = "" if isinstance(problem, UsageError) else f"{type(problem).__name__}: "
        error = " ".join(f"{kind}{problem}".split())
        write_text(job.folder / ERROR, traceback.format_exc())
    state = PartState(
        part=part.name,
        edition=job.edition.name,
        settings=part.settings(job.extent),
        figures=done.figures,
        why=done.why,
        error=error,
        wall_s=time.perf_counter() - started,
        finished_utc=utc_now(),
        git_revision=git_revision(),
    )
    write_text(job.folder / STATE, state.model_dump_json(indent=1) + "\n")
    failure = state.error or state.why
    job.notes(f"{head}: {f'FAILED: {failure}' if failure else 'done'} after {state.wall_s:.0f} s")


def _check_libraries(todo: Sequence[Part]) -> None:
    needed = [part.name for part in todo if part.needs_torch]
    missing = [name for name in ("torch", "onnx") if importlib.util.find_spec(name) is None]
    if needed and missing:
        raise UsageError(
            f"the part {needed[0]} needs {missing[0]}: install it with pip install "
            f"-c constraints.txt -e '.[train]', or leave the part out with --skip {needed[0]}"
        )


def _sign(out: Path, *, quick: bool) -> None:
    """Marks the directory as a reproduction, so that nothing else is overwritten. A quick one may
    become whole. The reverse is refused: it would omit existing flights."""
    mark = out / MARK
    if quick and not no_file(mark) and _WHOLE in mark.read_text(encoding="utf-8", errors="replace"):
        raise UsageError(
            f"'{out}' was begun without --quick; go on without it, or name another --out"
        )
    write_text(mark, f"{{{_QUICK if quick else _WHOLE}}}\n")


@contextlib.contextmanager
def _locked(out: Path) -> Iterator[None]:
    """Makes and locks the directory. Raises UsageError if it holds something else."""
    if out.exists() and not out.is_dir():
        raise UsageError(f"--out {out}: is a file; name a new directory")
    ours = (out / MARK).is_file()
    if out.is_dir() and not ours and any(not p.name.startswith(".") for p in out.iterdir()):
        raise UsageError(
            f"--out {out}: holds something that is no reproduction; name another directory"
        )
    with contextlib.ExitStack() as held:
        try:
            out.mkdir(parents=True, exist_ok=True)
            file = held.enter_context((out / ".lock").open("a"))
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UsageError(
                f"'{out}' is being worked on by another reproduction; wait for it, or name "
                "another --out"
            ) from None
        except OSError as error:
            raise UsageError(f"--out {out}: {error.strerror}") from error
        yield


# ------------------------------------------------------------------------------------------ plans


def overview(
    *, quick: bool, jobs: int, skip: Sequence[str] = (), photographs: Sequence[str] = ()
) -> list[dict[str, Any]]:
    """Parts with their tables, figures and approximate times with ``jobs`` processes."""
    skipped = _left_out(skip, photographs)
    return [
        {
            "part": part.name,
            "title": part.title,
            "shows": list(part.shows),
            "core_minutes": part.core_seconds(Extent(quick=quick)) / 60.0,
        }
        for part in PARTS
        if part.name not in skipped
    ]
