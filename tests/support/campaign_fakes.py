"""Fake flights for tests of campaigns. Each estimator names a behaviour."""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path
from typing import Any

from touchdown.experiments.config.loading import dump_config
from touchdown.experiments.config.schema import Config
from touchdown.experiments.io.results import RunResult


def fly(config: Config, out: Path) -> RunResult:
    """Fills ``out`` as a flight does; the figures follow from scene, seed and wind alone."""
    behaviour = config.estimator.partition(":")[2]
    with (campaign_dir(out) / "attempts.log").open("a") as log:
        log.write(f"{out.name} {config.record}\n")
    attempts = (campaign_dir(out) / "attempts.log").read_text().split("\n")
    first = sum(line.startswith(f"{out.name} ") for line in attempts) == 1
    partial = out.with_name(f"{out.name}.flying")
    partial.mkdir()
    (partial / "truth.tum").write_text(f"0 {config.seed} 0 0 0 0 0 1\n")
    (partial / "estimate.tum").write_text("0 0 0 0 0 0 0 1\n")
    if behaviour == "slow":
        time.sleep(0.2)
    elif behaviour == "hangs":
        time.sleep(600.0)
    elif behaviour == "raises" or (behaviour == "raises_once" and first):
        raise RuntimeError("a wing\ncame off")
    elif behaviour == "segfaults":
        os.kill(os.getpid(), signal.SIGSEGV)
    elif behaviour == "is_killed_once" and first:
        os.kill(os.getpid(), signal.SIGKILL)
    elif behaviour == "grows":
        hoard = bytearray(400_000_000)
        hoard[::4096] = b"x" * len(hoard[::4096])
        time.sleep(600.0)
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


def campaign_dir(out: Path) -> Path:
    """``out`` is RUNS/.partial/RUN.PID/RUN."""
    return out.parents[2]


def fake_result(config: Config, outcome: str) -> dict[str, Any]:
    error = 0.1 + 0.01 * config.seed + 0.001 * config.wind.mean_kmh + 0.1 * len(config.scene)
    return {
        "outcome": outcome,
        "reason": "",
        "scene": config.scene,
        "seed": config.seed,
        "estimator": config.estimator,
        "wind_kmh": config.wind.mean_kmh,
        "position_error_m": {"mean": error, "rmse": error, "max": 2 * error},
        "trajectory_error_m": error,
        "landing": None,
        "timing": {
            "wall_s": 0.002,
            "sim_s": 0.1,
            "real_time_factor": 50.0,
            "stage_ms": {"world": 1.0, "estimator": 0.5},
        },
        "versions": {"touchdown": "0.1.0"},
        "git_revision": "abc",
    }
