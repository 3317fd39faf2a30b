"""The command line in this process, and programs in another."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

RunCli = Callable[..., tuple[int, str, str]]
"""of the fixture ``run_cli``: called with arguments it returns exit code, output and errors"""
Says = Callable[..., Any]
"""of the fixture ``says``: called with an exit code and arguments it returns ``out`` and ``err``"""


def python(*arguments: str, **options: Any) -> subprocess.CompletedProcess[str]:
    """A Python program in a process of its own; ``options`` are those of `subprocess.run`."""
    usual: dict[str, Any] = {"cwd": Path(__file__).parents[2], "timeout": 600, "check": False}
    return subprocess.run(
        [sys.executable, *arguments], text=True, capture_output=True, **(usual | options)
    )


def lines_of(script: str, **options: Any) -> list[str]:
    """What a Python program prints that must succeed."""
    return python("-c", script, check=True, **options).stdout.splitlines()


DISPLAY_VARIABLES = (
    "MUJOCO_GL", "PYOPENGL_PLATFORM", "DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET",
)  # fmt: skip


def without_display(**more: str) -> dict[str, str]:
    """The variables of this process but those that lead to a display or choose a backend."""
    return {k: v for k, v in os.environ.items() if k not in DISPLAY_VARIABLES} | more
