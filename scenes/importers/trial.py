"""A compilation that may be given up: the time of a hull follows from the shape of a mesh."""

from __future__ import annotations

from pathlib import Path

import mujoco

from touchdown.sim.files.child import reason_against

TRIAL_BYTES = 4 << 20
"""Meshes below this size compile within seconds, whatever their shape."""


def check_compiles(path: Path) -> None:
    """Raises ValueError for a file that does not compile within the limits of `sim.files.child`.
    Other errors pass: the compilation itself names them."""
    facts = path.stat()
    content = f"{facts.st_size} {facts.st_mtime_ns}"
    if reason := reason_against(compile_file, path.resolve(), content, "to compile it"):
        raise ValueError(f"{path} {reason}; simplify its meshes (decimate), or split them")


def compile_file(path: str) -> str:
    """Compiles a file. Raises MemoryError where an exception is unknown to MuJoCo."""
    try:
        mujoco.MjSpec.from_file(path).compile()
    except RuntimeError as error:
        raise MemoryError from error
    except (ValueError, OSError, mujoco.FatalError):  # raised, and named, once more
        pass
    return ""
