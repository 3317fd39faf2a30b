"""Benchmark of the LIDAR sensor against bare ray casters, on the same rays in one process."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from touchdown.experiments.benchmarks.reference_casters import ReferenceCasters
from touchdown.experiments.config.loading import load_config
from touchdown.experiments.flight.wiring import build_scene

HOVERS = 6
"""Number of positions over the scene's middle from which scans are taken."""
_HEIGHT_M = 30.0
_RING_M = 15.0


def bench_lidar(
    *, scene: str = "crossroad", seed: int = 0, preset: str = "horizon", rounds: int = 7
) -> dict[str, Any]:
    """Returns the rays per second of the whole sensor (poses, noise, returns; the extra rays of
    split beams are not counted), of Embree alone, of ``mujoco.mj_multiRay`` and of the package
    ``mujoco-lidar`` on the CPU, one thread each: ``{"scene", "rays_per_s": {...}, "ms_per_scan":
    {...}, "ratio": {"embree", "mj_multiRay", "mujoco_lidar"}}``. A ratio is the sensor's rate over
    that of a reference implementation.

    All casters take turns on every scan, after a round of warm-up, so that other load of the
    machine affects all of them; a figure is the median over ``rounds`` through the scans. A package
    that is not installed is left out. Raises UsageError and ValueError as `load_config` and
    `build_scene`.
    """
    config = load_config(
        None, [f"lidar.preset={preset}"], profile_default="ideal",
        scene=scene, estimator="oracle", seed=seed, record=False,
    )  # fmt: skip
    built = build_scene(config)
    references = ReferenceCasters(built, config.lidar, config.seed)
    middle = np.append(built.takeoff_xy_m, _HEIGHT_M)
    seconds: dict[str, list[float]] = {}
    rays = 0
    for round_number in range(rounds + 1):
        spent: dict[str, float] = {}
        rays = 0
        for hover in range(HOVERS):
            angle = 2.0 * np.pi * hover / HOVERS
            position = middle + _RING_M * np.array([np.cos(angle), np.sin(angle), 0.0])
            for name, cast in references.casters(position, 7 * hover).items():
                started = time.perf_counter()
                distances = cast()
                spent[name] = spent.get(name, 0.0) + time.perf_counter() - started
            rays += len(distances)
        if round_number > 0:  # the first one warms up
            for name, wall in spent.items():
                seconds.setdefault(name, []).append(wall)
    wall_s = {name: float(np.median(walls)) for name, walls in seconds.items()}
    return {
        "scene": scene,
        "preset": preset,
        "rays_per_scan": rays // HOVERS,
        "threads": 1,
        "rays_per_s": {name: rays / wall for name, wall in wall_s.items()},
        "ms_per_scan": {name: 1e3 * wall / HOVERS for name, wall in wall_s.items()},
        "ratio": {
            name: wall / wall_s["sensor"] for name, wall in wall_s.items() if name != "sensor"
        },
    }
