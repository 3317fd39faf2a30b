"""Running of fuzzed inputs and the verdict on their end.

A case is a command line in a folder of its own. It may end in three ways: it is done (exit code 0
or 1), it is refused (exit code 2: one line on stderr, nothing written), or it reaches the beginning
of the long work, where `grounded` ends it. Any other end is a finding.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import io
import os
import signal
import sys
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any
from unittest import mock

from touchdown.experiments.cli import main as cli
from touchdown.scenes import compose

LIMIT_S = 60.0
MAX_LINE = 2000
"""Greatest number of characters of an error message."""
_ERROR, _WARNING = "touchdown: error: ", "touchdown: warning: "
_MAX_WARNINGS = 3
_MAY_STAY = ("results.parquet", "reproduction.json")
_HEAVY = (
    "control",
    "touchdown.controller.design",
    "duckdb",
    "touchdown.estimator.paper.estimator",
    "touchdown.experiments.benchmarks.ablation",
    "touchdown.experiments.benchmarks.odometry",
    "touchdown.experiments.benchmarks.site_selection_time",
    "touchdown.experiments.benchmarks.lidar",
    "touchdown.experiments.calibration.evaluate",
    "touchdown.experiments.campaign.session",
    "touchdown.experiments.external.conformance",
    "touchdown.experiments.edges.figures",
    "touchdown.experiments.edges.train",
    "touchdown.experiments.benchmarks.endurance",
    "touchdown.experiments.flight.run",
    "touchdown.experiments.benchmarks.loop_overhead",
    "touchdown.experiments.classification.render_dataset",
    "touchdown.experiments.reporting.document",
    "touchdown.experiments.reproduce.report",
    "touchdown.experiments.recording.rerun_recorder",
    "touchdown.experiments.scene_tools.seed_check",
    "touchdown.experiments.scene_tools.render",
    "touchdown.experiments.benchmarks.site_selection",
    "matplotlib.pyplot",
    "pyarrow.parquet",
    "rerun.blueprint",
    "rich.table",
    "touchdown.scenes.compose",
    "touchdown.scenes.importers.dem",
)


class Reached(BaseException):
    """The input is valid: a flight, a rendering or a training would begin now."""


class Hang(BaseException):
    """A case took longer than `LIMIT_S`."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Case:
    """``arguments`` of the command line, run in ``folder``; the files are there already."""

    kind: str
    arguments: tuple[str, ...]
    folder: Path


@dataclass(frozen=True, kw_only=True, slots=True)
class Verdict:
    """``code`` is the exit code, or ``reached``; ``faults`` lists the violated rules."""

    code: int | str
    error: str
    faults: tuple[str, ...]


# ------------------------------------------------------------------------------------- the ground


@contextlib.contextmanager
def grounded(compile_files: bool = True) -> Iterator[None]:
    """Replaces flights, renderings, trainings and new processes by raising `Reached`.
    ``compile_files``: MJCF files are compiled first; otherwise they need only exist."""

    real_spec, generator = compose.compose_spec, compose.scene_generator

    def compose_spec(name_or_path: str, seed: int) -> Any:
        if name_or_path.endswith(".xml") or "/" in name_or_path or seed < 0:
            if compile_files or seed < 0 or not Path(name_or_path).is_file():
                return real_spec(name_or_path, seed)
        else:
            generator(name_or_path)
        raise Reached(f"build {name_or_path}")

    stops = (
        "touchdown.experiments.flight.run.fly_and_judge",
        "touchdown.experiments.external.conformance.check_estimator",
        "touchdown.sim.posed_sensors.PosedSensors.__init__",
        "concurrent.futures.ProcessPoolExecutor.__init__",
        "subprocess.run",
        "subprocess.Popen.__init__",
    )
    with contextlib.ExitStack() as held:
        for name in stops:
            held.enter_context(mock.patch(name, _reach))
        held.enter_context(mock.patch("touchdown.scenes.compose.compose_spec", compose_spec))
        held.enter_context(
            mock.patch("touchdown.experiments.io.provenance.git_revision", return_value="abc")
        )
        held.enter_context(
            mock.patch("touchdown.experiments.campaign.executor.LocalEngine.run", _fly_nothing)
        )
        trainer = "touchdown.landing.classification.learning.training"
        if trainer in sys.modules:
            held.enter_context(mock.patch(f"{trainer}.Trainer", _reach))
        yield


def _reach(*_arguments: Any, **_options: Any) -> Any:
    raise Reached


def _fly_nothing(*_arguments: Any) -> None:
    pass


# ---------------------------------------------------------------------------------------- running


def run_case(case: Case, limit_s: float = LIMIT_S) -> Verdict:
    """Runs a case in this process and judges its end."""
    before = fingerprint(case.folder)
    out, err = _stream(), _stream()
    faults: list[str] = []
    code: int | str = "raised"
    home = Path.cwd()
    handlers = {s: signal.getsignal(s) for s in (signal.SIGTERM, signal.SIGALRM)}
    os.chdir(case.folder)
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), _alarm(limit_s):
            code = cli.main(list(case.arguments))
    except Reached:
        code = "reached"
    except Hang as hang:
        where = "".join(traceback.format_tb(hang.__traceback__)[-3:])
        faults.append(f"took longer than {limit_s:g} s: {where}")
    except (Exception, SystemExit):
        faults.append(traceback.format_exc())
    finally:
        os.chdir(home)
        for number, handler in handlers.items():
            signal.signal(number, handler)
    errors = _text(err)
    if not faults:
        faults += judge(code, errors)
        faults += written(code, before, fingerprint(case.folder))
    return Verdict(code=code, error=errors, faults=tuple(faults))


def _stream() -> io.TextIOWrapper:
    """Text stream with the strict encoding of a terminal."""
    return io.TextIOWrapper(io.BytesIO(), encoding="utf-8", errors="strict", write_through=True)


def _text(stream: io.TextIOWrapper) -> str:
    stream.flush()
    buffer = stream.buffer
    assert isinstance(buffer, io.BytesIO)
    return buffer.getvalue().decode("utf-8")


@contextlib.contextmanager
def _alarm(limit_s: float) -> Iterator[None]:
    def ring(_number: int, _frame: FrameType | None) -> None:
        raise Hang

    signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, limit_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)


# ---------------------------------------------------------------------------------------- judging


def judge(code: int | str, errors: str) -> list[str]:
    """Returns the faults of an exit code and of the text on stderr."""
    faults = []
    if code not in (0, 1, 2, "reached"):
        faults.append(f"exit code {code}")
    if "Traceback" in errors:
        faults.append(f"a traceback: {errors[-3000:]}")
    lines = [line for line in errors.split("\n") if line and not line.startswith("\r")]
    warned = [line for line in lines if line.startswith(_WARNING)]
    if len(warned) > _MAX_WARNINGS:
        faults.append(f"{len(warned)} warnings: {errors[:500]}")
    if code == 2:
        rest = [line for line in lines if line not in warned]
        if len(rest) != 1 or not rest[0].startswith(_ERROR):
            faults.append(f"stderr is not one line of error: {errors[:2000]!r}")
        else:
            faults += message_faults(rest[0].removeprefix(_ERROR))
    return faults


def message_faults(text: str) -> list[str]:
    """Returns the faults of an error message."""
    faults = []
    if len(text) < 12:
        faults.append(f"empty message: {text!r}")
    if len(text) > MAX_LINE:
        faults.append(f"{len(text)} characters of error: {text[:300]!r}")
    if not all(character.isprintable() for character in text):
        faults.append(f"control characters in the error: {text[:300]!r}")
    return faults


def fingerprint(folder: Path) -> dict[str, str]:
    """Every path below a folder, and a digest of every file."""
    found = {}
    for root, folders, files in os.walk(folder):
        for name in folders:
            found[os.path.relpath(os.path.join(root, name), folder)] = "folder"
        for name in files:
            path = os.path.join(root, name)
            digest = "unreadable"
            with contextlib.suppress(OSError), open(path, "rb") as file:
                digest = hashlib.md5(file.read()).hexdigest()
            found[os.path.relpath(path, folder)] = digest
    return found


def written(code: int | str, before: dict[str, str], after: dict[str, str]) -> list[str]:
    """Returns the faults of the remaining files of a case."""
    new = sorted(path for path, digest in after.items() if before.get(path) != digest)
    lost = sorted(before.keys() - after.keys())
    halves = [path for path in new if ".partial" in path or ".flying" in path]
    faults = [f"half-written: {path}" for path in halves]
    # A table over the runs may be made anew at any time, a campaign's lock holds nothing, and the
    # mark of a reproduction is what the same command goes on from.
    new = [path for path in new if not path.endswith(_MAY_STAY) and ".lock" not in path]
    if code == "reached":  # like Ctrl-C: folders that are empty do no harm
        new = [path for path in new if after[path] != "folder"]
    if code in (2, "reached") and (new or lost):
        faults.append(f"exit code {code}, but it wrote {new[:5]} and took away {lost[:5]}")
    return faults


def import_heavy(*names: str) -> None:
    """Imports modules before the alarm is set, which could interrupt an import."""
    for name in (*_HEAVY, *names):
        importlib.import_module(name)


def as_text(arguments: Sequence[str]) -> str:
    """Command line in shell quoting."""
    import shlex

    return shlex.join(arguments)
