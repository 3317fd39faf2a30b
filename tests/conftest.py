"""Settings of the whole test suite, before anything is imported."""

import fcntl
import gc
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

os.environ.setdefault("MUJOCO_GL", "egl")
# Tests share the machine with each other's processes; libraries stay on one thread.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # hundreds of processes would compile sources
sys.dont_write_bytecode = False
# Scenes of other revisions, or of the user, stay out of the tests.
os.environ["TOUCHDOWN_SCENE_CACHE"] = f"{tempfile.gettempdir()}/touchdown-scenes-{os.getuid()}"
gc.set_threshold(100_000, 20, 50)  # what collecting and compiling make lives on


KERNELS = Path(__file__).with_name("kernels.txt")
"""kernels that tests call and no flight of the other lists, which `make test` compiles at first"""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--write-kernels",
        action="store_true",
        help="add to tests/kernels.txt what these tests compile for a tenth of a second or longer",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Compiles each kernel once. Processes that start together on an empty cache would all compile
    the same kernels; with a lock around it, the later one finds what the first has stored."""
    from numba.core.compiler_lock import global_compiler_lock
    from numba.core.dispatcher import Dispatcher

    compile_or_load = Dispatcher.compile
    folder = Path(tempfile.gettempdir()) / f"touchdown-kernels-{os.getuid()}"
    folder.mkdir(exist_ok=True)
    held: set[str] = set()

    def compile_in_turn(self: Any, signature: Any) -> Any:
        name = f"{self.py_func.__module__}.{self.py_func.__qualname__}"
        # First the lock of Numba: a thread that holds it may compile what this one waits for.
        with global_compiler_lock:
            if name in held:  # a recursive kernel
                return compile_or_load(self, signature)
            with (folder / name).open("w") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                held.add(name)
                try:
                    return compile_or_load(self, signature)
                finally:
                    held.discard(name)

    Dispatcher.compile = compile_in_turn
    if config.getoption("--write-kernels"):
        _write_kernels(config)


def pytest_unconfigure() -> None:
    """What is left is collected once; pytest would do so five times and Python once more, which
    takes a process that has seen half of the tests seconds."""
    gc.collect()
    gc.freeze()


def _write_kernels(config: pytest.Config) -> None:
    from numba.core import event

    from touchdown.experiments.flight.kernels import Recorder

    recorder = Recorder()
    event.register("numba:compile", recorder)

    def write() -> None:
        known = KERNELS.read_text(encoding="utf-8").splitlines()
        with KERNELS.open("a", encoding="utf-8") as file:
            file.writelines(f"{line}\n" for line in recorder.lines(0.1) if line not in known)

    config.add_cleanup(write)


@pytest.fixture(autouse=True, scope="session")
def _coarse_ground() -> None:
    """Ground of files is painted in fewer texels, which takes a fraction of the time."""
    from touchdown.scenes.importers import ground_texturing

    ground_texturing.TEXEL_M = 0.15


@pytest.fixture(autouse=True, scope="module")
def _small_memory(request: pytest.FixtureRequest) -> Iterator[None]:
    """What a file of tests has cached goes when it is through, and back to the system: scenes take
    100 MB each."""
    yield
    from touchdown.experiments.external.processes import release_memory

    for value in vars(request.module).values():
        if hasattr(value, "cache_clear"):
            value.cache_clear()
    release_memory()


@pytest.fixture
def closed() -> Iterator[Any]:
    """Gives back what it is called with and closes it after the test."""
    with ExitStack() as stack:
        yield lambda thing: stack.enter_context(closing(thing))


@pytest.fixture
def torch() -> Any:
    """The module, on one thread; a test that needs it is skipped without it."""
    module: Any = pytest.importorskip("torch")
    module.set_num_threads(1)
    return module


@pytest.fixture
def run_cli(capsys: pytest.CaptureFixture[str]) -> Any:
    """Runs the command line and returns exit code, output and errors."""

    def run(*arguments: Any) -> tuple[int, str, str]:
        from touchdown.experiments.cli import main

        capsys.readouterr()
        code = main.main([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run


@pytest.fixture
def says(run_cli: Any) -> Any:
    """Runs the command line, which must end with a code, and returns what it prints."""

    def says(code: int, *arguments: Any) -> Any:
        ended, out, err = run_cli(*arguments)
        assert ended == code, err
        return SimpleNamespace(out=out, err=err)

    return says
