"""The process in which files of other people are read: its limits, and what is said of them."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from touchdown.sim.files import child
from touchdown.sim.files.child import LimitError, run_limited


def limited(work: Callable[[], object]) -> object:
    return run_limited(work, "a file", "to read it", "make it smaller")


def refuse() -> None:
    raise ValueError("is none")


def take_memory() -> int:
    return len(bytearray(5 << 30))


def leave() -> None:
    os._exit(0)


def crash() -> None:
    os.kill(os.getpid(), signal.SIGSEGV)


def spin() -> None:
    while True:
        pass


def connect() -> None:
    socket.create_connection(("127.0.0.1", 9))


def write() -> None:
    Path("made").write_text("something")


def test_what_is_found_comes_back() -> None:
    found = limited(lambda: {"heights": np.arange(10**6), "name": "a"})
    assert isinstance(found, dict)
    np.testing.assert_array_equal(found["heights"], np.arange(10**6))


@pytest.mark.parametrize(("work", "message"), [
    (refuse, "is none"),
    (take_memory, "'a file' needs more than 4 GiB of memory to read it; make it smaller"),
    (leave, r"'a file' ends the process that tries to read it \(exit code 0\)"),
    (crash, rf"'a file' ends the process that tries to read it \(exit code {-signal.SIGSEGV}\)"),
    (spin, "'a file' needs more than 1 s of a processor to read it; make it smaller"),
    (lambda: time.sleep(600), "'a file' needs more than 2 s to read it; make it smaller"),
])  # fmt: skip
def test_what_is_said_of_a_file(
    work: Callable[[], object], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(child, "CPU_S", 1)
    monkeypatch.setattr(child, "WAIT_S", 2.0 if "2 s" in message else 120.0)
    with pytest.raises(ValueError, match=message) as caught:
        limited(work)
    assert isinstance(caught.value, LimitError) or work is refuse


@pytest.mark.parametrize(("work", "message"), [(connect, "no network"), (write, "too large")])
def test_it_reaches_no_network_and_writes_nothing(
    work: Callable[[], object], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(OSError, match=message):
        limited(work)
    assert not list(tmp_path.rglob("*")) or not (tmp_path / "made").read_text()


def test_an_error_of_the_program_keeps_its_traceback(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(RuntimeError, match="KeyError: 'gone'"):
        limited(lambda: print("words") or {}["gone"])
    assert capfd.readouterr() == ("", "")


PARENT = """
import os, pathlib, sys, time
from touchdown.sim.files.child import run_limited

def wait():
    os.write(int(sys.argv[1]), b"%d " % os.getpid())
    time.sleep(600)

run_limited(wait, "a file", "to read it", "make it smaller")
"""


def test_it_ends_with_the_process_that_started_it() -> None:
    reader, writer = os.pipe()
    parent = subprocess.Popen([sys.executable, "-c", PARENT, str(writer)], pass_fds=[writer])
    os.close(writer)
    pid = int(os.read(reader, 20))
    parent.kill()
    parent.wait()
    assert os.read(reader, 20) == b"", f"process {pid} holds its end of the pipe"
    os.close(reader)
