"""The command `touchdown view`."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any
from urllib.parse import quote

import click

from touchdown.experiments.campaign import guard
from touchdown.experiments.cli.common import EXIT_DONE, EXIT_FAILED, PATH
from touchdown.experiments.flight.platform import has_display

LOCALHOST = "127.0.0.1"
WEB_PORT, DATA_PORT = 9090, 9876
"""Rerun's defaults: the page and the data that it loads."""
_PATIENCE_S = 5.0


@click.command()
@click.argument("run", type=PATH)
@click.option(
    "--web",
    is_flag=True,
    help="Serve the viewer to a browser on this machine; prints its address and the ssh command "
    "that opens it on another machine.",
)
def view(run: Path, web: bool) -> int:
    """Open the recording of RUN, a run directory, in the Rerun viewer.

    With --web the viewer listens on localhost only, until Ctrl-C.

    Example: touchdown view runs/crossroad-livo-0
    """
    from touchdown.experiments.errors import UsageError
    from touchdown.sim.files.opening import no_file

    recording = run if run.suffix == ".rrd" else run / "flight.rrd"
    if reason := no_file(recording):
        raise UsageError(
            f"'{recording}' {reason}; name a run directory that was flown without --no-record"
        )
    if not web and sys.platform == "linux" and not has_display():
        raise UsageError(
            f"there is no display to open a window on; give touchdown view {run} --web, or open "
            f"'{recording}' on a machine that has one"
        )
    command = [sys.executable, "-m", "rerun", str(recording)]
    if web:
        page, data = _free_port(WEB_PORT), _free_port(DATA_PORT)
        # --web-viewer opens a browser as well
        command += ["--web-viewer" if has_display() else "--serve-web", "--bind", LOCALHOST]
        command += ["--web-viewer-port", str(page), "--port", str(data)]
        click.echo(address_text(page, data))
    return EXIT_DONE if run_viewer(command) == 0 else EXIT_FAILED


def address_text(page: int, data: int) -> str:
    """The address of the web viewer and the ssh command that forwards both of its ports."""
    import getpass
    import socket

    source = quote(f"rerun+http://{LOCALHOST}:{data}/proxy", safe="")
    forward = " ".join(f"-L {port}:{LOCALHOST}:{port}" for port in (page, data))
    return (
        f"http://{LOCALHOST}:{page}?url={source}\n"
        f"from another machine, first: ssh {forward} {getpass.getuser()}@{socket.gethostname()}"
    )


def _free_port(preferred: int) -> int:
    """``preferred`` where it is free on localhost, else any free port."""
    import socket

    for port in (preferred, 0):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((LOCALHOST, port))
            except OSError:
                continue
            return int(probe.getsockname()[1])
    return preferred


def run_viewer(command: list[str]) -> int:
    """Runs a viewer to its end and returns its exit code. The viewer and its children are a process
    group of their own, which ends with this process, under a guard: at any signal, SIGKILL too."""

    def interrupt(_signal: int, _frame: Any) -> None:
        raise KeyboardInterrupt

    if signal.getsignal(signal.SIGHUP) == signal.SIG_DFL:  # not under nohup
        signal.signal(signal.SIGHUP, interrupt)
    sys.stdout.flush()
    viewer = subprocess.Popen(
        [sys.executable, "-P", "-m", guard.__name__, *command],
        env={**os.environ, guard.SUPERVISOR: str(os.getpid())},
        start_new_session=True,
    )
    try:
        return viewer.wait()
    finally:
        _end_group(viewer)


def _end_group(viewer: subprocess.Popen[bytes]) -> None:
    import contextlib

    for number in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(viewer.pid, number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            viewer.wait(_PATIENCE_S)
            if not _alive(viewer.pid):
                return


def _alive(group: int) -> bool:
    """True if a process of the group is left."""
    import time

    deadline = time.monotonic() + _PATIENCE_S
    while time.monotonic() < deadline:
        try:
            os.killpg(group, 0)
        except (ProcessLookupError, PermissionError):
            return False
        time.sleep(0.05)
    return True
