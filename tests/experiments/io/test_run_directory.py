"""Directories and files that appear whole, and what killed processes left of them."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path
from unittest import mock

import psutil
import pytest

from touchdown.experiments.io import run_directory as whole
from touchdown.experiments.io.run_directory import run_directory, whole_file, whole_folder

MAKERS = {"run_directory": run_directory, "whole_folder": whole_folder, "whole_file": whole_file}
HALF = """
import os, signal, sys
from pathlib import Path
from unittest import mock
from touchdown.experiments.io import run_directory as whole
with getattr(whole, sys.argv[1])(Path(sys.argv[2])) as partial:
    if sys.argv[1] == "whole_folder":
        partial.mkdir()
    (partial if sys.argv[1] == "whole_file" else partial / "half").write_text("half")
    print("made", flush=True)
    if sys.argv[3] == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    sys.stdin.read()
"""


def begin(maker: str, out: Path, what: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-c", HALF, maker, str(out), what]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdout and process.stdout.readline() == b"made\n"
    return process


def make(maker: str, out: Path) -> None:
    with MAKERS[maker](out) as partial:
        if maker == "whole_folder":
            partial.mkdir()
        (partial if maker == "whole_file" else partial / "content").write_text("whole")


@pytest.mark.parametrize("maker", MAKERS)
def test_the_next_start_removes_what_a_dead_process_left_and_nothing_else(
    tmp_path: Path, maker: str
) -> None:
    out = tmp_path / "a[1]"
    assert begin(maker, out, "die").wait() == -signal.SIGKILL
    (dead,) = tmp_path.iterdir()
    alive = begin(maker, out, "wait")
    (of_alive,) = set(tmp_path.iterdir())
    assert of_alive != dead  # gone already
    elsewhere = tmp_path / f".a[1].partial-another.machine.{alive.pid}"
    named = tmp_path / ".a[1].partial-mine"
    other = tmp_path / f".b.partial-{socket.gethostname()}.{2**22 - 1}"
    for kept in (elsewhere, named, other):
        kept.write_text("kept")
    make(maker, out)
    assert {*tmp_path.iterdir()} == {out, of_alive, elsewhere, named, other}
    alive.communicate()
    content = out if maker == "whole_file" else next(out.iterdir())
    assert content.read_text() == "half"  # the last one counts
    assert {*tmp_path.iterdir()} == {out, elsewhere, named, other}


def test_a_process_of_the_same_number_that_began_later_is_another(tmp_path: Path) -> None:
    partial = tmp_path / ".a.partial"
    partial.write_text("")
    here = socket.gethostname()
    assert not whole._is_abandoned(partial, here, str(os.getpid()))
    assert not whole._is_abandoned(partial, "x", str(os.getpid()))
    assert not whole._is_abandoned(partial, here, "1")
    begun = psutil.Process().create_time()
    with mock.patch("psutil.Process.create_time", return_value=begun + 1e6):
        assert whole._is_abandoned(partial, here, str(os.getpid()))


@pytest.mark.parametrize("can_exchange", [True, False])
def test_an_earlier_run_is_replaced_and_never_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, can_exchange: bool
) -> None:
    if not can_exchange:
        monkeypatch.setattr(whole, "_exchange", lambda _one, _other: False)
    out, seen = tmp_path / "a", []
    removed = whole.shutil.rmtree
    monkeypatch.setattr(
        whole.shutil, "rmtree", lambda *a, **k: (seen.append(out.exists()), removed(*a, **k))
    )
    for maker in ("run_directory", "whole_folder"):
        make(maker, out)
        (out / "old").touch()
        make(maker, out)
        assert [path.name for path in out.iterdir()] == ["content"]
        removed(out)
    assert list(tmp_path.iterdir()) == [] and all(seen)


def test_a_link_to_a_directory_stays_a_link(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    make("run_directory", tmp_path / "link")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "real" / "content").exists()
