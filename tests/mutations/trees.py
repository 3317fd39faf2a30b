"""Copies of the project in which mutated sources run their tests."""

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from mutations.places import SOURCES, Mutation, PlaceError, mutated

KILLED, TIMED_OUT, SURVIVED = "KILLED", "TIMED OUT", "SURVIVED"
NOT_FOUND, CRASHED, PASSED, FAILED = "NOT FOUND", "CRASHED", "PASSED", "FAILED"
BROKEN = ("NameError", "UnboundLocalError", "SyntaxError", "ImportError", "ModuleNotFoundError")
"""What a change that is no program raises."""


@dataclass(frozen=True)
class Outcome:
    name: str
    state: str
    seconds: float = 0.0
    seen_by: str = ""
    """First failing test and what it said, or the error."""


@dataclass
class Tree:
    """A copy of the project in which tests run, with its own cache of kernels. Its path stays the
    same from call to call, because Numba finds what it compiled by the path of the source."""

    root: Path
    timeout_s: float
    running: set[subprocess.Popen[bytes]] = field(default_factory=set)

    def fill(self, project: Path) -> None:
        """Copies what git knows or does not ignore, and checks that the copy is what runs."""
        shutil.rmtree(self.root, ignore_errors=True)
        for name in _listed_files(project):
            target = self.root / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(project / name, target, follow_symlinks=False)
        package = SOURCES.name
        code = f"import {package}; print({package}.__file__)"
        loaded = subprocess.check_output(
            [sys.executable, "-c", code], cwd=self.root, env=self._environment(), text=True
        )
        assert Path(loaded.strip()).is_relative_to(self.root), f"tests would run {loaded}"

    def _environment(self, kernels: Path | None = None) -> dict[str, str]:
        cache = kernels or self.root.with_name(f"{self.root.name}-kernels")
        # of its own, because tests of one user wait there for each other's kernels
        temporary = self.root.with_name(f"{self.root.name}-tmp")
        temporary.mkdir(exist_ok=True)
        paths = {"PYTHONPATH": self.root / "src", "NUMBA_CACHE_DIR": cache, "TMPDIR": temporary}
        return {**os.environ, **{k: str(v) for k, v in paths.items()}, "COLUMNS": "300"}

    def test(self, mutation: Mutation) -> Outcome:
        """Runs the tests of one mutation in this copy, which is afterwards as it was."""
        path = self.root / mutation.path
        try:
            text = path.read_text(encoding="utf-8")
            changed = mutated(text, mutation)
        except (OSError, PlaceError) as error:
            return Outcome(mutation.name, NOT_FOUND, seen_by=str(error))
        stat = path.stat()
        kernels = None
        if "numba" in text or not mutation.qualified:
            kernels = self.kernels_without(mutation.path)
        path.write_text(changed, encoding="utf-8")
        try:
            return self.pytest(mutation.name, mutation.tests, kernels)
        finally:
            path.write_text(text, encoding="utf-8")
            os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))

    def kernels_without(self, changed: Path) -> Path:
        """A cache without the kernels of a file and of those that import it, themselves or through
        others: a compiled kernel holds the kernels that it calls and the constants that it uses."""
        cache = self.root.with_name(f"{self.root.name}-kernels")
        copy = self.root.with_name(f"{self.root.name}-kernels-mutated")
        shutil.rmtree(copy, ignore_errors=True)
        stale = {(path.parent.name, path.stem) for path in _dependents(self.root, changed)}

        def ignored(folder: str, names: list[str]) -> list[str]:
            parent = Path(folder).name.rpartition("_")[0]
            return [name for name in names if (parent, name.partition(".")[0]) in stale]

        if cache.is_dir():
            shutil.copytree(cache, copy, ignore=ignored)
        return copy

    def pytest(self, name: str, tests: Iterable[str], kernels: Path | None = None) -> Outcome:
        """``SURVIVED`` where all tests pass."""
        options = ["-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "-m", "not slow"]
        output = self.root.with_name(f"{self.root.name}.txt")
        start = time.monotonic()
        with output.open("wb") as stream:
            process = subprocess.Popen(
                [sys.executable, "-m", "pytest", *options, *tests], cwd=self.root,
                env=self._environment(kernels), stdout=stream, stderr=subprocess.STDOUT,
                start_new_session=True,
            )  # fmt: skip
            self.running.add(process)
            try:
                code = process.wait(self.timeout_s)
            except subprocess.TimeoutExpired:
                code = None
            finally:
                self.stop()
        text = output.read_text(encoding="utf-8", errors="replace")
        return Outcome(name, *_state(code, text, time.monotonic() - start))

    def stop(self) -> None:
        """Ends the tests that run here, with the processes that they started."""
        for process in list(self.running):
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
            self.running.discard(process)


def _state(code: int | None, text: str, seconds: float) -> tuple[str, float, str]:
    """(state, seconds, first failing test or error) of an exit code of pytest and what it wrote."""
    failed = re.findall(r"^(?:FAILED|ERROR) (.*)$", text, re.MULTILINE)
    first = failed[0] if failed else ""
    if code is None:
        return TIMED_OUT, seconds, ""
    if code == 0:
        return SURVIVED, seconds, ""
    if code == 1 and first and first.partition(" - ")[2].partition(":")[0] not in BROKEN:
        return KILLED, seconds, first
    return CRASHED, seconds, first or text.strip().rpartition("\n")[2]


def _listed_files(project: Path) -> list[str]:
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.check_output(command, cwd=project).decode().split("\0")
    return [name for name in names if name and os.path.lexists(project / name)]


def _dependents(root: Path, changed: Path) -> set[Path]:
    """``changed`` and the modules that import it, themselves or through others."""
    modules = {
        ".".join(path.relative_to(root / SOURCES.parent).with_suffix("").parts): path
        for path in (root / SOURCES).glob("*/**/*.py")
    }
    texts = {name: path.read_text(encoding="utf-8") for name, path in modules.items()}
    found: set[str] = set()
    new = {".".join(changed.relative_to(SOURCES.parent).with_suffix("").parts)}
    while new:
        found |= new
        words = "|".join(
            rf"{re.escape(name)}\b|from {re.escape(name.rpartition('.')[0])} import .*\b"
            rf"{name.rpartition('.')[2]}\b"
            for name in new
        )
        new = {name for name, text in texts.items() if re.search(words, text)} - found
    return {modules[name] for name in found if name in modules}
