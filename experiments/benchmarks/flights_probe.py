"""Two landings in one process on one thread, as a worker of a campaign flies them: prints what the
second costs as one JSON object. Runs as a file on any checkout that has these classes.

All times are processor times of all threads, those of a renderer in software too; those of picture,
scan and estimator are of the calls of their classes' methods.
"""

from __future__ import annotations

import json
import os
import re
import time
from pathlib import Path
from typing import Any

SCENE, SEEDS = "crossroad", (1, 2)


class Clock:
    """Calls and seconds of processor time of a method of a class."""

    def __init__(self, owner: Any, *names: str) -> None:
        self.calls, self.seconds = 0, 0.0
        for name in names:
            setattr(owner, name, self._timed(getattr(owner, name)))

    def _timed(self, method: Any) -> Any:
        def call(*arguments: Any, **named: Any) -> Any:
            start = time.process_time()
            try:
                return method(*arguments, **named)
            finally:
                self.calls += 1
                self.seconds += time.process_time() - start

        return call

    def reset(self) -> None:
        self.calls, self.seconds = 0, 0.0

    def ms(self) -> float:
        return 1e3 * self.seconds / max(self.calls, 1)


def anonymous_mb() -> float:
    """Anonymous memory of this process."""
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    found = re.search(r"RssAnon:\s+(\d+) kB", status)
    return int(found[1]) / 1e3 if found else float("nan")


def main() -> None:
    """Flies and prints."""
    os.environ["LP_NUM_THREADS"] = "0"  # as a worker: Mesa draws on the calling thread
    from touchdown.estimator.livo.estimator import Livo
    from touchdown.experiments.config.loading import load_config
    from touchdown.experiments.flight.run import fly
    from touchdown.sim.camera.sensor import CameraSensor
    from touchdown.sim.lidar.sensor import LidarSensor

    picture, scan = Clock(CameraSensor, "render", "render_rows"), Clock(LidarSensor, "scan")
    estimator = Clock(Livo, "update")
    peaks: list[float] = []
    figures: dict[str, Any] = {}
    for seed in SEEDS:
        config = load_config(
            None, ["sim.threads=1"], scene=SCENE, estimator="livo", seed=seed, record=False
        )
        for clock in (picture, scan, estimator):
            clock.reset()
        seen: list[tuple[float, float]] = []
        began = time.process_time()
        result = fly(config, None, lambda *_: seen.append((time.process_time(), anonymous_mb())))  # noqa: B023
        spent = time.process_time() - began
        peaks.append(max(memory for _, memory in seen))
        timing: Any = result.plain()["timing"]
        figures = {
            "outcome": str(result.outcome),
            "core_s_per_s": spent / timing["sim_s"],
            "picture_ms": picture.ms(),
            "scan_ms": scan.ms(),
            "estimator_ms": 100.0 * estimator.seconds / timing["sim_s"],
            "set_up_s": seen[0][0] - began,
        }
    print(json.dumps(figures | {"first_mb": peaks[0], "second_mb": peaks[1]}))


if __name__ == "__main__":
    main()
