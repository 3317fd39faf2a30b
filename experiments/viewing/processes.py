"""Processes of the Rerun viewer, their ports, and the viewer of a flight in progress."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlsplit

import click

from touchdown.experiments.errors import UsageError
from touchdown.experiments.external.processes import guarded
from touchdown.sim.opengl import has_display

LOCALHOST = "127.0.0.1"
WEB_PORT, DATA_PORT = 9090, 9876
"""Rerun's defaults: the page and the data that it loads."""
_SHUTDOWN_S = 5.0
_START_S = 30.0


def web_viewer(recording: str | None = None) -> tuple[list[str], int, int]:
    """The command that serves a recording, or what flights send, to a browser on this machine, and
    the ports of the page and of the data."""
    page, data = free_port(WEB_PORT), free_port(DATA_PORT)
    command = [sys.executable, "-m", "rerun", *([recording] if recording else [])]
    # --web-viewer opens a browser as well
    command += ["--web-viewer" if has_display() else "--serve-web", "--bind", LOCALHOST]
    return [*command, "--web-viewer-port", str(page), "--port", str(data)], page, data


def compacted(recording: Path, folder: Path) -> Path:
    """Returns a copy of ``recording`` in ``folder`` with its chunks joined, which a browser loads
    several times faster, or ``recording`` where Rerun cannot join them."""
    copy = folder / recording.name
    command = [sys.executable, "-m", "rerun", "rrd", "optimize", str(recording), "-o", str(copy)]
    done = subprocess.run(command, capture_output=True)
    return copy if done.returncode == 0 and copy.is_file() else recording


class LiveView:
    """The viewer that shows a flight while it goes on."""

    def __init__(self, address: str, served: subprocess.Popen[bytes] | None = None) -> None:
        self.address = address
        """to which the flight streams"""
        self._served = served

    def stay(self) -> None:
        """Serves a page until Ctrl-C, where somebody sits at the terminal."""
        if self._served is not None and sys.stderr.isatty():
            click.echo("the viewer shows the flight until Ctrl-C", err=True)
            with contextlib.suppress(KeyboardInterrupt):
                self._served.wait()


@contextlib.contextmanager
def live_viewer(target: str) -> Iterator[LiveView]:
    """Opens the viewer for a flight: ``window``, ``web`` (a page on this machine), ``auto`` (a
    window where there is a display), or the address of a viewer that runs.
    Raises UsageError where none can be reached."""
    if target == "window" or (target == "auto" and has_display()):
        yield LiveView(_spawned())
    elif target in ("web", "auto"):
        command, page, data = web_viewer()
        served = _start(command)
        try:
            _wait_for(served, data)
            click.echo(address_text(page, data), err=True)
            yield LiveView(_url(data), served)
        finally:
            _end_group(served)
    else:
        parts = urlsplit(target)
        if not _answers(parts.hostname or LOCALHOST, parts.port or DATA_PORT):
            raise UsageError(f"no viewer answers at --live {target}; start one there: rerun")
        yield LiveView(target)


def _spawned() -> str:
    """Opens a window, or takes the one that is open; it stays when the flight is over."""
    import rerun as rr

    if not has_display():
        raise UsageError("there is no display to open a window on; give --live web")
    rr.spawn(port=DATA_PORT, connect=False, hide_welcome_screen=True)
    return _url(DATA_PORT)


def _url(data: int) -> str:
    return f"rerun+http://{LOCALHOST}:{data}/proxy"


def _wait_for(served: subprocess.Popen[bytes], port: int) -> None:
    deadline = time.monotonic() + _START_S
    while not _answers(LOCALHOST, port):
        if served.poll() is not None or time.monotonic() > deadline:
            raise UsageError(
                "the Rerun viewer did not start; does `python -m rerun --version` work?"
            )
        time.sleep(0.05)


def _answers(host: str, port: int) -> bool:
    try:
        with socket.create_connection((host, port), timeout=2.0):
            return True
    except OSError:
        return False


def address_text(page: int, data: int) -> str:
    """The address of the web viewer and the ssh command that forwards both of its ports."""
    import getpass

    source = quote(_url(data), safe="")
    forward = " ".join(f"-L {port}:{LOCALHOST}:{port}" for port in (page, data))
    return (
        f"http://{LOCALHOST}:{page}?url={source}\n"
        f"from another machine, first: ssh {forward} {getpass.getuser()}@{socket.gethostname()}"
    )


def free_port(preferred: int) -> int:
    """``preferred`` where it is free on localhost, else any free port."""
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
    viewer = _start(command)
    try:
        return viewer.wait()
    finally:
        _end_group(viewer)


def _start(command: list[str]) -> subprocess.Popen[bytes]:
    program, environment = guarded(command)
    return subprocess.Popen(program, env=environment, start_new_session=True)


def _end_group(viewer: subprocess.Popen[bytes]) -> None:
    """Ends the processes of a viewer; those that outlive its first one are killed."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(viewer.pid, number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            viewer.wait(_SHUTDOWN_S)
