"""Long flights: error, memory and time per scan of each minute, compared with the first."""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from touchdown.experiments.benchmarks.jit_warmup import compiled_before
from touchdown.experiments.config.loading import load_config
from touchdown.experiments.config.schema import Config
from touchdown.experiments.errors import UsageError, reason_of
from touchdown.experiments.external.processes import memory_bytes
from touchdown.experiments.flight.stage_timer import StageClock, Timed
from touchdown.experiments.recording.run_recorder import NullRecorder
from touchdown.experiments.recording.step_record import StepRecord

_TAIL_S = 15.0
"""duration of climb and hover, which comes on top of the legs"""
_LEG_M, _FIELD_M = 70.0, 76.0


def endurance_config(
    *, scene: str, estimator: str, seed: int, minutes: int, overrides: Sequence[str] = ()
) -> Config:
    """Survey of ``minutes`` minutes with four legs in each, close together, so that most ground is
    revisited. Raises UsageError."""
    legs = 4 * minutes
    survey = (
        f"survey.legs={legs}",
        f"survey.leg_length_m={_LEG_M}",
        f"survey.leg_spacing_m={_FIELD_M / (legs - 1):.3f}",
        f"survey.duration_s={60.0 * minutes - _TAIL_S}",
        f"referee.timeout_s={60.0 * minutes + 60.0}",
        "landing.survey_only=true",
        "sim.threads=1",
    )
    return load_config(
        None, (*survey, *overrides), profile_default="ideal",
        scene=scene, estimator=estimator, seed=seed, record=False,
    )  # fmt: skip


class _Minutes(NullRecorder):
    """Samples CPU time of estimator and process, and its memory, at every full minute."""

    def __init__(
        self, clock: StageClock, process_time: Callable[[], float] = time.process_time
    ) -> None:
        self._clock, self._process_time = clock, process_time
        self._spent_ms, self._from_s = 0.0, 0.0
        self._spent_s = process_time()
        self._errors: list[float] = []
        self.rows: list[dict[str, float]] = []

    def tick(self, step: StepRecord) -> None:
        truth, estimate = step.truth, step.estimate
        gap = estimate.world_from_body.translation - truth.world_from_body.translation
        self._errors.append(float(np.linalg.norm(gap)))
        if truth.time_s - self._from_s >= 60.0:
            self._close(truth.time_s)

    def _close(self, now_s: float) -> None:
        spent_ms = self._clock.stage_ms(0.1)["estimator"]  # of one scan's time: the sum
        spent_s = self._process_time()
        scans = 10.0 * (now_s - self._from_s)
        self.rows.append(
            {
                "until_s": now_s,
                "estimator_ms": (spent_ms - self._spent_ms) / scans,
                "process_ms": 1e3 * (spent_s - self._spent_s) / scans,
                "memory_mb": memory_bytes([os.getpid()]) / 1e6,
                "error_mean_m": float(np.mean(self._errors)),
            }
        )
        self._spent_ms, self._spent_s, self._from_s = spent_ms, spent_s, now_s
        self._errors.clear()


def fly_long(config: Config) -> dict[str, Any]:
    """One flight of `endurance_config`: errors, and one row for each of its full minutes.
    ``estimator_ms``, ``process_ms``: CPU time of its thread, and of all threads of the process
    (physics, rays, pixels and all), per 0.1 s of flight."""
    from touchdown.experiments.flight.platform import limit_threads
    from touchdown.experiments.flight.run import fly_and_judge
    from touchdown.experiments.flight.wiring import build_flight_stack, build_scene

    limit_threads()
    flight = build_flight_stack(config, build_scene(config))
    clock = StageClock(time.thread_time)
    timed = Timed(flight.estimator, "update", "estimator", clock)
    minutes = _Minutes(clock)
    result = fly_and_judge(
        config,
        dataclasses.replace(flight, estimator=timed),  # type: ignore[arg-type]
        minutes,
        None,
    ).plain()
    first, last = minutes.rows[0], minutes.rows[-1]
    return {
        "scene": config.scene,
        "seed": config.seed,
        "outcome": result["outcome"],
        "sim_s": result["timing"]["sim_s"],
        "error_mean_m": result["position_error_m"]["mean"],
        "error_max_m": result["position_error_m"]["max"],
        "nees_median": result["nees"]["median"],
        "minutes": minutes.rows,
        "last_over_first": {
            name: last[name] / first[name] for name in ("estimator_ms", "process_ms", "memory_mb")
        },
    }


def measure(
    configs: Sequence[Config], jobs: int, report: Callable[[dict[str, Any]], None]
) -> list[dict[str, Any]]:
    """Each flight in a process of its own, ``jobs`` at a time, in the order given."""
    if not configs:
        raise UsageError("no flight to measure: name a scene and a seed")
    fresh = multiprocessing.get_context("spawn")
    flights = []
    with ProcessPoolExecutor(jobs, mp_context=fresh, max_tasks_per_child=1) as pool:
        for flight in pool.map(_fly_compiled, configs):
            report(flight)
            flights.append(flight)
    return flights


def _fly_compiled(config: Config) -> dict[str, Any]:
    return compiled_before(lambda: fly_long(config))


def row(flight: dict[str, Any]) -> str:
    """One line of text."""
    over = flight["last_over_first"]
    return (
        f"{flight['scene']:12}{flight['seed']:3}  {flight['outcome']:10}"
        f"{flight['sim_s']:6.0f} s  error {flight['error_mean_m']:.3f} m, at most "
        f"{flight['error_max_m']:.3f}; last minute over first: "
        f"estimator {over['estimator_ms']:.2f}, process {over['process_ms']:.2f}, "
        f"memory {over['memory_mb']:.3f}"
    )


def plot(flights: Sequence[dict[str, Any]], path: Path) -> None:
    """Times per scan, memory and error of each minute, a line for each flight."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    panels = (
        ("estimator_ms", "estimator, ms of CPU per scan", 1.0),
        ("process_ms", "whole process, ms of CPU per scan", 1.0),
        ("memory_mb", "memory, GB", 1e-3),
        ("error_mean_m", "mean position error, cm", 100.0),
    )
    figure = Figure(figsize=(13.0, 3.4), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    scenes = list(dict.fromkeys(flight["scene"] for flight in flights))
    for axes, (key, title, scale) in zip(figure.subplots(1, len(panels)), panels, strict=True):
        for flight in flights:
            values = [scale * minute[key] for minute in flight["minutes"]]
            colour = f"C{scenes.index(flight['scene'])}"
            first = flight["seed"] == min(f["seed"] for f in flights)
            axes.plot(
                np.arange(1, len(values) + 1), values, "-o" if first else "--o", color=colour,
                markersize=3.5, label=flight["scene"] if first else None,
            )  # fmt: skip
        axes.set_title(title, fontsize=10)
        axes.set_xlabel("minute of flight")
        axes.set_ylim(0.0, 1.08 * axes.dataLim.y1)
        axes.grid(alpha=0.3)
    figure.axes[0].legend(fontsize=8, loc="lower right")
    try:
        figure.savefig(path)
    except (OSError, ValueError) as error:
        raise UsageError(f"cannot write the plot {path}: {reason_of(error)}") from None
