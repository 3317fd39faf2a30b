"""Progress of a campaign on stderr: a bar with the remaining time on a terminal, otherwise one line
per run."""

import sys
import time
from collections.abc import Mapping, Sequence
from typing import Any

from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from touchdown.experiments.campaign import expectations
from touchdown.experiments.campaign.executor import Event
from touchdown.experiments.campaign.session import Watcher
from touchdown.experiments.campaign.worker import Task
from touchdown.experiments.errors import visible
from touchdown.experiments.terminal import make_console, make_table


class Display(Watcher):
    """Watcher that shows the bar or prints the lines; first ``heading``, once the campaign has been
    checked."""

    def __init__(self, heading: Sequence[str] = ()) -> None:
        self._heading = heading
        self._console = make_console(stderr=True)
        self._live = self._console.is_terminal
        self._counts = {"finished": 0, "failed": 0, "unsuccessful": 0}
        self._progress: Progress | None = None

    def start(self, todo: Sequence[Task], done: int, jobs: int) -> None:
        self._total, self._number = done + len(todo), done
        self._started: dict[str, float] = {}
        for line in self._heading:
            self._say(line)
        note = f"{done} of {self._total} runs are there already; " if done else ""
        self._say(f"{note}flying {len(todo)} on {min(jobs, max(1, len(todo)))} workers")
        if self._live and todo:
            self._progress = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TimeRemainingColumn(),
                console=self._console,
                transient=True,
                speed_estimate_period=86400.0,
            )
            self._bar = self._progress.add_task("", total=self._total, completed=done)
            self._progress.start()

    def record(self, todo: Sequence[Task]) -> None:
        if todo:
            self._say(f"once more, to record what was unsuccessful: {len(todo)}")

    def see(self, event: Event) -> None:
        now, run_id, kind = time.monotonic(), event["run_id"], event["event"]
        if kind == "started":
            self._started[run_id] = now
        elif kind in ("finished", "failed"):
            self._number += 1
            self._counts[kind] += 1
            success = event.get("success", False)
            self._counts["unsuccessful"] += kind == "finished" and not success
            text = event.get("outcome") or f"CRASHED: {event['error']}"
            if not (self._live and success):
                took = now - self._started.get(run_id, now)
                self._say(f"[{self._number}/{self._total}] {run_id}  {text}  {took:.0f} s")
        elif kind == "retry":
            self._say(f"{run_id}: {event['error']}; once more")
        elif kind == "unrecorded":
            self._say(f"{run_id}: no recording: {event['error']}")
        if self._progress is not None:
            counts = self._counts
            self._progress.update(
                self._bar,
                completed=self._number,
                description=f"{counts['unsuccessful']} unsuccessful, {counts['failed']} crashed",
            )

    def end(self) -> None:
        if self._progress is not None:
            self._progress.stop()
            self._progress = None

    def _say(self, text: str) -> None:
        if self._live:
            self._console.print(text)
        else:
            print(visible(text), file=sys.stderr, flush=True)


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def print_summary(figures: Mapping[str, Any]) -> None:
    """Prints the progress, the outcomes and the cost of a campaign."""
    console = make_console()
    console.print(
        f"{figures['name']}: {figures['finished']} of {figures['runs']} runs finished, "
        f"{figures['crashed']} crashed, {figures['remaining']} to go, "
        f"{_clock(figures['wall_s'])} so far"
        + ("" if figures["left_s"] is None else f", about {_clock(figures['left_s'])} left")
    )
    if figures["outcomes"]:
        counts = ", ".join(f"{name} {count}" for name, count in figures["outcomes"].items())
        console.print(f"outcomes: {counts}")
    if figures["flying"]:
        console.print(f"in the air: {', '.join(figures['flying'])}", soft_wrap=True)
    if figures["estimators"]:
        console.print(_cost_table(figures["estimators"]))
    for run_id, error in figures["errors"].items():
        console.print(f"crashed: {run_id}: {error or ''}", soft_wrap=True)
    for line in figures["idle_conditions"]:
        console.print(f"warning: {line}", soft_wrap=True)
    for line in expectations.lines([expectations.verdict_of(v) for v in figures["expectations"]]):
        console.print(line, soft_wrap=True)
    console.print(f"table: {figures['results']}", soft_wrap=True)


def _cost_table(estimators: Mapping[str, Any]) -> Table:
    """Table of the mean cost of a run, with four stages and the rest; `--json` has all stages."""
    shown = ("set_up", "world", "estimator", "mapper")
    title = "a run on average, and where its time went"
    heads = ("runs", "wall s", "cpu s", "set-up", "sensors", "estimator", "mapper", "rest")
    table = make_table(title, "estimator", *heads)
    table.box = None
    for name, cost in estimators.items():
        runs = max(1, cost["runs"])
        fractions = [cost["stage_fraction"].get(stage, 0.0) for stage in shown]
        table.add_row(
            name,
            str(cost["runs"]),
            f"{cost['wall_s'] / runs:.1f}",
            f"{cost['cpu_s'] / runs:.1f}",
            *(f"{fraction:.0%}" for fraction in (*fractions, 1.0 - sum(fractions))),
        )
    return table
