"""Rows of a report: one flat dictionary per flight, with dotted keys."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.campaign.results_table import CRASHED, RUNS, is_campaign, load_rows
from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.provenance import UNRECORDED_REMEDY
from touchdown.experiments.io.results import JUDGED_BY_CLASS
from touchdown.experiments.io.tum import read_tum
from touchdown.experiments.reporting import published
from touchdown.sim.files.opening import no_file
from touchdown.sim.frames import matrices_from_quats_wxyz

Array = NDArray[np.float64]
Row = Mapping[str, Any]

SCENE_ORDER = ("crossroad", "lake", "houses", "forest")
METHOD_ORDER = ("livo", "zou2024", "stereo", "hybrid_flow", "gps", "optical_flow", "oracle")
LIFT_OFF_M = 0.1


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Times (N,) s, positions (N, 3) m in the world frame, headings (N,) rad."""

    time_s: Array
    position: Array
    yaw: Array


def load_flights(directory: Path) -> list[dict[str, Any]]:
    """Returns every flight of a campaign, or below a plain directory, as rows of
    `touchdown.experiments.campaign.results_table.load_rows`, with the key ``run_dir``. Raises
    UsageError without a flight or for an unreadable one."""
    rows = load_rows(directory)
    folder = directory / RUNS if is_campaign(directory) else directory
    for row in rows:
        run_dir = folder / row["run_id"]
        row["run_dir"] = str(run_dir if run_dir.is_dir() else folder)
    return rows


def check_revisions(rows: Iterable[Row], directory: Path) -> None:
    """Raises UsageError where a flight that ended with a result has no git revision."""
    missing = [r for r in rows if r["outcome"] != CRASHED and not recorded_revision(r)]
    if missing:
        raise UsageError(
            f"'{directory}': {len(missing)} results have no git revision, the first is "
            f"'{missing[0]['run_id']}'; {UNRECORDED_REMEDY}"
        )


def recorded_revision(row: Row) -> str | None:
    """The git revision of a flight; None where it was not recorded, for which earlier versions
    wrote "unknown"."""
    found = row.get("git_revision")
    return str(found) if found and found != "unknown" else None


def campaign_text(directory: Path) -> str:
    """Returns the text of the campaign's file; empty without one."""
    file = directory / "campaign.toml"
    if no_file(file):
        return ""
    return file.read_text(encoding="utf-8", errors="replace")


def number(row: Row, key: str) -> float | None:
    """Returns a finite number of a row; None for any other value."""
    value = row.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if np.isfinite(value) else None


def values(rows: Iterable[Row], key: str) -> list[float]:
    """The numbers of the rows that have one."""
    found = (number(row, key) for row in rows)
    return [value for value in found if value is not None]


def scenes_of(rows: Iterable[Row]) -> list[str]:
    """The paper's four scenes first, others by name."""
    return _ordered({row["scene"] for row in rows}, SCENE_ORDER)


def methods_of(rows: Iterable[Row]) -> list[str]:
    """Estimators of the project in a fixed order, others by name."""
    return _ordered({row["estimator"] for row in rows}, METHOD_ORDER)


def _ordered(names: set[str], known: Sequence[str]) -> list[str]:
    return sorted(names, key=lambda n: (known.index(n) if n in known else len(known), n))


def cell(rows: Iterable[Row], scene: str | None = None, method: str | None = None) -> list[Row]:
    """The rows of one scene and one method; None means all."""
    return [
        row
        for row in rows
        if (scene is None or row["scene"] == scene)
        and (method is None or row["estimator"] == method)
    ]


def judged_by_class(row: Row) -> bool:
    """True if a flight is judged on the class of the ground, not on its geometry alone."""
    return row.get("landing.judged_on") == JUDGED_BY_CLASS


def flies_paper_methods(rows: Iterable[Row]) -> bool:
    """True if a method of the paper's tables is among the flights."""
    return any(row["estimator"] in published.METHOD_NAMES for row in rows)


# ----------------------------------------------------------------------------------- trajectories


def read_trajectory(file: Path) -> Trajectory | None:
    """A ``.tum`` file of a run directory; None where it is missing or empty."""
    if no_file(file):
        return None
    try:
        time_s, position, quaternion = read_tum(file)
    except (ValueError, IndexError):
        return None
    if not len(time_s):
        return None
    rotation = matrices_from_quats_wxyz(quaternion)
    return Trajectory(time_s, position, np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]))


def airborne(truth: Trajectory) -> int:
    """Index of the first sample after lift-off; the number of samples where there was none."""
    above = truth.position[:, 2] > truth.position[0, 2] + LIFT_OFF_M
    return int(np.argmax(above)) if above.any() else len(above)


def path_deviation(run_dir: Path) -> dict[str, float] | None:
    """Mean absolute deviation of the flown path from the reference, from lift-off to the end.

    Metres along world x, y and z, degrees for ``yaw_deg``, ``mean`` the distance in 3-D, as in the
    paper's Fig. 10b-e. For flights that end with the survey; None without trajectories.
    """
    truth = read_trajectory(run_dir / "truth.tum")
    reference = read_trajectory(run_dir / "reference.tum")
    if truth is None or reference is None:
        return None
    count = min(len(truth.time_s), len(reference.time_s))
    start = airborne(truth)
    if count <= start or not np.allclose(truth.time_s[:count], reference.time_s[:count]):
        return None
    offset = truth.position[start:count] - reference.position[start:count]
    yaw_error = truth.yaw[start:count] - reference.yaw[start:count]
    yaw_error = np.arctan2(np.sin(yaw_error), np.cos(yaw_error))
    x, y, z = np.abs(offset).mean(axis=0).tolist()
    return {
        "mean": float(np.linalg.norm(offset, axis=1).mean()),
        "x": x,
        "y": y,
        "z": z,
        "yaw_deg": float(np.degrees(np.abs(yaw_error)).mean()),
    }


def add_path_deviations(rows: list[dict[str, Any]]) -> None:
    """Adds the keys ``path_deviation.x`` and so on to survey flights, from their files."""
    for row in rows:
        if row["mode"] != "fly":
            continue
        for key, value in (path_deviation(Path(row["run_dir"])) or {}).items():
            row[f"path_deviation.{key}"] = value
