"""Commands that are killed: their processes by a mark in the environment, and what they leave."""

import os
import signal
import subprocess
import uuid
from collections.abc import Iterator
from pathlib import Path

from support.campaign_flights import is_alive, wait_for

SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)


def new_mark() -> dict[str, str]:
    """A variable of the environment that all processes of a command inherit."""
    return {"TOUCHDOWN_TEST_MARK": uuid.uuid4().hex}


def marked(mark: dict[str, str]) -> list[int]:
    """Ids of the living processes with the mark, whoever their parent is."""
    ((name, value),) = mark.items()
    wanted = f"{name}={value}".encode()
    return [pid for pid, variables in _environments() if wanted in variables and is_alive(pid)]


def _environments() -> Iterator[tuple[int, list[bytes]]]:
    for folder in Path("/proc").iterdir():
        if folder.name.isdecimal() and int(folder.name) != os.getpid():
            try:
                yield int(folder.name), (folder / "environ").read_bytes().split(b"\0")
            except OSError:
                continue


def strike(command: subprocess.Popen[str], number: int, mark: dict[str, str]) -> str:
    """Sends a signal to a command and waits until none of its processes is left. Returns what it
    wrote to stderr; fails unless it ended as is usual after that signal."""
    command.send_signal(number)
    _, err = command.communicate(timeout=600.0)
    wanted = -9 if number == signal.SIGKILL else 128 + number
    assert command.returncode == wanted, f"exit code {command.returncode}: {err}"
    wait_for(lambda: not marked(mark), "processes outlive the command")
    if number != signal.SIGKILL:
        assert err.startswith("touchdown: stopped; ") and err.count("\n") == 1, err
        assert "the same command resumes" in err
    return err


def stamps(files: Iterator[Path]) -> dict[Path, tuple[int, bytes]]:
    """Inode and content of files: both change where one is written anew."""
    return {file: (file.stat().st_ino, file.read_bytes()) for file in files}


def unfinished(directory: Path) -> list[Path]:
    """Unfinished files and folders below a directory."""
    return [path for path in directory.rglob(".*") if not path.name.startswith(".lock")]
