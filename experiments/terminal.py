"""Terminal output of every command: progress, notes, one-line errors."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from touchdown.experiments.errors import visible

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table


_UNCUT = 4000
"""columns"""
_LONGEST_ERROR, _END_OF_ERROR = 700, 250
"""characters of an error's line; of a longer one the remedy at its end is kept"""


def error_line(message: str) -> str:
    """The one line that stands for a mistake of the user. What it quotes of the input may be of any
    length and hold anything: characters that would steer the terminal are written as escapes."""
    words = visible(" ".join(message.split()))
    if len(words) > _LONGEST_ERROR:
        words = f"{words[: _LONGEST_ERROR - _END_OF_ERROR]} ... {words[-_END_OF_ERROR:]}"
    return f"touchdown: error: {words}"


def warning_line(message: object) -> str:
    """The one line of a warning."""
    return f"touchdown: warning: {visible(' '.join(str(message).split()))}"


def say(text: object = "", *, err: bool = False) -> None:
    """Prints lines to stdout, or to stderr with ``err``. What they name of outside cannot steer the
    terminal."""
    import click

    click.echo(visible(text, keep="\n"), err=err)


def make_console(*, stderr: bool = False) -> Console:
    """Of stdout or stderr. Text is printed as it is: brackets are no markup, colons no emoji, and
    control characters are escapes; styles are given as `rich.text.Text`. Only on a terminal do
    tables have to fit: in a file or a pipe nothing is cut."""
    from rich.console import Console
    from rich.text import Text

    class LiteralConsole(Console):
        def render_str(self, text: str, **options: Any) -> Text:
            return super().render_str(visible(text), **options)

    width = None if stderr or sys.stdout.isatty() else _UNCUT
    return LiteralConsole(stderr=stderr, highlight=False, markup=False, emoji=False, width=width)


def make_table(title: str, *headings: str, left: Collection[str] = ()) -> Table:
    """With its title and first column on the left, and others but ``left`` on the right."""
    from rich.table import Table

    table = Table(title=title, title_justify="left")
    for number, heading in enumerate(headings):
        right = number and heading not in left
        table.add_column(heading, justify="right" if right else "left", no_wrap=True)
    return table


def make_notes(quiet: bool) -> Callable[[str], None]:
    """Prints what is being worked on to stderr."""
    if quiet:
        return lambda _note: None
    return lambda note: print(visible(note, keep="\n"), file=sys.stderr, flush=True)


def make_progress(quiet: bool) -> Callable[[float, str, str], None]:
    """Prints to stderr: one line a phase, and on a terminal a line that is kept up to date."""
    if quiet:
        return lambda _time_s, _phase, _note: None
    live = sys.stderr.isatty()
    started = time.perf_counter()
    seen = ""

    def progress(time_s: float, phase: str, note: str) -> None:
        nonlocal seen
        line = visible(f"{time_s:6.1f} s  {phase:<10} {note}")
        if phase != seen:
            seen = phase
            print(f"\r\033[K{line}" if live else line, file=sys.stderr, flush=True)
        elif live:
            pace = time_s / max(time.perf_counter() - started, 1e-9)
            text = f"{line[:90]}  ({pace:.2f} x real time)"
            print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)

    return progress


def end_progress(quiet: bool) -> None:
    """Leaves the cursor at the start of an empty line."""
    if not quiet and sys.stderr is not None and sys.stderr.isatty():
        print("\r\033[K", end="", file=sys.stderr, flush=True)


@contextmanager
def progress_bar(quiet: bool) -> Iterator[Callable[[int, int, str], None]]:
    """A bar on stderr that shows (done, total, what is being worked on)."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (
        BarColumn(30), MofNCompleteColumn(), TimeRemainingColumn(),
        TextColumn("{task.description}", markup=False),
    )  # fmt: skip
    bar = Progress(*columns, console=make_console(stderr=True), disable=quiet)
    task = bar.add_task("", total=None)

    def progress(done: int, total: int, note: str) -> None:
        # not before there is something to show: bad input is one line
        bar.start()
        bar.update(task, completed=done, total=total, description=visible(note))

    try:
        yield progress
    finally:
        if bar.live.is_started:
            bar.stop()
