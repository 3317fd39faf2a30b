"""Kernels of a flight compiled ahead, side by side; in flight Numba compiles one after another.

``kernels.txt`` lists those that Python calls, with the types of their arguments, as one flight
compiles them; ``kernels_zou2024.txt`` lists what a flight with that estimator and selector compiles
beside them. Whatever is missing there is compiled when it is first called. Needs nothing but what
the kernels' own modules import.

``python -m touchdown.experiments.flight.kernels [FILE...]`` compiles what the cache on the disk
lacks of the lists FILE, by default of the first; with ``--write SCENE`` it writes both lists anew
by short landings over the scene.
"""

import os
import pkgutil
import sys
import tempfile
import threading
import time
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from numba import config, types
from numba.core import event
from numba.core.errors import NumbaError

LIST = Path(__file__).with_suffix(".txt")
LIST_ZOU2024 = LIST.with_stem("kernels_zou2024")
_PACKAGE = "touchdown."


def spelled(kind: Any) -> str:
    """A type of Numba as text that `read_types` reads."""
    if isinstance(kind, types.Array):
        axes = [":"] * kind.ndim
        if kind.layout in "CF":
            axes[-1 if kind.layout == "C" else 0] = "::1"
        text = f"{spelled(kind.dtype)}[{', '.join(axes)}]"
        return text if kind.mutable else f"readonly({text})"
    if isinstance(kind, types.BaseTuple):
        inner: Any = kind
        record = getattr(kind, "instance_class", tuple)
        place = f"{record.__module__.removeprefix(_PACKAGE)}:{record.__name__}"
        return f"{'tuple_of' if record is tuple else f'record({place!r})'}({_list(inner)})"
    if isinstance(kind, types.Omitted):
        return f"Omitted({kind.value!r})"
    return {"bool": "boolean", "slice<a:b>": "slice2_type"}.get(str(kind), str(kind))


def _list(kinds: Iterable[Any]) -> str:
    return ", ".join(map(spelled, kinds))


def read_types(text: str) -> tuple[Any, ...]:
    """The types of arguments ``text``."""
    known = dict(vars(types)) | {
        "readonly": lambda array: array.copy(readonly=True),
        "tuple_of": lambda *inner: types.BaseTuple.from_types(inner),
        "record": lambda place: (
            lambda *inner: types.BaseTuple.from_types(inner, pkgutil.resolve_name(_PACKAGE + place))
        ),
    }
    return eval(f"({text},)", known)


def read_line(line: str) -> tuple[Any, tuple[Any, ...]]:
    """The kernel of a line of the list, and the types of its arguments."""
    place, _, text = line.partition(" ")
    return pkgutil.resolve_name(_PACKAGE + place), read_types(text)


def compile_lines(lines: Iterable[str]) -> list[str]:
    """Compiles the kernels of lines of the list, or loads them from the cache; returns the places
    of those that no longer take such arguments."""
    stale = []
    for line in lines:
        try:
            kernel, arguments = read_line(line)
            if kernel._can_compile:  # others have been compiled with their module
                kernel.compile(arguments)
        except (AttributeError, ImportError, NameError, TypeError, NumbaError):
            stale.append(line.partition(" ")[0])
    return stale


def compile_listed(*files: Path) -> list[str]:
    """Compiles the kernels listed in ``files`` on all cores, a module at a time: its kernels share
    what they call. Tells how many modules are done; returns as `compile_lines`."""
    modules: dict[str, list[str]] = {}
    for file in files:
        for line in file.read_text(encoding="utf-8").splitlines():
            modules.setdefault(line.partition(":")[0], []).append(line)
    stale = []
    with ProcessPoolExecutor() as pool:
        for done, missed in enumerate(pool.map(compile_lines, modules.values()), 1):
            print(f"\rcompiling kernels: {done}/{len(modules)}", end="", flush=True)
            stale += missed
    print()
    return stale


class Recorder(event.Listener):
    """What Python lets compile: lines of the list, and how long each took."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._local = threading.local()

    def on_start(self, event: Any) -> None:
        self._local.__dict__.setdefault("begun", []).append(time.perf_counter())

    def on_end(self, event: Any) -> None:
        seconds = time.perf_counter() - self._local.begun.pop()
        kernel = event.data["dispatcher"]
        module = kernel.py_func.__module__
        if not self._local.begun and module.startswith(_PACKAGE) and kernel._can_compile:
            place = f"{module.removeprefix(_PACKAGE)}:{kernel.py_func.__name__}"
            self.seconds[f"{place} {_list(event.data['args'])}"] = seconds

    def lines(self, min_s: float = 0.0) -> list[str]:
        """Those that took ``min_s`` or longer, the longest first."""
        longest = sorted(self.seconds, key=lambda line: -self.seconds[line])
        return [line for line in longest if self.seconds[line] >= min_s]


def write_lists(scene: str) -> None:
    """Writes the lists of what landings compile that begin with an empty cache, the longest
    first."""
    from touchdown.experiments.config.loading import load_config
    from touchdown.sim.opengl import rendering_backend

    os.environ.setdefault("MUJOCO_GL", rendering_backend())
    from touchdown.experiments.flight.run import fly

    with tempfile.TemporaryDirectory() as folder:
        os.environ["NUMBA_CACHE_DIR"] = os.environ["TOUCHDOWN_SCENE_CACHE"] = folder
        config.reload_config()
        for file, system in ((LIST, ("livo", "risk")), (LIST_ZOU2024, ("zou2024", "zou2024"))):
            recorder = Recorder()
            estimator, selector = system
            flight = load_config(
                scene=scene, preset="short", estimator=estimator, selector=selector
            )
            with event.install_listener("numba:compile", recorder):
                fly(flight, Path(folder) / estimator)
            file.write_text("".join(f"{line}\n" for line in recorder.lines()), encoding="utf-8")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--write"]:
        write_lists(sys.argv[2])
    else:
        stale = compile_listed(*(map(Path, sys.argv[1:]) if sys.argv[1:] else [LIST]))
        if stale:
            sys.exit(f"not compiled, as the lists are of other arguments: {', '.join(stale)}")
