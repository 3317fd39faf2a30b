"""The process in which libraries in C are tried: its limits, and what is said when they are met."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from touchdown.sim.files import child

HERE = Path(__file__).parent


def with_a_reason(path: str) -> str:
    return f"is {path}"


def with_an_error(_path: str) -> str:
    raise ValueError("of the program")


def with_a_socket(_path: str) -> str:
    try:
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    except PermissionError:
        return "no socket"
    return ""


def with_memory(_path: str) -> str:
    return str(len(bytearray(5 << 30)))


def with_a_crash(_path: str) -> str:
    os.kill(os.getpid(), signal.SIGSEGV)
    return ""


def with_an_exit(_path: str) -> str:
    os._exit(0)


def with_a_loop(_path: str) -> str:
    while True:
        pass


def with_a_child(path: str) -> str:
    Path(path).write_text(f"{os.getpid()}\n")
    time.sleep(600)
    return ""


@pytest.fixture(autouse=True)
def _found_by_the_child(monkeypatch: pytest.MonkeyPatch) -> None:
    found = os.pathsep.join([str(HERE), os.environ.get("PYTHONPATH", "")])
    monkeypatch.setenv("PYTHONPATH", found)


def reason(check: Callable[[str], str], content: str = "a") -> str:
    check.__module__ = "test_child"
    return child.reason_against(check, Path("a file"), content, "to read it")


@pytest.mark.parametrize(("check", "message"), [
    (with_a_reason, "is a file"),
    (with_an_error, "ends the process that tries to read it (exit code 1)"),
    (with_a_socket, "no socket"),
    (with_memory, "needs more than 4 GiB of memory to read it"),
    (with_a_crash, f"ends the process that tries to read it (exit code {-signal.SIGSEGV})"),
    (with_an_exit, "ends the process that tries to read it (exit code 0)"),
])  # fmt: skip
def test_what_is_said_of_a_file(check: Callable[[str], str], message: str) -> None:
    assert reason(check) == message


def test_a_loop_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    with_a_loop.__module__ = "test_child"
    ended = child.run_limited(with_a_loop, "", cpu_s=1, memory_bytes=1 << 30)
    assert ended == (-signal.SIGXCPU, b"", None)
    monkeypatch.setattr(child, "_WAIT_S", 0.0)
    assert reason(with_a_loop) == "needs more than 0 s to read it"


def test_it_ends_with_the_process_that_started_it(tmp_path: Path) -> None:
    code = (
        "import pathlib, sys, test_child; from touchdown.sim.files import child; "
        "child.reason_against(test_child.with_a_child, pathlib.Path(sys.argv[1]), '', '')"
    )
    parent = subprocess.Popen([sys.executable, "-c", code, str(tmp_path / "pid")])
    while not (tmp_path / "pid").exists() or not (tmp_path / "pid").read_text().endswith("\n"):
        assert parent.poll() is None
        time.sleep(0.05)
    pid = int((tmp_path / "pid").read_text())
    parent.kill()
    parent.wait()
    deadline = time.monotonic() + 60.0
    while _runs(pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not _runs(pid)


def _runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
