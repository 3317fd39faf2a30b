"""Synthetic runs with trajectories, for the tests of reports."""

import json
from pathlib import Path
from typing import Any

import numpy as np

TIMES_S = np.arange(0.0, 20.0, 0.1)
OFFSET_M = (0.3, -0.4, 0.0)
"""flown minus planned, once in the air"""


def write_tum(path: Path, positions: np.ndarray, yaw: float = 0.0) -> None:
    """(N, 3) positions at ``TIMES_S`` with one heading."""
    turn = np.tile([0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)], (len(TIMES_S), 1))
    np.savetxt(path, np.column_stack([TIMES_S, positions, turn]), fmt="%.9f")


def write_run(directory: Path, scene: str, method: str, seed: int, **changes: Any) -> Path:
    """A survey that climbs for two seconds and then flies 18 m along x, off by ``OFFSET_M``."""
    run = directory / f"{scene}-{method}-s{seed}"
    run.mkdir(parents=True)
    result: dict[str, Any] = {
        "outcome": "COMPLETED",
        "reason": "",
        "scene": scene,
        "seed": seed,
        "estimator": method,
        "wind_kmh": 12.0,
        "position_error_m": {"mean": 0.1, "x": 0.05, "y": 0.06, "z": 0.01, "yaw_deg": 0.2},
        "trajectory_error_m": 0.5,
        "trajectory_variance_m2": 0.01,
        "landing": None,
        "map": {
            "duration_s": 18.0,
            "density_per_m2": 900.0 + seed,
            "levelness_error_deg": {"mean": 0.2, "max": 0.5, "places": 10},
        },
        "nees": {"median": 2.4, "mean": 3.0, "below_14_2": 0.99, "samples": 100},
        "timing": {
            "wall_s": 10.0, "sim_s": 20.0, "real_time_factor": 2.0,
            "stage_ms": {"world": 30.0, "estimator": 15.0},
        },
        "versions": {"touchdown": "0.1.0"},
        "git_revision": "0123abc",
    }  # fmt: skip
    (run / "result.json").write_text(json.dumps(result | changes))
    planned = np.zeros((len(TIMES_S), 3))
    planned[:, 2] = np.clip(TIMES_S * 15.0, 0.0, 30.0)
    planned[:, 0] = np.maximum(TIMES_S - 2.0, 0.0)
    aloft = planned[:, 2:] > 0.1
    write_tum(run / "reference.tum", planned)
    write_tum(run / "truth.tum", planned + aloft * np.array(OFFSET_M), yaw=np.radians(2.0))
    write_tum(run / "estimate.tum", planned, yaw=np.radians(2.0))
    return run


LANDING = {
    "target_offset_m": 0.1, "vertical_speed_mps": 0.12, "vertical_accel_mps2": 0.05,
    "slope_deg": 1.0, "tilt_deg": 2.0, "safe_geometry": True,
}  # fmt: skip
