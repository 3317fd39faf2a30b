"""The command line. A command imports what it needs when it runs, so that help is instant."""

import atexit
import gc
import io
import logging
import os
import signal
import sys
import warnings
from collections.abc import Sequence
from typing import Any

import click

from touchdown.experiments.cli.common import (
    EXIT_DONE,
    EXIT_USAGE,
    CommandGroup,
    TerminatedError,
    interrupt_code,
)
from touchdown.experiments.errors import UsageError, system_message, visible
from touchdown.experiments.external.processes import run_in_child, runs_external_code
from touchdown.experiments.flight.platform import BLAS_THREADS, rendering_fault
from touchdown.experiments.terminal import end_progress, error_line, warning_line
from touchdown.sim.opengl import rendering_backend

_MODULES = {
    "bench": ("bench",),
    "maps": ("maps",),
    "campaign": ("campaign", "merge", "reproduce", "results"),
    "classification": ("classify", "dataset", "ensemble", "evaluate", "quantize", "train"),
    "doctor": ("doctor",),
    "fly": ("fly", "land"),
    "gap": ("gap",),
    "keys": ("config",),
    "people": ("people",),
    "parts": ("calibrate", "check-estimator", "check-plugin", "control", "edges", "px4"),
    "replay": ("datasets", "replay"),
    "report": ("query", "regress", "report"),
    "scenes": ("scenes",),
    "vehicles": ("vehicles",),
    "view": ("export", "view"),
}
"""The commands of each module."""
COMMANDS = {
    name: f"{module}:{name.replace('-', '_')}"
    for module, names in _MODULES.items()
    for name in names
}


@click.group(cls=CommandGroup, modules=COMMANDS, invoke_without_command=True)
@click.version_option(package_name="touchdown-sim", prog_name="touchdown")
@click.pass_context
def cli(context: click.Context) -> None:
    """Fly, map, choose a site and land a simulated quadrotor without GPS.

    Example: touchdown land crossroad
    """
    if context.invoked_subcommand is None:
        click.echo(context.get_help())


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command and returns its exit code; bad input is one line on stderr. As the program,
    without ``arguments``, a command that runs code of others gets a process of its own."""
    if arguments is None:
        # Python would search all that is left of a flight as it ends, for up to a second.
        atexit.register(gc.freeze)
    if arguments is None and runs_external_code(sys.argv[1:]):
        code, fault = run_in_child(lambda: _run(None))
        if fault:
            print(error_line(fault), file=sys.stderr)
        return code
    return _run(arguments)


def _run(arguments: Sequence[str] | None) -> int:
    os.environ.setdefault("MUJOCO_GL", rendering_backend())
    # What a command computes does not depend on the environment, nor on what is wrong in it.
    os.environ.update(dict.fromkeys((BLAS_THREADS, "NUMBA_NUM_THREADS"), "1"))
    # `experiments.recording.rerun_recorder` reports in one line what could not be written.
    os.environ.setdefault("RUST_LOG", "warn,re_log_encoding=off")
    warnings.formatwarning = _one_line_warning
    # What libraries log, Pillow for one, is not for the terminal: an error is one line.
    logging.getLogger().addHandler(logging.NullHandler())
    signal.signal(signal.SIGTERM, _interrupt)
    _print_any_name()
    for word in sys.argv[1:] if arguments is None else arguments:
        if not word.isascii() and any("\ud800" <= letter <= "\udfff" for letter in word):
            return _fail(f"'{word}' is not UTF-8 text; rename the file, or correct the argument")
    try:
        code = cli.main(
            args=None if arguments is None else list(arguments),
            prog_name="touchdown",
            standalone_mode=False,
        )
        if sys.stdout is not None:
            sys.stdout.flush()  # errors here are reported below, not at the interpreter's end
    except click.ClickException as error:
        return _fail(_click_message(error))
    except (click.Abort, KeyboardInterrupt) as error:
        end_progress(quiet=False)
        print(f"touchdown: {visible(error) or 'interrupted'}", file=sys.stderr)
        return interrupt_code(error.__cause__ or error)
    except SystemExit:
        # click raises this when the reader of a pipe has gone, which is no failure.
        if not type(sys.stdout).__name__.endswith("PacifyFlushWrapper"):
            raise
        return EXIT_DONE
    except BrokenPipeError:
        _let_go_of_stdout()
        return EXIT_DONE
    except UsageError as error:
        return _fail(str(error))
    except OSError as error:
        message = system_message(error)
        if message is None:
            raise
        _let_go_of_stdout()
        return _fail(message)
    except (RuntimeError, ImportError, AttributeError) as error:
        if fault := rendering_fault(error):
            return _fail(fault)
        # What `Path.resolve` raises for links in a circle, before Python 3.13.
        if not str(error).startswith(_CIRCLE):
            raise
        where = str(error).removeprefix(_CIRCLE)
        return _fail(f"{where}: its links lead in a circle; name the target itself")
    return int(code or 0)


_CIRCLE = "Symlink loop from "


def _one_line_warning(message: Warning | str, *_where: Any, **_more: Any) -> str:
    return f"{warning_line(message)}\n"


def _print_any_name() -> None:
    """Names that the encoding of the terminal has no characters for are printed as escapes."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _interrupt(_signal: int, _frame: Any) -> None:
    raise TerminatedError


def _let_go_of_stdout() -> None:
    """Drops output that could not be written, so that the interpreter does not retry at its end."""
    try:
        sys.stdout.flush()
    except OSError:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115  nothing is left to close it
        sys.__stdout__ = sys.stdout  # type: ignore[misc]


def _fail(message: str) -> int:
    end_progress(quiet=False)
    print(error_line(message), file=sys.stderr)
    return EXIT_USAGE


def _click_message(error: click.ClickException) -> str:
    """Click's message in one line, with the command that prints the help."""
    context: click.Context | None = getattr(error, "ctx", None)
    no_command = isinstance(error, click.exceptions.NoArgsIsHelpError)
    if context is not None and no_command and isinstance(context.command, click.Group):
        known = ", ".join(context.command.list_commands(context))
        return f"'{context.command_path}' needs a command: {known}"
    message = error.format_message().rstrip(".")
    message = message[:1].lower() + message[1:]
    return f"{message}; see '{context.command_path} --help'" if context else message
