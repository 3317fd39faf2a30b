"""Benchmark of the whole loop on flights with all sensors and recording."""

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from numba.core import event

from touchdown.experiments.config.loading import load_config
from touchdown.experiments.config.schema import Config
from touchdown.experiments.io.results import RunResult

T = TypeVar("T")

_ATTEMPTS = 3
SHORT_SURVEY = (
    "survey.legs=2",
    "survey.leg_length_m=25.0",
    "survey.leg_spacing_m=15.0",
    "survey.duration_s=14.0",
)
"""of flights that measure speed, settings by dotted keys"""


def bench_config(*, full: bool, overrides: Sequence[str] = (), **chosen: Any) -> Config:
    """Configuration of a landing; unless ``full``, after a short survey. Raises UsageError."""
    return load_config(None, (*overrides, *(() if full else SHORT_SURVEY)), **chosen)


def compiled_before(measure: Callable[[], T]) -> T:
    """``measure()``, once more if kernels were compiled meanwhile, in whatever thread: the next
    time they come from the cache on disk, or from memory."""
    for _ in range(_ATTEMPTS - 1):
        listener = event.RecordingListener()
        with event.install_listener("numba:compile", listener):
            found = measure()
        if not listener.buffer:
            return found
    return measure()


def measure_loop(config: Config, fly: Callable[[Config, Path], RunResult]) -> dict[str, Any]:
    """Flies in a temporary directory, once more if kernels were compiled during the flight.

    ``result`` is the flight's result; ``figures`` holds ``real_time_factor``, ``stage_ms`` (wall
    milliseconds per 0.1 s of flight, one LIDAR scan), ``stage_fraction`` of the wall time, and
    ``recording_mb``.
    """
    with tempfile.TemporaryDirectory(prefix="touchdown-bench-") as folder:
        out = Path(folder) / "run"
        result = compiled_before(lambda: fly(config, out))
        recording_mb = (out / "flight.rrd").stat().st_size / 1e6
    plain = result.plain()
    timing = plain["timing"]
    per_scan_ms = 100.0 / timing["real_time_factor"]
    stages = timing["stage_ms"]
    figures = {
        "scene": result.scene,
        "estimator": result.estimator,
        "outcome": result.outcome,
        "sim_s": timing["sim_s"],
        "wall_s": timing["wall_s"],
        "real_time_factor": timing["real_time_factor"],
        "renderer": result.renderer,
        "stage_ms": stages,
        "stage_fraction": {name: ms / per_scan_ms for name, ms in stages.items()},
        "recording_mb": recording_mb,
    }
    return {"result": result, "figures": figures}
