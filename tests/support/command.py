"""The command line in this process, and programs in another."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

RunCli = Callable[..., tuple[int, str, str]]
"""of the fixture ``run_cli``: called with arguments it returns exit code, output and errors"""
Says = Callable[..., Any]
"""of the fixture ``says``: called with an exit code and arguments it returns ``out`` and ``err``"""


def lines_of(script: str) -> list[str]:
    """What a Python program prints that must succeed."""
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=Path(__file__).parents[2], capture_output=True, text=True, check=True,
    )  # fmt: skip
    return done.stdout.splitlines()
