"""Fake flights for tests of campaigns. Each estimator names a behaviour."""

import contextlib
import json
import mmap
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from touchdown.experiments.config.loading import dump_config
from touchdown.experiments.config.schema import Config
from touchdown.experiments.io.results import RunResult

SIZE, PAGE = 500_000_000, 4096
"""bytes that some of them take, and of a page of memory at least"""


def fly(config: Config, out: Path) -> RunResult:
    """Fills ``out`` as a flight does; the figures follow from scene, seed and wind alone."""
    behaviour = config.estimator.partition(":")[2]
    with (campaign_dir(out) / "attempts.log").open("a") as log:
        log.write(f"{out.name} {config.record}\n")
    attempts = (campaign_dir(out) / "attempts.log").read_text().split("\n")
    first = sum(line.startswith(f"{out.name} ") for line in attempts) == 1
    (out.parent / "pid").write_text(str(os.getpid()))
    partial = out.with_name(f"{out.name}.flying")
    partial.mkdir()
    (partial / "truth.tum").write_text(f"0 {config.seed} 0 0 0 0 0 1\n")
    (partial / "estimate.tum").write_text("0 0 0 0 0 0 0 1\n")
    wait_at_gate(campaign_dir(out), len(attempts) - 1)
    if behaviour == "hangs":
        time.sleep(600.0)
    elif behaviour == "raises" or (behaviour == "raises_once" and first):
        raise RuntimeError("a wing\ncame off")
    elif behaviour == "segfaults":
        os.kill(os.getpid(), signal.SIGSEGV)
    elif behaviour == "is_killed_once" and first:
        os.kill(os.getpid(), signal.SIGKILL)
    elif behaviour == "grows":
        hoard = bytearray(SIZE)
        hoard[::PAGE] = b"x" * len(hoard[::PAGE])
        time.sleep(600.0)
    elif behaviour == "litters":
        litter()
    elif behaviour == "maps":
        with mapped_file():
            time.sleep(1.0)  # of several looks of the supervisor
    elif behaviour in PROCESSES:
        PROCESSES[behaviour](campaign_dir(out))
    elif behaviour == "fills_the_disk":
        raise OSError(28, "No space left on device")
    elif behaviour == "prints":
        print('{"event": "idle"}')
    result = fake_result(config, "DIVERGED" if behaviour == "is_lost" else "COMPLETED")
    (partial / "config.json").write_text(dump_config(config))
    (partial / "result.json").write_text(json.dumps(result))
    if config.record:
        (partial / "flight.rrd").write_text("seen")
    os.replace(partial, out)
    return RunResult.model_validate(result)


def wait_at_gate(directory: Path, attempt: int) -> None:
    """Waits while a file ``gate`` beside the campaign holds a smaller number than ``attempt``."""
    gate = directory.with_name("gate")
    while gate.exists() and attempt > int(gate.read_text()):
        time.sleep(0.01)


def litter() -> None:
    """Leaves an object that refers to itself, and freed memory below a block in use."""
    loop: list[Any] = [b"x" * (SIZE // 5)]
    loop.append(loop)
    blocks = [b"x" * 10 * PAGE for _ in range(SIZE // 5 // 10 // PAGE)]
    KEPT.append(blocks[-1])


KEPT: list[bytes] = []


@contextlib.contextmanager
def mapped_file() -> Iterator[None]:
    """A file of ``SIZE`` bytes is mapped, and every page of it was read. It does not lie where the
    system may keep files in memory."""
    with tempfile.TemporaryFile(dir="/var/tmp") as file:
        file.truncate(SIZE)
        with mmap.mmap(file.fileno(), SIZE, prot=mmap.PROT_READ) as pages:
            assert not any(pages[::PAGE])
            yield


def start_three(directory: Path) -> None:
    """Starts a program, one in a session of its own, and a daemon: its parent is gone. Returns when
    all have written their process id."""
    command = f"echo $$ >> '{directory}/pids.log'; exec sleep 1000"
    subprocess.Popen(["sh", "-c", command])
    subprocess.Popen(["sh", "-c", command], start_new_session=True)
    subprocess.run(["sh", "-c", f'setsid sh -c "{command}" &'.replace("$$", "\\$\\$")], check=True)
    while len(started(directory)) < 3:
        time.sleep(0.01)


def started(directory: Path) -> list[int]:
    """Process ids in ``pids.log``."""
    file = directory / "pids.log"
    return [int(line) for line in file.read_text().split()] if file.exists() else []


def fork_and_exit(directory: Path) -> None:
    """Leaves a copy of the worker with all its pipes."""
    if (pid := os.fork()) == 0:
        time.sleep(1000.0)
        os._exit(0)
    (directory / "pids.log").write_text(f"{pid}\n")
    os._exit(3)


def start_and_crash(directory: Path) -> None:
    start_three(directory)
    os.kill(os.getpid(), signal.SIGSEGV)


def start_and_hang(directory: Path) -> None:
    start_three(directory)
    time.sleep(1000.0)


def feed_a_child(_directory: Path) -> None:
    """A child takes the memory."""
    code = f"x = bytearray({SIZE}); x[::{PAGE}] = b'x' * len(x[::{PAGE}]); input()"
    subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE)
    time.sleep(1000.0)


def share_memory(_directory: Path) -> None:
    """Four children see the same memory, which they did not take."""
    shared = bytearray(SIZE // 4)
    shared[::PAGE] = b"x" * len(shared[::PAGE])
    children = []
    for _ in range(4):
        if (pid := os.fork()) == 0:
            time.sleep(2.0)
            os._exit(0)
        children.append(pid)
    for pid in children:
        os.waitpid(pid, 0)


PROCESSES: dict[str, Callable[[Path], None]] = {
    "forks": fork_and_exit, "starts_and_crashes": start_and_crash,
    "starts_and_hangs": start_and_hang, "leaves": start_three, "feeds_a_child": feed_a_child,
    "shares": share_memory,
}  # fmt: skip


def campaign_dir(out: Path) -> Path:
    """``out`` is RUNS/.partial/RUN.PID/RUN."""
    return out.parents[2]


def fake_result(config: Config, outcome: str) -> dict[str, Any]:
    error = 0.1 + 0.01 * config.seed + 0.001 * config.wind.mean_kmh + 0.1 * len(config.scene)
    return {
        "outcome": outcome, "reason": "", "scene": config.scene, "seed": config.seed,
        "estimator": config.estimator, "wind_kmh": config.wind.mean_kmh,
        "position_error_m": {"mean": error, "rmse": error, "max": 2 * error},
        "trajectory_error_m": error, "landing": None,
        "timing": {
            "wall_s": 0.002, "sim_s": 0.1, "real_time_factor": 50.0,
            "stage_ms": {"world": 1.0, "estimator": 0.5},
        },
        "versions": {"touchdown": "0.1.0"}, "git_revision": "abc",
    }  # fmt: skip
