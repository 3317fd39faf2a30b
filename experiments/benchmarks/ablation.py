"""Ablation: logs replayed through `livo` and `zou2024` with one part left out.

A replay is as in a flight, causal and from lift-off to the end of the survey. Errors are means of
the distance from the true position, not aligned.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from touchdown.experiments.errors import UsageError
from touchdown.experiments.flight.replay import LoggedRun, open_run, replay, replay_config
from touchdown.experiments.reporting.statistics import mean_interval

Report = Callable[[str], None]
Rows = dict[str, dict[str, Any]]
"""``error_m``, ``cpu_ms`` and ``lost_s`` by variant, see `replayed`"""

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

_MIN_LOGS = 3
"""of an interval"""


def ablate(
    runs: Sequence[Path],
    methods: Sequence[str] = (),
    seconds: float | None = None,
    report: Report = lambda _text: None,
) -> dict[str, Rows]:
    """`replayed` by run, as ``NAME`` of its directory, and variant of ``methods`` (`variants`), of
    the first ``seconds`` after lift-off where these are given. Raises UsageError."""
    found: dict[str, Rows] = {}
    for run in runs:
        logged, rows = open_run(run), found.setdefault(run.name, {})
        end_s = math.inf if seconds is None else logged.from_s + seconds
        for variant in variants(methods):
            report(f"{run.name}: {variant}")
            rows[variant] = replayed(logged, variant, end_s)
    return found


def replayed(logged: LoggedRun, variant: str, end_s: float = math.inf) -> dict[str, Any]:
    """Result of one of `VARIANTS` on one log until ``end_s``: ``error_m``, ``cpu_ms`` of one core
    per 0.1 s of data, and ``lost_s``, the time at which its error exceeded the limit of a flight,
    or None; the error is that until then. Raises UsageError when the log lacks what it needs."""
    estimator, values = VARIANTS[variant]
    changes = tuple(f"{estimator}.{name}={str(value).lower()}" for name, value in values.items())
    config = replay_config(logged.path, estimator, changes, fresh=True)
    result = replay(logged.path, config, until_s=end_s)
    error, timing = result.position_error_m, result.plain()["timing"]
    return {
        "error_m": math.nan if error is None or error.mean is None else error.mean,
        "cpu_ms": timing["stage_ms"]["estimator"],
        "lost_s": timing["sim_s"] if result.outcome == "DIVERGED" else None,
    }


def whole(variant: str) -> str:
    """The variant with everything on that ``variant`` is compared with."""
    return next(name for name, made in VARIANTS.items() if made == (VARIANTS[variant][0], {}))


def variants(methods: Sequence[str]) -> list[str]:
    """Those of the estimators or with the names in ``methods``; all for none. Raises UsageError."""
    estimators = {estimator for estimator, _ in VARIANTS.values()}
    for name in methods:
        if name not in VARIANTS and name not in estimators:
            one_of = ", ".join([*sorted(estimators), *VARIANTS])
            raise UsageError(f"--method: no '{name}'; name one of: {one_of}")
    chosen = [v for v in VARIANTS if v in methods or VARIANTS[v][0] in methods]
    compared = {*chosen, *map(whole, chosen)}
    return [v for v in VARIANTS if v in compared] if methods else list(VARIANTS)


def ablation_table(found: Mapping[str, Rows]) -> str:
    """Markdown table, one column per log: mean error in metres, or the time of the loss; of three
    logs and more what leaving the part out adds to the error, with its interval."""
    logs = list(found)
    rows = [variant for variant in VARIANTS if variant in found[logs[0]]]
    heads = ["variant", *logs] + ["more error, 95 %"] * (len(logs) >= _MIN_LOGS)
    lines = ["| " + " | ".join(heads) + " |", "|---|" + "---|" * (len(heads) - 1)]
    for variant in rows:
        cells = [_cell(found[log][variant]) for log in logs]
        if len(logs) >= _MIN_LOGS:
            cells.append(_more(found, variant))
        lines.append(f"| {variant} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _more(found: Mapping[str, Rows], variant: str) -> str:
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


def _cell(row: Mapping[str, Any]) -> str:
    lost = row["lost_s"]
    return f"{row['error_m']:.3f}" if lost is None else f"lost at {lost:.0f} s"
