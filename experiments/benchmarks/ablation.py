"""Ablation: the same log through an estimator with one part left out."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from touchdown.experiments.benchmarks.odometry import logged_survey, logs_of, replayed
from touchdown.experiments.errors import UsageError
from touchdown.experiments.flight.replay import LoggedRun, open_run
from touchdown.experiments.reporting.statistics import mean_interval

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
    "zou2024: no Eq. 12": ("zou2024", {"use_geodesic_depth": False}),
    "zou2024: no bundle": ("zou2024", {"use_bundle": False}),
    "zou2024: no closures": ("zou2024", {"use_closures": False}),
}
"""Estimator and changed parameters by name of the variant."""

_FEWEST_LOGS = 3
"""of an interval"""

Report = Callable[[str], None]


def changes(variant: str) -> tuple[str, ...]:
    """``KEY=VALUE`` texts of a variant."""
    estimator, values = VARIANTS[variant]
    return tuple(f"{estimator}.{name}={str(value).lower()}" for name, value in values.items())


def whole(variant: str) -> str:
    """The variant with everything on that ``variant`` is compared with."""
    return next(name for name, made in VARIANTS.items() if made == (VARIANTS[variant][0], {}))


def variants(methods: Sequence[str]) -> list[str]:
    """Those of the estimators or with the names in ``methods``; all for none. Raises UsageError."""
    estimators = {estimator for estimator, _ in VARIANTS.values()}
    for name in methods:
        if name not in VARIANTS and name not in estimators:
            one_of = ", ".join([*sorted(estimators), *VARIANTS])
            raise UsageError(f"--ablate has no '{name}'; name one of: {one_of}")
    chosen = [v for v in VARIANTS if v in methods or VARIANTS[v][0] in methods]
    compared = {*chosen, *map(whole, chosen)}
    return [v for v in VARIANTS if v in compared] if methods else list(VARIANTS)


def ablate_log(
    logged: LoggedRun, seconds: float | None, report: Report, methods: Sequence[str] = ()
) -> dict[str, Any]:
    """`replayed` by variant of ``methods`` (`variants`)."""
    end_s = math.inf if seconds is None else logged.from_s + seconds
    rows: dict[str, Any] = {}
    for variant in variants(methods):
        report(variant)
        rows[variant] = replayed(logged, VARIANTS[variant][0], changes(variant), end_s)
    return rows


def ablate(
    scenes: Sequence[str],
    *,
    seeds: Sequence[int],
    runs: Path,
    seconds: float | None = None,
    methods: Sequence[str] = (),
    report: Report = lambda _text: None,
) -> dict[str, Any]:
    """``{LOG: {VARIANT: figures}}``, open loop: the vehicle flew on ``livo`` with all its parts,
    and its path does not depend on the variant. Names of logs: `logs_of`. Raises UsageError as
    `open_run` and `variants`."""
    if not scenes:
        raise UsageError("name at least one scene")
    variants(methods)
    found: dict[str, Any] = {}
    for name, (scene, seed) in logs_of(scenes, seeds).items():
        report(f"{name}: the log")
        run = logged_survey(scene, seed, runs, report)
        found[name] = ablate_log(open_run(run), seconds, report, methods)
    return found


def ablation_table(found: dict[str, Any]) -> str:
    """Markdown table, one column per log: mean error in metres, or the time of the loss; of three
    logs and more what leaving the part out adds to the error, with its interval."""
    logs = list(found)
    rows = [variant for variant in VARIANTS if variant in found[logs[0]]]
    heads = ["variant", *logs] + ["more error, 95 %"] * (len(logs) >= _FEWEST_LOGS)
    lines = ["| " + " | ".join(heads) + " |", "|---|" + "---|" * (len(heads) - 1)]
    for variant in rows:
        cells = [_cell(found[log][variant]) for log in logs]
        if len(logs) >= _FEWEST_LOGS:
            cells.append(_more(found, variant))
        lines.append(f"| {variant} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _more(found: dict[str, Any], variant: str) -> str:
    """By how much the error over all logs exceeds that of the whole estimator."""
    pairs = [(rows[variant], rows[whole(variant)]) for rows in found.values()]
    if whole(variant) == variant or any(
        row["lost_s"] is not None for pair in pairs for row in pair
    ):
        return "–"
    errors = np.array([[row["error_m"] for row in pair] for pair in pairs])
    more = mean_interval(errors[:, 0] - errors[:, 1])
    assert more is not None
    return f"{more.value:+.3f} [{more.low:+.3f}, {more.high:+.3f}]"


def _cell(row: dict[str, Any]) -> str:
    lost = row["lost_s"]
    return f"{row['error_m']:.3f}" if lost is None else f"lost at {lost:.0f} s"
