"""Compiles an MJCF file in a process of its own, with limits on time and memory.

MuJoCo cannot be interrupted: the time of a convex hull follows from the shape, not from the size of
a file. As a program, ``python trial.py FILE``, it ends with code 0 if the file compiles; it imports
nothing of this package, so that it starts at once.
"""

from __future__ import annotations

import functools
import signal
import subprocess
import sys
from pathlib import Path

TRIAL_BYTES = 4 << 20
"""Meshes below this size compile within seconds, whatever their shape."""
TRIAL_S, TRIAL_MEMORY_BYTES = 20, 4 << 30
_WAIT_S = 30.0
_REMEDY = "simplify its meshes (decimate), or split them"


def check_compiles(path: Path) -> None:
    """Raises ValueError for a file that does not compile within `TRIAL_S` seconds of processor time
    and `TRIAL_MEMORY_BYTES`. Other errors pass: the compilation itself names them."""
    facts = path.stat()
    message = _tried(path.resolve(), facts.st_size, facts.st_mtime_ns)
    if message:
        raise ValueError(f"{path}: {message}; {_REMEDY}")


@functools.lru_cache(maxsize=32)
def _tried(path: Path, _size: int, _changed_ns: int) -> str:
    """The reason why a file is refused, "" for none; asked once for each version of a file."""
    try:
        done = subprocess.run(
            [sys.executable, "-P", __file__, str(path)],
            capture_output=True,
            timeout=_WAIT_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"MuJoCo needs more than {_WAIT_S:.0f} s to compile it"
    if done.returncode in (-signal.SIGXCPU, -signal.SIGKILL):
        return f"MuJoCo needs more than {TRIAL_S} s of a processor to compile it"
    if done.returncode < 0:
        return f"MuJoCo crashes on it ({signal.Signals(-done.returncode).name})"
    if b"MemoryError" in done.stderr or b"unknown exception" in done.stderr:
        return f"MuJoCo needs more than {TRIAL_MEMORY_BYTES >> 30} GiB of memory to compile it"
    return ""


def _limited_compilation(path: str) -> None:
    import resource

    resource.setrlimit(resource.RLIMIT_CPU, (TRIAL_S, TRIAL_S))
    resource.setrlimit(resource.RLIMIT_AS, (TRIAL_MEMORY_BYTES, TRIAL_MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    import mujoco

    mujoco.MjSpec.from_file(path).compile()


if __name__ == "__main__":
    _limited_compilation(sys.argv[1])
