"""Work in a second process beside flights: slots, notes, and errors across processes."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from touchdown.experiments.campaign.executor import Event, LocalEngine
from touchdown.experiments.campaign.session import Watcher, fly_campaign
from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.run_directory import run_directory
from touchdown.experiments.reproduce import background_worker as reproduce_beside
from touchdown.experiments.reproduce import run as reproduce
from touchdown.experiments.reproduce.background_worker import BackgroundWorker, send_note
from touchdown.experiments.reproduce.steps import PARTS

from support.campaign_flights import RUNNER, axes, figures, fly, make_plan

if TYPE_CHECKING:
    from support.reproduce_world import World

pytest_plugins = ("support.reproduce_world",)


def write_and_send(file: Path) -> None:
    send_note(f"threads: {os.environ['OMP_NUM_THREADS']}")
    file.write_text(str(os.getpid()))


def run_out_of_paper() -> None:
    raise UsageError("no paper")


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def draw_for_ever(folder: Path) -> None:
    with run_directory(folder / "pictures"):
        send_note("drawing")
        time.sleep(600.0)


def test_work_beside_has_its_own_process_and_one_slot(tmp_path: Path) -> None:
    slots, notes = threading.Semaphore(2), list[str]()
    with BackgroundWorker(slots, notes.append) as beside:
        assert slots.acquire(blocking=False)
        beside.start(write_and_send, tmp_path / "pid")
        assert not slots.acquire(blocking=False), "one is ours, one the work's"
        beside.wait()
        assert slots.acquire(timeout=60.0), "it is given back"
    assert notes == ["threads: 1"] and int((tmp_path / "pid").read_text()) != os.getpid()


@pytest.mark.parametrize(
    ("work", "fragment"), [(run_out_of_paper, "no paper"), (die, "was killed")]
)
def test_errors_of_the_process_are_raised_in_the_caller(
    work: Callable[[], None], fragment: str
) -> None:
    slots = threading.Semaphore(1)
    with BackgroundWorker(slots, print) as beside:
        beside.start(work)
        with pytest.raises(UsageError, match=fragment):
            beside.wait()
    assert slots.acquire(timeout=60.0)


def test_the_process_ends_with_its_parent_and_leaves_no_partial_files(tmp_path: Path) -> None:
    drawing = threading.Event()

    def be_interrupted() -> None:
        with BackgroundWorker(threading.Semaphore(1), lambda _note: drawing.set()) as beside:
            beside.start(draw_for_ever, tmp_path)
            assert drawing.wait(60.0)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        be_interrupted()
    assert list(tmp_path.iterdir()) == []


class _Air(Watcher):
    """Counts concurrent flights."""

    def __init__(self) -> None:
        self.now = self.most = 0

    def see(self, event: Event) -> None:
        self.now += {"started": 1, "finished": -1}.get(event["event"], 0)
        self.most = max(self.most, self.now)


def test_flights_wait_for_slots_and_have_equal_results(tmp_path: Path) -> None:
    plan = make_plan(tmp_path, axes(scene=["flat"], estimator=["fake:slow"], seeds="0-3"))
    air = _Air()
    engine = LocalEngine(2, threading.Semaphore(1))
    totals = fly_campaign(plan, tmp_path / "one", engine, runner=RUNNER, watcher=air)
    assert totals["finished"] == 4 and air.most == 1
    fly(plan, tmp_path / "two", jobs=2)
    assert figures(tmp_path / "one") == figures(tmp_path / "two")


@pytest.fixture
def beside_in_a_thread(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Runs parts in this process, since others lack the fake world; returns the messages."""
    notes: list[str] = []

    def pool(jobs: int, _fresh: Any, **_beginning: Any) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(jobs)

    monkeypatch.setattr(reproduce_beside, "ProcessPoolExecutor", pool)
    monkeypatch.setattr(reproduce_beside, "_begin", lambda *_: None)
    monkeypatch.setattr(reproduce, "send_note", notes.append)
    return notes


@pytest.mark.usefixtures("no_report")
def test_parts_beside_flights_are_done_once_and_before_what_is_timed(
    world: World, tmp_path: Path, beside_in_a_thread: list[str]
) -> None:
    done = reproduce.reproduce(tmp_path, quick=True, jobs=2)
    assert done.successful and len(done.states) == len(PARTS) - 1, "none of photographs"
    for what in ("calibration", "edges", "sites", "speed", "training"):
        assert world.count(what) == 1, what
    drawn = max(world.calls.index(what) for what in ("calibration", "edges", "scene", "sites"))
    flown = max(n for n, what in enumerate(world.calls) if what.endswith("-s0"))
    assert max(drawn, flown) < world.calls.index("speed") < world.calls.index("training")
    begun = f"[1/{len(PARTS) - 1}] calibration: "
    assert sum(note.startswith(begun) for note in beside_in_a_thread) == 2
    again = reproduce.reproduce(tmp_path, quick=True, jobs=2)
    assert again.successful and world.count("calibration") == 1


@pytest.mark.usefixtures("no_report", "beside_in_a_thread")
def test_a_part_that_breaks_beside_leaves_the_others(world: World, tmp_path: Path) -> None:
    world.broken = "edges"
    done = reproduce.reproduce(tmp_path, quick=True, jobs=2)
    assert [name for name, state in done.states.items() if not state.successful] == ["edges"]
    world.broken = ""
    assert reproduce.reproduce(tmp_path, quick=True, jobs=2).successful
    assert world.count("calibration") == 1 and world.count("edges") == 2
