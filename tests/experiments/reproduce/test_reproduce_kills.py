"""A reproduction that is killed by a signal, again and again, at random moments after some parts or
flights have finished."""

from __future__ import annotations

import json
import random
import signal
import time
from collections import Counter
from pathlib import Path

import pytest

from touchdown.experiments.reproduce.steps import PARTS

from support.campaign_flights import wait_for
from support.kills import SIGNALS, marked, new_mark, stamps, strike, unfinished
from support.reproduce_command import CALLS, start

Stamps = dict[Path, tuple[int, bytes]]
SKIPPED = ("recognition",)  # its trainings have tests of their own
MOST = ("recognition", "sites", "world", "edges", "positioning", "commanded_site", "landing")


class Killed:
    """Reproductions that are killed: one after the other is killed until it is done."""

    def __init__(
        self, folder: Path, number: int, seed: int, skipped: tuple[str, ...] = SKIPPED
    ) -> None:
        self._folder, self._number, self._draw = folder, number, random.Random(seed)
        self._skipped = skipped
        self.completed = 0
        self._new()

    def _new(self) -> None:
        self._home = self._folder / f"reproduction-{self.completed}"
        self._home.mkdir(parents=True)
        self._out = self._home / "out"
        self._kept: Stamps = {}
        self._calls: Counter[str] = Counter()

    def kill(self) -> bool:
        """Starts or resumes the present reproduction and kills it. False where it ended before."""
        mark, before = new_mark(), len(self._finished())
        command = self._start(mark)
        wait_for(lambda: len(self._finished()) > before or command.poll() is not None, "progress")
        time.sleep(self._draw.uniform(0.0, 0.5))
        if command.poll() is not None or self._reported():
            self._end(command, mark)  # a signal would meet an interpreter that is ending
            return False
        strike(command, self._number, mark)
        self._compare()
        return True

    def finish(self) -> None:
        """Resumes the present reproduction and lets it end."""
        mark = new_mark()
        self._end(self._start(mark), mark)

    def _start(self, mark: dict[str, str]):  # type: ignore[no-untyped-def]
        skips = [word for name in self._skipped for word in ("--skip", name)]
        return start("reproduce", "--out", self._out, "--quick", "--jobs", "2", "--quiet", *skips,
                     **mark, **{CALLS: str(self._home / "calls")})  # fmt: skip

    def _end(self, command, mark: dict[str, str]) -> None:  # type: ignore[no-untyped-def]
        _, err = command.communicate(timeout=300.0)
        assert (command.returncode, err) == (0, "")
        assert not marked(mark) and not unfinished(self._out)
        self._compare()
        states = {path.parent.name: json.loads(path.read_text()) for path in self._states()}
        assert states.keys() == {part.name for part in PARTS if part.name not in self._skipped}
        assert not any(state["error"] or state["why"] for state in states.values())
        flights = sum(state["figures"].get("runs", 0) for state in states.values())
        assert len(list(self._out.glob("*/flights/runs/*/result.json"))) == flights
        assert (self._out / "report").is_dir()
        self.completed += 1
        self._new()

    def _compare(self) -> None:
        """Fails where something finished is lost, or was done once more."""
        now, calls = stamps(iter(self._finished())), self._all_calls()
        assert self._kept.items() <= now.items(), "lost or written anew"
        assert all(calls[name] == count for name, count in self._calls.items()), "done twice"
        flown = [
            f"flight {path.parents[3].name} {path.parent.name}"
            for path in self._out.glob("*/flights/runs/*/result.json")
        ]
        assert all(calls[name] for name in flown)
        done = [*flown, *(path.parent.name for path in self._states())]
        self._kept, self._calls = now, Counter({name: calls[name] for name in done})

    def _reported(self) -> bool:
        """True if the last step of the present reproduction has begun."""
        file = self._home / "calls"
        return file.is_file() and "report" in file.read_text().splitlines()

    def _states(self) -> list[Path]:
        return list(self._out.glob("*/part.json"))

    def _finished(self) -> list[Path]:
        return [*self._states(), *self._out.glob("*/flights/runs/*/result.json")]

    def _all_calls(self) -> Counter[str]:
        file = self._home / "calls"
        return Counter(file.read_text().splitlines() if file.is_file() else [])


@pytest.mark.slow
def test_a_signal_costs_no_finished_part_or_flight(tmp_path: Path) -> None:
    killed = Killed(tmp_path, signal.SIGTERM, 0, MOST)
    while not killed.kill():
        pass  # it ended first
    killed.finish()


@pytest.mark.slow
@pytest.mark.parametrize("number", SIGNALS)
def test_twenty_signals_cost_no_finished_part_or_flight(number: int, tmp_path: Path) -> None:
    killed, kills = Killed(tmp_path, number, seed=100 + number), 0
    while kills < 20:
        kills += killed.kill()
    killed.finish()
