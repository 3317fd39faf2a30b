"""Reproduction of all tables and figures of the paper: a part is done when its result, of the same
settings, is in its ``part.json``."""

import contextlib
import fcntl
import importlib.util
import json
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from touchdown.experiments.campaign.session import Watcher
from touchdown.experiments.errors import UsageError, reason_of, system_message
from touchdown.experiments.io.run_directory import clear_partials, utc_now, write_text
from touchdown.experiments.io.untrusted import read_object, refuse_links, shown
from touchdown.experiments.reproduce.parts import (
    PARTS,
    REPORT,
    Extent,
    Job,
    Notes,
    Part,
    PartResult,
    Reproduction,
    part_named,
)
from touchdown.sim.files.opening import no_file

_MARK, _RESULT, _ERROR = "reproduction.json", "part.json", "error.txt"
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

    Parts that are done are not repeated. An error of a part stands in its result and in the report,
    and the other parts follow; an error of the machine (a full disk) ends all. Raises UsageError.
    """
    from touchdown.experiments.io.provenance import UNRECORDED_REMEDY, git_revision
    from touchdown.experiments.reproduce.report import write_reproduction

    wanted = parts_wanted(skip, photographs)
    skipped = tuple(part.name for part in PARTS if part not in wanted)
    if git_revision() is None:
        raise UsageError(f"reproduce needs a git revision to state: {UNRECORDED_REMEDY}")
    if out.is_dir():
        refuse_links(out.rglob("*"), "a reproduction")
    started = time.perf_counter()
    extent = Extent(quick=quick, photographs=tuple(photographs))
    _check_libraries([part for part in wanted if not is_done(part, out, extent)])
    with _locked(out):
        _sign(out, quick=quick)
        for folder in (out, out / REPORT, out / REPORT / "figures"):
            clear_partials(folder, alone=True)
        for number, part in enumerate(wanted, start=1):
            head = f"[{number}/{len(wanted)}] {part.name}"
            if is_done(part, out, extent):
                notes(f"{head}: done already")
                continue
            job = Job(
                folder=out / part.name, extent=extent, jobs=jobs, notes=notes, watcher=watcher()
            )
            _do(part, job, head)
        found = {part.name: result for part in PARTS if (result := _read_result(out / part.name))}
        done = Reproduction(out, quick, found, skipped, time.perf_counter() - started)
        notes("writing the report")
        write_reproduction(done, out / REPORT)
    return done


def parts_wanted(skip: Sequence[str] = (), photographs: Sequence[str] = ()) -> list[Part]:
    """The parts but those of ``skip`` and those without their images. Raises UsageError for an
    unknown name, and where none is left."""
    skipped = [part_named(name) for name in skip]
    wanted = [
        part for part in PARTS
        if part not in skipped and (photographs or not part.needs_photographs)
    ]  # fmt: skip
    if not wanted:
        raise UsageError("--skip leaves nothing to do")
    return wanted


def is_done(part: Part, out: Path, extent: Extent) -> bool:
    """True if a part with the same settings ended; quick and whole editions may share it. A
    campaign with flights without an outcome is not done."""
    result = _read_result(out / part.name)
    if result is None or result.error:
        return False
    lost = result.figures.get("crashed", 0) or result.figures.get("remaining", 0)
    settings = json.loads(json.dumps(part.settings(extent)))  # tuples are read back as lists
    return not lost and result.settings == settings


def _read_result(folder: Path) -> PartResult | None:
    """Result of the part in ``folder``, None before it ended. Raises UsageError for a damaged
    one."""
    file = folder / _RESULT
    if not file.exists():
        return None
    try:
        result = PartResult.model_validate(read_object(file))
        if result.part != folder.name:
            raise ValueError(f"it is of the part {shown(result.part)}")
    except (OSError, ValueError) as error:
        raise UsageError(
            f"'{file}' is damaged or of another program ({reason_of(error)}); delete it, and its "
            "part runs again"
        ) from error
    return result


def _do(part: Part, job: Job, head: str) -> None:
    """Runs a part and writes its result; ``head`` begins its progress messages."""
    from touchdown.experiments.io.provenance import git_revision

    job.notes(f"{head}: {part.title}, for {', '.join(part.shows)}")
    started = time.perf_counter()
    job.folder.mkdir(parents=True, exist_ok=True)
    clear_partials(job.folder, alone=True)
    figures: dict[str, Any] = {}
    why = error = ""
    try:
        figures, why = part.run(job)
    except Exception as problem:
        if isinstance(problem, UsageError) and isinstance(problem.__cause__, OSError):
            raise  # the next part would meet it, too
        if isinstance(problem, OSError) and (message := system_message(problem)):
            raise UsageError(f"--out {job.folder}: {message}") from problem
        kind = "" if isinstance(problem, UsageError) else f"{type(problem).__name__}: "
        error = " ".join(f"{kind}{problem}".split())
        write_text(job.folder / _ERROR, traceback.format_exc())
    result = PartResult(
        part=part.name,
        edition=job.extent.edition,
        settings=part.settings(job.extent),
        figures=figures,
        why=why,
        error=error,
        wall_s=time.perf_counter() - started,
        finished_utc=utc_now(),
        git_revision=git_revision(),
    )
    write_text(job.folder / _RESULT, result.model_dump_json(indent=1) + "\n")
    verdict = f"FAILED: {result.failure}" if result.failure else "done"
    job.notes(f"{head}: {verdict} after {result.wall_s:.0f} s")


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
    mark = out / _MARK
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
    ours = (out / _MARK).is_file()
    if out.is_dir() and not ours and any(not p.name.startswith(".") for p in out.iterdir()):
        raise UsageError(
            f"--out {out}: holds something that is no reproduction; name another directory"
        )
    try:
        out.mkdir(parents=True, exist_ok=True)
        file = (out / ".lock").open("a")
    except OSError as error:
        raise UsageError(f"--out {out}: {error.strerror}") from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UsageError(
                f"'{out}' is being worked on by another reproduction; wait for it, or name "
                "another --out"
            ) from None
        yield
