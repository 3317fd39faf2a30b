import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from touchdown.experiments.cli import main as cli
from touchdown.experiments.cli import view
from touchdown.experiments.viewing.processes import free_port

from support.campaign_flights import wait_for
from support.command import Says

FAKE_VIEWER = """
import os, pathlib, subprocess, sys
if sys.argv[1] == "rrd":
    pathlib.Path(sys.argv[-1]).write_bytes(b"joined")
    sys.exit()
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(3600)"])
here = pathlib.Path(__file__).parent
(here / "seen.tmp").write_text("\\n".join([str(os.getpid()), str(child.pid), *sys.argv[1:]]))
(here / "seen.tmp").rename(here / "seen")
child.wait()
"""
"""Joins chunks at once; as a viewer starts a child, as Rerun does, and writes both process ids and
its arguments to a file."""


@pytest.fixture
def run(tmp_path: Path) -> Path:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "flight.rrd").write_bytes(b"RRF")
    return tmp_path / "run"


def _without_display(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)


def _gone(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().split()[2] == "Z"
    except FileNotFoundError:
        return True


def test_a_viewer_without_a_display_is_one_line(
    run: Path, monkeypatch: pytest.MonkeyPatch, says: Says
) -> None:
    _without_display(monkeypatch)
    opened: list[list[str]] = []
    monkeypatch.setattr(view, "run_viewer", lambda command: opened.append(command) or 0)
    err = says(2, "view", run).err
    assert "--web" in err and err.count("\n") == 1 and cli.main(["view", str(run), "--web"]) == 0
    monkeypatch.setenv("DISPLAY", ":0")
    assert cli.main(["view", str(run), "--web"]) == 0 and cli.main(["view", str(run)]) == 0
    served, opened_too, window = opened
    assert "--serve-web" in served and "--web-viewer" not in served and "--web-viewer" in opened_too
    assert window[1:] == ["-m", "rerun", str(run / "flight.rrd")]
    for command in (served, opened_too):
        assert command[command.index("--bind") + 1] == "127.0.0.1"


def test_a_port_in_use_is_replaced_by_a_free_one() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert free_port(port) != port
    assert free_port(port) == port


def _default_signals() -> None:
    """Background jobs of a shell ignore SIGINT, those of nohup SIGHUP; others do not."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGKILL])
def test_the_viewer_ends_with_the_command(run: Path, tmp_path: Path, number: int) -> None:
    package = tmp_path / "fake" / "rerun"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "__main__.py").write_text(FAKE_VIEWER)
    environment = {k: v for k, v in os.environ.items() if not k.endswith("DISPLAY")}
    older = os.environ.get("PYTHONPATH", "")
    environment["PYTHONPATH"] = os.pathsep.join([str(package.parent), older])
    command = subprocess.Popen(
        [sys.executable, "-m", "touchdown", "view", str(run), "--web"],
        env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        preexec_fn=_default_signals,
    )  # fmt: skip
    deadline = time.monotonic() + 600.0
    while not (package / "seen").exists():
        assert time.monotonic() < deadline and command.poll() is None
        time.sleep(0.05)
    viewer, child, *arguments = (package / "seen").read_text().splitlines()
    command.send_signal(number)
    out, err = command.communicate(timeout=600.0)
    if number == signal.SIGKILL:
        wait_for(lambda: _gone(int(viewer)) and _gone(int(child)), "the viewer ends")
    else:
        assert command.returncode == (143 if number == signal.SIGTERM else 130)
        assert err.strip() == "touchdown: interrupted"
    assert out.startswith("http://127.0.0.1:") and "ssh -L " in out
    served = Path(arguments[0])
    assert served.name == "flight.rrd" and served.parent != run and arguments[1] == "--serve-web"
    assert number == signal.SIGKILL or not served.exists()
    assert _gone(int(viewer)) and _gone(int(child))
