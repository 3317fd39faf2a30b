"""Directories and files that appear whole, and what killed processes left of them."""

import multiprocessing
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import psutil
import pytest

from touchdown.experiments.errors import UsageError
from touchdown.experiments.io import run_directory as whole
from touchdown.experiments.io.run_directory import (
    filled_folder,
    run_directory,
    whole_file,
    whole_folder,
)

OWN = ("content", "half", "old")
MAKERS = {
    "run_directory": lambda out: run_directory(out, OWN),
    "whole_folder": lambda out: whole_folder(out, OWN),
    "whole_file": whole_file,
}
HALF = """
import os, signal, sys
from pathlib import Path
from unittest import mock
from touchdown.experiments.io import run_directory as whole
own = () if sys.argv[1] == "whole_file" else (("content", "half"),)
with getattr(whole, sys.argv[1])(Path(sys.argv[2]), *own) as partial:
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


def make(
    maker: str, out: Path, text: str = "whole", meanwhile: Callable[[], None] = lambda: None
) -> None:
    with MAKERS[maker](out) as partial:
        if maker == "whole_folder":
            partial.mkdir()
        (partial if maker == "whole_file" else partial / "content").write_text(text)
        meanwhile()


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
    dated = tmp_path / f".a[1].{2**22 - 1}"
    other = tmp_path / f".b.partial-{socket.gethostname()}.{2**22 - 1}"
    for kept in (elsewhere, named, dated, other):
        kept.write_text("kept")
    make(maker, out)
    assert {*tmp_path.iterdir()} == {out, of_alive, elsewhere, named, dated, other}
    alive.communicate()
    content = out if maker == "whole_file" else next(out.iterdir())
    assert content.read_text() == "half"  # the last one counts
    assert {*tmp_path.iterdir()} == {out, elsewhere, named, dated, other}


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


@pytest.mark.parametrize("maker", ["run_directory", "whole_folder"])
def test_what_came_during_the_work_is_kept_and_the_work_too(tmp_path: Path, maker: str) -> None:
    out = tmp_path / "a"
    make(maker, out)
    (tmp_path / "a-2").touch()
    for foreign in ("thesis.txt", "old/"):  # a folder of the name of a file of ours
        thesis = out / foreign
        arrives = thesis.mkdir if foreign.endswith("/") else thesis.touch
        with pytest.raises(UsageError, match=f"holds '{thesis.name}' by now.*is in '.*a-[34]'"):
            make(maker, out, "new", arrives)
        assert (out / "content").read_text() == "whole" and thesis.exists()
        thesis.rmdir() if foreign.endswith("/") else thesis.unlink()
    assert [(tmp_path / name / "content").read_text() for name in ("a-3", "a-4")] == ["new", "new"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "a-2", "a-3", "a-4"]


def test_of_two_at_once_one_is_there_whole(tmp_path: Path) -> None:
    """Two processes replace one directory over and over."""
    out = tmp_path / "a"
    make("run_directory", out)
    writers = [multiprocessing.get_context("fork").Process(target=_replace, args=(out,))
               for _ in range(2)]  # fmt: skip
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert [writer.exitcode for writer in writers] == [0, 0]
    assert (out / "content").read_text() == "whole" and [*tmp_path.iterdir()] == [out]


def _replace(out: Path) -> None:
    for _ in range(100):
        make("run_directory", out)


def test_a_folder_of_pictures_is_filled_and_keeps_what_is_in_it(tmp_path: Path) -> None:
    out = tmp_path / "pictures"
    for text in ("one", "two"):
        with filled_folder(out) as partial:
            (partial / "a.png").write_text(text)
        (out / "mine.png").touch()
    assert (out / "a.png").read_text() == "two"
    assert sorted(path.name for path in out.iterdir()) == ["a.png", "mine.png"]
    assert [path.name for path in tmp_path.iterdir()] == ["pictures"]
