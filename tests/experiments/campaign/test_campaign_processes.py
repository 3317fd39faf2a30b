"""Estimators that start processes: their death is noticed, their memory counts, none is left."""

import mmap
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from touchdown.experiments.campaign.results_table import load_rows
from touchdown.experiments.external import processes
from touchdown.experiments.external.processes import memory_bytes

from support.campaign_fakes import PAGE, SIZE, mapped_file, started
from support.campaign_flights import (
    attempts,
    axes,
    fly,
    is_alive,
    make_plan,
    start_campaign,
    wait_for,
)

LIMITS = "[limits]\nrun_timeout_s = 900\nretries = 0\n"


def flown(folder: Path, *behaviours: str, limits: str = LIMITS) -> dict[str, Any]:
    """Flies a run for each behaviour in turn; returns outcome and reason by behaviour."""
    names = [f"fake:{name}" for name in behaviours]
    fly(make_plan(folder, axes(scene=["flat"], estimator=names) + limits), folder / "out")
    return {
        row["estimator"].partition(":")[2]: (row["outcome"], row["reason"])
        for row in load_rows(folder / "out")
    }


def test_a_worker_whose_copy_holds_its_pipes_is_known_to_be_dead(tmp_path: Path) -> None:
    assert flown(tmp_path, "forks")["forks"] == ("CRASHED", "the worker exited with code 3")
    (copy,) = started(tmp_path / "out")
    assert not is_alive(copy)


def test_a_crash_leaves_no_process(tmp_path: Path) -> None:
    outcome, reason = flown(tmp_path, "starts_and_crashes")["starts_and_crashes"]
    assert (outcome, reason) == ("CRASHED", "the worker was ended by SIGSEGV")
    assert len(started(tmp_path / "out")) == 3 and not any(map(is_alive, started(tmp_path / "out")))


def test_processes_of_a_run_are_gone_before_the_next(tmp_path: Path) -> None:
    found = flown(tmp_path, "leaves", "good")
    assert found == {"leaves": ("COMPLETED", ""), "good": ("COMPLETED", "")}
    assert len(started(tmp_path / "out")) == 3 and not any(map(is_alive, started(tmp_path / "out")))
    assert set(attempts(tmp_path / "out").values()) == {1}


def test_the_memory_of_a_child_counts(tmp_path: Path, base_gb: float) -> None:
    limit = round(base_gb + 0.25, 3)
    found = flown(tmp_path, "feeds_a_child", limits=f"{LIMITS}memory_gb = {limit}\n")
    assert found["feeds_a_child"] == ("CRASHED", f"took more than {limit:g} GB of memory")


def test_memory_that_processes_share_counts_once(tmp_path: Path, base_gb: float) -> None:
    limits = f"{LIMITS}memory_gb = {base_gb + 0.25:.3f}\n"
    assert flown(tmp_path, "shares", limits=limits) == {"shares": ("COMPLETED", "")}


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_no_process_outlives_the_campaign(tmp_path: Path, number: int) -> None:
    text = axes(scene=["flat"], estimator=["fake:starts_and_hangs"]) + LIMITS
    make_plan(tmp_path, text)
    command = start_campaign(tmp_path / "campaign.toml", tmp_path / "out")
    wait_for(lambda: len(started(tmp_path / "out")) == 3, "three processes")
    os.kill(command.pid, number)
    assert command.wait() != 0
    wait_for(lambda: not any(map(is_alive, started(tmp_path / "out"))), "they outlive it")


def test_a_run_that_hangs_leaves_no_process(tmp_path: Path) -> None:
    for seconds in ("2", "20"):  # a busy machine takes long to start them
        folder = tmp_path / seconds
        limits = LIMITS.replace("900", seconds)
        found = flown(folder, "starts_and_hangs", limits=limits)
        assert found["starts_and_hangs"] == ("CRASHED", f"took longer than {seconds} s")
        assert not any(map(is_alive, started(folder / "out")))
        if len(started(folder / "out")) == 3:
            return
    pytest.fail("none of them started")


def test_shared_pages_count_once_and_those_of_files_do_not() -> None:
    size, file = SIZE // 4, os.memfd_create("shared")
    os.truncate(file, size)
    code = f"import mmap; x = mmap.mmap({file}, {size}); x[::{PAGE}]; print(flush=True); input()"
    before = memory_bytes([os.getpid()])
    with mmap.mmap(file, size) as pages, mapped_file():
        pages[::PAGE] = b"x" * len(pages[::PAGE])
        assert memory_bytes([os.getpid()]) - before == pytest.approx(size, rel=0.2)
        child = subprocess.Popen(
            [sys.executable, "-c", code], pass_fds=[file],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        )  # fmt: skip
        assert child.stdout and child.stdout.readline()
        together = memory_bytes([os.getpid(), child.pid])
        child.communicate(b"\n")
    os.close(file)
    assert together - before == pytest.approx(size, rel=0.2)


def test_memory_is_known_where_kinds_of_pages_are_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, "Path", lambda _: Path("/gone"))
    expected = processes.resident_bytes([os.getpid()])
    assert memory_bytes([os.getpid()]) == pytest.approx(expected, rel=0.1)
