"""Sound commands that a server runs once itself, so that its children find all modules loaded and
all kernels compiled."""

import contextlib
import os
import shutil
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

from fuzz.config_kinds import FLOOR
from fuzz.data_kinds import logged_run
from fuzz.grounding import Reached
from fuzz.run_kinds import write_run

_Commands = tuple[tuple[str, ...], ...]


def _flight(folder: Path, _shared: Path) -> _Commands:
    (folder / "floor.xml").write_text(FLOOR)
    start = ("fly", "floor.xml", "--quiet", "--no-record", "--estimator")
    return ((*start, "gps"), (*start, "zou2024"), ("scenes", "check", "floor.xml"))


def _report(folder: Path, _shared: Path) -> _Commands:
    write_run(np.random.default_rng(0), folder / "runs" / "flat-gps-s0")
    return (("report", "runs", "--out", "rep"), ("report", "runs"))


def _replay(folder: Path, shared: Path) -> _Commands:
    shutil.copytree(logged_run(shared), folder / "run")
    start = ("fly", "--replay", "run", "--quiet", "--out")
    return tuple((*start, name, "--estimator", name) for name in ("gps", "optical_flow", "stereo"))


_FOR: dict[str, tuple[Callable[[Path, Path], _Commands], ...]] = {
    "mjcf": (_flight,), "asset": (_flight,), "toml": (_flight,), "json": (_flight, _report),
    "tum": (_report, _replay), "mcap": (_replay,), "parquet": (_report,),
}  # fmt: skip


_RUN: set[Callable[[Path, Path], _Commands]] = set()


def warm(kind: str, folder: Path, shared: Path) -> None:
    """Runs the commands of a kind in ``folder``, which is made anew and removed."""
    from touchdown.experiments.cli.main import main

    here = os.getcwd()
    fresh = [make for make in _FOR.get(kind, ()) if make not in _RUN]
    _RUN.update(fresh)
    for number, make in enumerate(fresh):
        place = folder / f"warm-{kind}-{number}"
        place.mkdir(parents=True)
        os.chdir(place)
        try:
            for arguments in make(place, shared):
                with (
                    contextlib.suppress(Reached),
                    open(os.devnull, "w") as nowhere,
                    contextlib.redirect_stdout(nowhere),
                    contextlib.redirect_stderr(nowhere),
                    warnings.catch_warnings(),
                ):
                    main(list(arguments))
        finally:
            os.chdir(here)
            shutil.rmtree(place)
    sys.stdout.flush()
