"""Processor time of the stages of one flight, and its flame graph.

Stages are functions, which are clocked while the flight runs. The time of a stage is that of the
thread that calls it, without that of the stages that it calls: the rows of the table add up.
"""

import contextlib
import functools
import importlib
import json
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from touchdown.experiments.benchmarks.loop import bench_config, compiled_before
from touchdown.experiments.config.schema import Config
from touchdown.experiments.flight.platform import limit_threads
from touchdown.experiments.flight.run import fly_and_judge
from touchdown.experiments.flight.wiring import build_flight_stack, build_scene
from touchdown.experiments.recording.recorder import NullRecorder

_SIM = "touchdown.sim."
STAGES: Mapping[str, str] = {
    "picture: draw": _SIM + "camera.gl:Stage.colour",
    "picture: depth": _SIM + "camera.gl:Stage.inverse_depth_of_last",
    "picture: grain": _SIM + "camera.detail_texture:DetailTexture.add",
    "film": _SIM + "camera.row_exposures:RowExposures.develop",
    "camera": _SIM + "imaging_sensors:ImagingSensors._render",
    "lidar: aim": _SIM + "lidar.sensor:LidarSensor._aim",
    "lidar: open ground": _SIM + "lidar.heightfield:GroundGrid.land",
    "lidar: Embree": _SIM + "geometry.ray_target:RayTarget.embree",
    "lidar: split beams": _SIM + "lidar.sensor:LidarSensor._split",
    "lidar: detail": _SIM + "lidar.sensor:LidarSensor._refine",
    "lidar: receive": _SIM + "lidar.sensor:LidarSensor._receive",
    "lidar": _SIM + "lidar.sensor:LidarSensor.scan",
    "world": _SIM + "world:MujocoWorld.step",
    "controller": "touchdown.controller.cascade:CascadeController.update",
    "mapper": "touchdown.estimator.mapping.mapper:GridMapper.update",
    "lander": "touchdown.landing.mission.lander:SiteLander.update",
}
"""Places of functions by stage, as MODULE:NAME; beside them come the estimator's `update`, the
``scene``, ``set-up`` and the ``rest`` of the flight"""
_BEFORE = ("scene", "set-up")
"""stages before the first control step"""
FLAME_HZ = 100


class StageProfile:
    """Calls and own processor time of functions by stage."""

    def __init__(self) -> None:
        self.calls: dict[str, int] = {}
        self.seconds: dict[str, float] = {}
        self._local = threading.local()

    def clocked(self, stage: str, call: Callable[..., Any]) -> Callable[..., Any]:
        """``call`` as the stage ``stage``."""
        self.calls.setdefault(stage, 0)
        self.seconds.setdefault(stage, 0.0)

        @functools.wraps(call)
        def run(*args: Any, **kwargs: Any) -> Any:
            inner: list[float] = self._local.__dict__.setdefault("inner", [0.0])
            inner.append(0.0)
            started = time.thread_time()
            try:
                return call(*args, **kwargs)
            finally:
                spent = time.thread_time() - started
                self.seconds[stage] += spent - inner.pop()
                self.calls[stage] += 1
                inner[-1] += spent

        return run

    @contextlib.contextmanager
    def watching(self, places: Mapping[str, str]) -> Iterator[None]:
        """Clocks the functions at ``places``."""
        with contextlib.ExitStack() as undo:
            for stage, place in places.items():
                owner, name = found(place)
                before = vars(owner)[name]
                undo.callback(setattr, owner, name, before)
                setattr(owner, name, self.clocked(stage, before))
            yield


def found(place: str) -> tuple[Any, str]:
    """The object that holds the function at MODULE:NAME, and its name there."""
    module, _, path = place.partition(":")
    parent, _, name = path.rpartition(".")
    owner = importlib.import_module(module)
    return getattr(owner, parent) if parent else owner, name


def profile_config(**chosen: Any) -> Config:
    """Configuration of a landing on one core without recording. Raises UsageError."""
    return bench_config(overrides=["sim.threads=1"], record=False, **chosen)


def profile_flight(config: Config) -> dict[str, Any]:
    """Flies ``config`` with the functions of `STAGES` under the clock. Returns ``sim_s`` and, by
    stage, ``calls``, ``ms`` a call, ``ms_per_scan`` (0.1 s of flight) and ``fraction``; the scene
    and set-up are outside of shares."""
    limit_threads()
    os.environ["LP_NUM_THREADS"] = "0"  # Mesa draws on the thread whose clock is read
    return compiled_before(lambda: _profile(config))


def _profile(config: Config) -> dict[str, Any]:
    profile = StageProfile()
    with profile.watching(STAGES):
        scene = profile.clocked("scene", build_scene)(config)
        stack = profile.clocked("set-up", build_flight_stack)(config, scene)
        kind = next(one for one in type(stack.estimator).__mro__ if "update" in vars(one))
        estimator = {"estimator": f"{kind.__module__}:{kind.__qualname__}.update"}
        with profile.watching(estimator):
            fly = profile.clocked("rest", fly_and_judge)
            result = fly(config, stack, NullRecorder(), None)
    sim_s = result.plain()["timing"]["sim_s"]
    return {
        "scene": config.scene,
        "profile": config.profile,
        "sim_s": sim_s,
        "core_s_per_sim_s": _flying_s(profile) / sim_s,
        "stages": _rows(profile, sim_s),
    }


def _flying_s(profile: StageProfile) -> float:
    return sum(s for stage, s in profile.seconds.items() if stage not in _BEFORE)


def _rows(profile: StageProfile, sim_s: float) -> dict[str, dict[str, float]]:
    total = _flying_s(profile)
    rows: dict[str, dict[str, float]] = {}
    for stage, seconds in sorted(profile.seconds.items(), key=lambda item: -item[1]):
        calls = profile.calls[stage]
        rows[stage] = {"calls": calls, "ms": 1e3 * seconds / max(calls, 1)}
        if stage not in _BEFORE:
            rows[stage] |= {"ms_per_scan": 100.0 * seconds / sim_s, "fraction": seconds / total}
    return rows


def table(figures: Mapping[str, Any]) -> str:
    """The stages as text, the dearest first."""
    lines = [f"{'stage':28}{'calls':>8}{'ms a call':>11}{'ms per 0.1 s':>14}{'fraction':>10}"]
    for stage, row in figures["stages"].items():
        beside = f"{row['ms_per_scan']:14.2f}{row['fraction']:10.1%}" if "fraction" in row else ""
        lines.append(f"{stage:28}{row['calls']:8.0f}{row['ms']:11.3f}{beside}")
    total = figures["core_s_per_sim_s"]
    return "\n".join([*lines, f"{total:.3f} core-seconds per simulated second"])


def profile_with_flames(arguments: list[str], svg: Path) -> dict[str, Any] | None:
    """The figures of ``touchdown bench profile`` with these arguments in a process of its own under
    py-spy, which draws its flame graph to ``svg``. None where py-spy is not installed; RuntimeError
    with its last words where it fails."""
    spy = shutil.which("py-spy", path=f"{Path(sys.executable).parent}:") or shutil.which("py-spy")
    if spy is None:
        return None
    command = [
        spy, "record", "--rate", str(FLAME_HZ), "--format", "flamegraph", "--output", str(svg),
        "--", sys.executable, "-m", "touchdown", "bench", "profile", *arguments, "--json",
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    try:  # py-spy prints lines of its own before and behind
        start = done.stdout.index("\n{") + 1 if done.stdout[:1] != "{" else 0
        figures: dict[str, Any] = json.JSONDecoder().raw_decode(done.stdout, start)[0]
    except ValueError:
        raise RuntimeError(f"py-spy: {done.stderr.strip()[-500:] or 'no figures'}") from None
    return figures
