"""Trajectories and tables of a flight: TUM and CSV."""

from pathlib import Path

import numpy as np
import pandas as pd

from touchdown.experiments.export.flown_run import SAME_TIME_S, Exported, ExportOptions, FlownRun
from touchdown.experiments.io.tum import read_tum
from touchdown.sim.files.opening import no_file
from touchdown.sim.frames import Pose, matrices_from_quats_wxyz, so3_log
from touchdown.sim.typing import Array

TIME = "time_s"


def write_tum(flown: FlownRun, path: Path, options: ExportOptions) -> Exported:
    """One trajectory, ``t x y z qx qy qz qw``, world frame."""
    first_s, end_s = flown.wanted_s(options.judged)
    times, positions, quats = read_tum(flown.file(f"{options.poses}.tum"))
    rows = np.column_stack([times, positions, quats[:, [1, 2, 3, 0]]])
    rows = rows[(first_s <= times) & (times < end_s)]
    np.savetxt(path, rows, fmt="%.9f")
    return Exported(path, {"rows": len(rows)})


def write_csv(flown: FlownRun, path: Path, options: ExportOptions) -> Exported:
    """A row for each of truth.tum: time, phase, ``judged``, true and estimated pose, reference
    position, error of the estimate (world axes) and deviation from the reference. Cells without a
    value are empty."""
    first_s, end_s = flown.span_s()
    flown.wanted_s(options.judged)  # refuses an empty table
    truth = _poses(flown.file("truth.tum"), "truth")
    begins = [(p[TIME] - SAME_TIME_S, p["phase"]) for p in flown.result.get("phases") or []]
    phases = pd.DataFrame(begins, columns=[TIME, "phase"]).astype({TIME: float})
    phases = phases.dropna().sort_values(TIME)
    table = pd.merge_asof(truth[[TIME]], phases, on=TIME)
    table["judged"] = (first_s <= table[TIME]) & (table[TIME] < end_s)
    table = table.join(truth.drop(columns=TIME))
    for name in ("estimate", "reference"):
        rows = _poses(flown.path / f"{name}.tum", name)
        table = pd.merge_asof(table, rows, on=TIME, tolerance=SAME_TIME_S, direction="nearest")
    table = table.drop(columns=[f"reference_{name}" for name in _POSE[3:]])
    error, away = (
        np.column_stack([table[f"{name}_{axis}"] - table[f"truth_{axis}"] for axis in _POSE[:3]])
        for name in ("estimate", "reference")
    )
    table[["error_x_m", "error_y_m", "error_z_m"]] = error
    table["error_m"] = np.linalg.norm(error, axis=1)
    turn = table["estimate_yaw_deg"] - table["truth_yaw_deg"]
    table["error_yaw_deg"] = (turn + 180.0) % 360.0 - 180.0
    table["deviation_m"] = np.linalg.norm(away, axis=1)
    table = table[table["judged"]] if options.judged else table
    table.to_csv(path, index=False, float_format="%.9f")
    return Exported(path, {"rows": len(table)})


_POSE = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw", "yaw_deg")


def _poses(path: Path, name: str) -> pd.DataFrame:
    """Time and pose of each row of a trajectory; none where the run lacks it."""
    times, positions, quats = (np.zeros(0), np.zeros((0, 3)), np.zeros((0, 4)))
    if not no_file(path):
        times, positions, quats = read_tum(path)
    rotations = matrices_from_quats_wxyz(quats / np.linalg.norm(quats, axis=1, keepdims=True))
    yaw_deg = np.degrees(np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0]))
    cells = np.column_stack([times, positions, quats[:, [1, 2, 3, 0]], yaw_deg])
    return pd.DataFrame(cells, columns=[TIME, *(f"{name}_{column}" for column in _POSE)])


def velocities(times_s: Array, poses: list[Pose]) -> tuple[Array, Array]:
    """Velocity (N, 3) in the axes of the trajectory and angular rate (N, 3) in those of the body,
    between the neighbours of each of N poses; 0 for a single one."""
    count = len(poses)
    before = np.maximum(np.arange(count) - 1, 0)
    after = np.minimum(np.arange(count) + 1, count - 1)
    span = times_s[after] - times_s[before]
    velocity, rate = np.zeros((count, 3)), np.zeros((count, 3))
    for row in np.flatnonzero(span > 0.0):
        first, last = poses[before[row]], poses[after[row]]
        velocity[row] = (last.translation - first.translation) / span[row]
        rate[row] = so3_log(first.rotation.T @ last.rotation) / span[row]
    return velocity, rate
