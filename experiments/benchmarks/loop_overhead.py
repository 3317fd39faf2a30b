"""Overhead of the flight loop over bare physics, rays and pixels.

The flight runs on one core with the oracle estimator, all sensors and the recording. After every
LIDAR scan MuJoCo, Embree and OpenGL alone compute the same number of physics steps, the same pulses
and the same image once more, so that both sides meet the same state of the machine. Time is
processor time (of the thread, and of the recorder's threads), which other programs on the machine
hardly change; the first seconds, in which compiled code is loaded, do not count.
"""

from __future__ import annotations

import multiprocessing
import os
import shutil
import time
from collections import deque
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from touchdown.experiments.benchmarks.bare_world import BareWorld
from touchdown.experiments.benchmarks.jit_warmup import compiled_before
from touchdown.experiments.config.schema import Config
from touchdown.experiments.flight.loop import run_flight
from touchdown.experiments.flight.platform import limit_threads
from touchdown.experiments.flight.run import make_referee, timed_parts
from touchdown.experiments.flight.stage_timer import StageClock, Timed
from touchdown.experiments.flight.wiring import build_flight_stack, build_scene, world_params
from touchdown.experiments.recording.run_recorder import RunRecorder
from touchdown.sim.api import Command, LidarScan, Observation, SimParams, Truth

WARM_UP_S = 2.0
SENSOR_EVERY = 4
"""The sensors alone, which only explain the difference, run beside every fourth scan."""
NOT_OVERHEAD = ("estimator", "lander")


@dataclass(slots=True)
class _Sums:
    """Sums of processor time, s, and their counts, by name."""

    seconds: dict[str, float] = field(default_factory=dict)
    count: dict[str, int] = field(default_factory=dict)

    def add(self, name: str, seconds: float) -> None:
        self.seconds[name] = self.seconds.get(name, 0.0) + seconds
        self.count[name] = self.count.get(name, 0) + 1

    def mean(self, name: str) -> float:
        return self.seconds.get(name, 0.0) / max(self.count.get(name, 0), 1)


class _Mirrored:
    """World of a flight; the bare world computes the data of each step once more."""

    def __init__(self, world: Any, bare: Any, sim: SimParams, clock: StageClock) -> None:
        self._world, self._bare, self._sim, self._clock = world, bare, sim, clock
        kept = (sim.lidar_scan_ticks + sim.compute_latency_ticks) // sim.control_ticks + 2
        self._truths: deque[Truth] = deque(maxlen=kept)
        self.sums = _Sums()
        self.start_s, self.scans = 0.0, 0
        self.beside_s = 0.0
        """thread time spent by this class, s"""
        self.process_s = 0.0
        """process time at the begin of the measurement, s"""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._world, name)

    def reset(self) -> Observation:
        obs: Observation = self._world.reset()
        self._truths.append(self._world.truth())
        return obs

    def step(self, command: Command) -> Observation:
        obs: Observation = self._world.step(command)
        started = time.thread_time()
        self._truths.append(self._world.truth())
        for scan in obs.scans:
            if self.scans == 0 and scan.start_time_s >= WARM_UP_S:
                self._begin(obs.time_s)
                started = time.thread_time()
            self._mirror_scan(scan)
        for image in obs.images:
            truth = next(t for t in self._truths if t.tick == image.tick)
            self.sums.add("pixels", self._bare.pixels(truth))
            if self.scans % SENSOR_EVERY == 0:
                self.sums.add("camera_sensor", self._bare.camera_sensor(truth))
        self.beside_s += time.thread_time() - started
        return obs

    def _begin(self, time_s: float) -> None:
        self._clock.restart()
        self.sums, self.beside_s = _Sums(), 0.0
        self.start_s, self.process_s = time_s, time.process_time()

    def _mirror_scan(self, scan: LidarScan) -> None:
        track = [t for t in self._truths if scan.start_tick <= t.tick <= scan.end_tick]
        poses = [truth.world_from_body for truth in track]
        self.scans += scan.start_time_s >= WARM_UP_S
        self.sums.add("physics", self._bare.physics(track[0], self._sim.lidar_scan_ticks))
        self.sums.add("rays", self._bare.rays(scan, poses))
        if self.scans % SENSOR_EVERY == 0:
            self.sums.add("lidar_sensor", self._bare.lidar_sensor(scan, poses))


def measure_overhead(config: Config, out_dir: Path) -> dict[str, Any]:
    """Flies ``config`` into the new directory ``out_dir`` with the bare computation beside it.

    Returns ``outcome``, ``sim_s`` and, in milliseconds of processor time per LIDAR scan (0.1 s),
    ``bare_ms`` (physics, rays, pixels, all), ``loop_ms`` (every stage, the recorder's threads, the
    rest of the loop, and ``all`` but estimator and lander), ``excess_ms`` (the parts of the
    difference of both) and ``ratio``. Raises ValueError for a configuration that cannot be flown.
    """
    limit_threads()
    scene = build_scene(config)
    flight = build_flight_stack(config, scene)
    bare = BareWorld(scene, world_params(config), config.seed)
    out_dir.mkdir(parents=True)
    recorder = RunRecorder(out_dir, scene, flight.world.rig, config)
    referee = make_referee(config, scene, lambda: None)
    clock = StageClock(time.thread_time)
    parts = timed_parts(flight, clock)
    world = _Mirrored(parts["world"], bare, config.sim, clock)
    try:
        outcome = run_flight(
            **{**parts, "world": world},
            recorder=Timed(recorder, "tick", "recorder", clock),  # type: ignore[arg-type]
            referee=Timed(referee, "judge", "referee", clock),  # type: ignore[arg-type]
        )
        thread_s, process_s = clock.wall_s(), time.process_time() - world.process_s
    finally:
        bare.close()
        flight.world.close()
        recorder.close()
    sim_s = outcome.sim_s - world.start_s
    stages = clock.stage_ms(sim_s)
    scans = sim_s / 0.1
    loop = dict(stages)
    loop["recorder_threads"] = 1e3 * max(process_s - thread_s, 0.0) / scans
    loop["rest"] = 1e3 * (thread_s - world.beside_s) / scans - sum(stages.values())
    return {"outcome": str(outcome.outcome), "sim_s": sim_s, **_compare(loop, world.sums)}


def measure_on_one_core(config: Config, out_dir: Path) -> dict[str, Any]:
    """Runs `measure_overhead` in a separate process on one core that renders in the calling thread,
    so that the processor time of the thread is complete."""
    fresh = multiprocessing.get_context("spawn")
    kept = os.environ.get("LP_NUM_THREADS")
    os.environ["LP_NUM_THREADS"] = "0"  # Mesa's software renderer
    try:
        with ProcessPoolExecutor(1, mp_context=fresh, initializer=_take_one_core) as pool:
            return pool.submit(_measure_compiled, config, out_dir).result()
    finally:
        if kept is None:
            del os.environ["LP_NUM_THREADS"]
        else:
            os.environ["LP_NUM_THREADS"] = kept


def _measure_compiled(config: Config, out_dir: Path) -> dict[str, Any]:
    return compiled_before(
        lambda: measure_overhead(config, out_dir), again=lambda: shutil.rmtree(out_dir)
    )


def _take_one_core() -> None:
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def _compare(loop_ms: dict[str, float], sums: _Sums) -> dict[str, Any]:
    """``loop_ms`` per scan of every stage beside the bare computation per scan."""
    bare = {name: 1e3 * sums.mean(name) for name in ("physics", "rays", "pixels")}
    bare_all = sum(bare.values())
    loop_all = sum(ms for name, ms in loop_ms.items() if name not in NOT_OVERHEAD)
    lidar, camera = 1e3 * sums.mean("lidar_sensor"), 1e3 * sums.mean("camera_sensor")
    excess = {
        "lidar_beyond_rays": lidar - bare["rays"],
        "camera_beyond_pixels": camera - bare["pixels"],
        "world_beyond_physics": loop_ms["world"] - lidar - camera - bare["physics"],
    }
    others = [name for name in loop_ms if name not in ("world", *NOT_OVERHEAD)]
    excess |= {name: loop_ms[name] for name in others}
    return {
        "bare_ms": {**bare, "all": bare_all},
        "loop_ms": {**loop_ms, "all": loop_all},
        "excess_ms": excess,
        "ratio": loop_all / bare_all,
    }
