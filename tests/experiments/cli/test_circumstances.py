"""External conditions: a full disk, Ctrl-C, a closed pipe, unusual names."""

import errno
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from touchdown.experiments.cli import main as cli
from touchdown.experiments.config.schema import Config
from touchdown.experiments.io.results import RunResult
from touchdown.experiments.io.run_directory import run_directory

from support.campaign_fakes import fake_result
from support.command import RunCli, Says, python

ROOT = Path(__file__).parents[3]


def _one_line(error: str) -> bool:
    return error.startswith("touchdown: error: ") and error.count("\n") == 1


def _flight(ends: Callable[[Path], None]) -> Callable[..., RunResult]:
    """A flight that writes half of its files and then fails."""

    def fly(config: Config, out: Path, progress: Any, _live: Any) -> RunResult:
        with run_directory(out) as partial:
            progress(0.0, "TAKEOFF", "")
            (partial / "truth.tum").write_text("0 0 0")
            ends(partial)
            (partial / "result.json").write_text("{}")
        return RunResult.model_validate(fake_result(config, "COMPLETED"))

    return fly


def _raise(error: BaseException) -> Callable[[Path], None]:
    def ends(_partial: Path) -> None:
        raise error

    return ends


@pytest.mark.parametrize(("number", "fragment"), [
    (errno.ENOSPC, "No space left on device; make room"), (errno.EDQUOT, "make room"),
    (errno.EFBIG, "ulimit -f"),
    (errno.EROFS, "Read-only file system; name a path"),
    (errno.EACCES, "Permission denied; name one that you may use"), (errno.EIO, "may be full"),
    (errno.ENAMETOOLONG, "give a shorter name"), (errno.ENOTDIR, "a part of that path is a file"),
])  # fmt: skip
def test_a_disk_error_in_flight_is_one_line_and_leaves_the_earlier_run(
    number: int, fragment: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run_cli: RunCli
) -> None:
    failure = _raise(OSError(number, os.strerror(number), "/a/.partial-1/truth.tum"))
    monkeypatch.setattr("touchdown.experiments.flight.run.fly", _flight(failure))
    out = tmp_path / "mit ümlaut" / "run"
    out.mkdir(parents=True)
    (out / "result.json").write_text('{"old": 1}')
    code, _, err = run_cli("fly", "flat", "--out", str(out), "--quiet")
    assert (code, _one_line(err)) == (2, True)
    assert fragment in err and str(out) in err and "partial" not in err
    assert list(out.parent.iterdir()) == [out]
    assert (out / "result.json").read_text() == '{"old": 1}'


def test_an_internal_error_keeps_its_traceback(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    failure = _raise(FileNotFoundError(errno.ENOENT, "gone", "x"))
    monkeypatch.setattr("touchdown.experiments.flight.run.fly", _flight(failure))
    with pytest.raises(FileNotFoundError):
        cli.main(["fly", "flat", "--out", str(tmp_path / "run"), "--quiet"])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_in_flight_is_one_line_and_leaves_no_files(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run_cli: RunCli
) -> None:
    before = {kind: signal.getsignal(kind) for kind in (signal.SIGINT, signal.SIGTERM)}
    # Background jobs of a shell ignore Ctrl-C.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    monkeypatch.setattr(
        "touchdown.experiments.flight.run.fly",
        _flight(lambda _partial: signal.raise_signal(number)),
    )
    code, out, err = run_cli("land", "flat", "--out", str(tmp_path / "run"), "--quiet")
    for kind, handler in before.items():
        signal.signal(kind, handler)
    assert (code, out, err.strip()) == (128 + number, "", "touchdown: interrupted")
    assert list(tmp_path.iterdir()) == []


def test_arguments_that_are_not_utf_8_are_refused(run_cli: RunCli) -> None:
    code, _, err = run_cli("scenes", "export", "flat", "--out", "a\udcff")
    assert (code, _one_line(err)) == (2, True) and "'a\\udcff' is not UTF-8 text" in err


def _command(*arguments: str, **changes: Any) -> subprocess.CompletedProcess[bytes]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **changes.pop("env", {})}
    return subprocess.run(
        [sys.executable, "-m", "touchdown", *arguments], env=environment, timeout=600, check=False,
        **{"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **changes},
    )  # fmt: skip


def test_a_closed_pipe_is_no_error() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    done = _command("scenes", "list", stdout=writer)
    os.close(writer)
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="Linux has it")
def test_unwritable_output_is_reported() -> None:
    with open("/dev/full", "wb") as full:
        done = _command("scenes", "list", stdout=full)
    assert done.returncode == 2
    assert _one_line(done.stderr.decode()) and b"No space left" in done.stderr


def test_no_terminal_no_colour_and_forty_columns(tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    (run / "result.json").write_text(json.dumps(fake_result(Config(scene="flat"), "COMPLETED")))
    sql = "select scene, seed, wind_kmh from runs"
    for env in ({"NO_COLOR": "1", "COLUMNS": "40", "TERM": "dumb"}, {"LC_ALL": "C"}):
        done = _command("query", str(tmp_path), sql, env=env, stdin=subprocess.DEVNULL)
        assert (done.returncode, done.stderr) == (0, b"")
        assert b"\x1b" not in done.stdout and b"wind_kmh" in done.stdout


def test_links_in_a_circle(tmp_path: Path, says: Says) -> None:
    """Wherever a path is given, one line names it."""
    circle = tmp_path / "circle"
    circle.symlink_to(circle)
    network, inner = tmp_path / "network.onnx", str(circle / "x")
    network.symlink_to(network)
    for command in (
        ("fly", "flat", "--out", str(circle)),
        ("fly", "flat", "--out", inner),
        ("fly", "flat", "--config", str(circle)),
        ("fly", inner),
        ("report", str(circle)),
        ("query", inner, "select 1"),
        ("export", str(circle), "--format", "tum"),
        ("campaign", "status", str(circle)),
        ("scenes", "import-dem", str(circle), str(tmp_path / "out")),
        ("quantize", str(network), "--data", str(tmp_path), "--out", str(tmp_path / "o.onnx")),
        ("classify", str(circle), "--out", inner),
    ):
        lines = says(2, *list(command)).err.strip().splitlines()
        assert len(lines) == 1 and lines[0].startswith("touchdown: error: "), (command, lines)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["circle", "network.onnx"]


def test_what_libraries_log_is_not_printed() -> None:
    code = (
        "import logging\nfrom touchdown.experiments.cli.main import main\n"
        "main(['scenes', 'list'])\n"
        "logging.getLogger('PIL').error('More samples per pixel than can be decoded')"
    )
    done = python("-c", code, check=True)
    assert "crossroad" in done.stdout and not done.stderr
