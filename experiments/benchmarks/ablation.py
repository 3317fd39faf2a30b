"""Ablation: the same log through an estimator with one part left out."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from touchdown.experiments.benchmarks.odometry import logged_survey, measure, seeds_by_scene
from touchdown.experiments.benchmarks.revisits import RevisitFigures
from touchdown.experiments.errors import UsageError
from touchdown.experiments.flight.replay import LoggedRun, open_run, replay_config

VARIANTS: dict[str, tuple[str, dict[str, bool]]] = {
    "livo: tight, all on": ("livo", {}),
    "livo: LIDAR only": ("livo", {"use_vision": False}),
    "livo: vision only": ("livo", {"use_lidar": False}),
    "livo: loose": ("livo", {"loose": True}),
    "livo: no degeneracy handling": ("livo", {"use_degeneracy": False}),
    "livo: no closures": ("livo", {"use_closures": False}),
    "zou2024: all on": ("zou2024", {}),
    "zou2024: LIDAR only": ("zou2024", {"use_camera_pose": False}),
    "zou2024: camera only": ("zou2024", {"use_lidar_pose": False}),
    "zou2024: no f_c": ("zou2024", {"use_colour_smoothness": False}),
    "zou2024: no bundle": ("zou2024", {"use_bundle": False}),
    "zou2024: no closures": ("zou2024", {"use_closures": False}),
}
"""Estimator and changed parameters by name of the variant."""

Report = Callable[[str], None]


def changes(variant: str) -> tuple[str, ...]:
    """``KEY=VALUE`` texts of a variant."""
    estimator, values = VARIANTS[variant]
    return tuple(f"{estimator}.{name}={str(value).lower()}" for name, value in values.items())


def ablate_log(logged: LoggedRun, seconds: float | None, report: Report) -> dict[str, Any]:
    """``{"error_m", "lost_s", "cpu_ms", "closures"}`` by variant; ``closures``: counts of
    `RevisitFigures`."""
    end_s = math.inf if seconds is None else logged.from_s + seconds
    rows: dict[str, Any] = {}
    for variant, (estimator, _) in VARIANTS.items():
        report(variant)
        config = replay_config(logged.path, estimator, changes(variant), fresh=True)
        measured = measure(logged, config, end_s)
        rows[variant] = {
            "error_m": measured.error_m,
            "lost_s": measured.lost_s,
            "cpu_ms": measured.cpu_ms,
            "closures": measured.revisits._asdict(),
        }
    return rows


def ablate(
    scenes: Sequence[str],
    *,
    seeds: Sequence[int],
    runs: Path,
    seconds: float | None = None,
    report: Report = lambda _text: None,
) -> dict[str, Any]:
    """``{SCENE: {VARIANT: figures}}``, open loop: the vehicle flew on ``livo`` with all its parts,
    and its path does not depend on the variant. Raises UsageError as `open_run`."""
    if not scenes:
        raise UsageError("name at least one scene")
    found: dict[str, Any] = {}
    for scene, seed in seeds_by_scene(scenes, seeds).items():
        report(f"{scene}: the log")
        run = logged_survey(scene, seed, runs, report)
        found[scene] = ablate_log(open_run(run), seconds, report)
    return found


def ablation_table(found: dict[str, Any]) -> str:
    """Markdown table, one column per scene: mean error in metres, or the time of the loss; last
    precision and recall of the closures of ``zou2024``."""
    scenes = list(found)
    lines = ["| variant | " + " | ".join(scenes) + " |", "|---|" + "---|" * len(scenes)]
    for variant in VARIANTS:
        cells = [_cell(found[scene][variant]) for scene in scenes]
        lines.append(f"| {variant} | " + " | ".join(cells) + " |")
    counts = [found[scene].get("zou2024: all on", {}).get("closures") for scene in scenes]
    if all(counts):
        cells = [_closures(RevisitFigures(**count)) for count in counts]
        lines.append("| `zou2024`: closures right / due ones made | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _closures(count: RevisitFigures) -> str:
    return (
        f"{count.precision:.2f} ({count.right} of {count.found}) / "
        f"{count.recall:.2f} ({count.right_and_due} of {count.due})"
    )


def _cell(row: dict[str, Any]) -> str:
    lost = row["lost_s"]
    return f"{row['error_m']:.3f}" if lost is None else f"lost at {lost:.0f} s"
