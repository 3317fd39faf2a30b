"""``touchdown bench estimator``, ``bench imu`` and ``bench limit``: beside programs and records of
others, and beside what is possible."""

from __future__ import annotations

import json
import math
import sys
import tempfile
from pathlib import Path
from typing import Any

import click

from touchdown.experiments.cli.common import EXIT_DONE, JSON, PATH, QUIET, SEED, Number, answer
from touchdown.experiments.errors import usage_errors
from touchdown.experiments.terminal import say


@click.command("estimator")
@click.argument("scenes", nargs=-1)
@click.option(
    "--ablate", is_flag=True, help="Leave out one part of the estimators after the other instead."
)
@click.option(
    "--seed",
    type=SEED,
    multiple=True,
    default=(0,),
    show_default="0",
    help="Seed of the surveys; once for all scenes, or once for each.",
)
@click.option(
    "--method",
    multiple=True,
    metavar="NAME",
    help="Only this row of the table, or with --ablate the rows of this estimator; may be given "
    "more than once.  [all]",
)
@click.option(
    "--seconds",
    type=Number(min=0.0, max=86400.0, min_open=True),
    help="Duration of each log after lift-off.  [all]",
)
@click.option(
    "--runs",
    type=PATH,
    help="Keep the logged surveys here, and use those that are there.  [a temporary folder]",
)
@JSON
@QUIET
def bench_estimator(
    scenes: tuple[str, ...],
    ablate: bool,
    seed: tuple[int, ...],
    method: tuple[str, ...],
    seconds: float | None,
    runs: Path | None,
    as_json: bool,
    quiet: bool,
) -> int:
    """Compare positioning error and cost with odometry of others on equal logs.

    One survey per scene (crossroad, lake, houses and forest unless named) is flown with livo, in
    the default profile. A scene may be named more than once, with a seed each. The log is replayed
    through livo, zou2024 and the reference implementations KISS-ICP and small_gicp, these on the
    scans alone and with the best of a grid of settings. With --ablate it is replayed through livo
    and zou2024 with one part after the other left out; of three logs and more the table has an
    interval of what each part is worth. All of it is open loop.

    Example: touchdown bench estimator crossroad --seconds 20 --runs runs/logged
    """
    from touchdown.experiments.benchmarks import odometry as bench

    report = _quiet if quiet else _to_stderr
    with tempfile.TemporaryDirectory(prefix="touchdown-bench-") as folder:
        figures = usage_errors(
            lambda: bench.bench_estimator(
                scenes or bench.SCENES, seeds=seed, runs=runs or Path(folder), ablate=ablate,
                seconds=seconds, report=report, methods=method,
            )
        )  # fmt: skip
    table = bench.ablation_table(figures["ablation"]) if ablate else _table(figures)
    say(json.dumps(figures, indent=2) if as_json else table)
    return EXIT_DONE


def _quiet(_text: str) -> None:
    pass


def _to_stderr(text: str) -> None:
    if sys.stderr.isatty():
        print(f"\r\x1b[K{text}"[:160], end="", file=sys.stderr, flush=True)


def _table(figures: dict[str, Any]) -> str:
    """One row a method: methods are many, scenes are few."""
    scenes, details = list(figures["error_m"]), figures["scenes"]
    lines = ["| method | " + " | ".join(scenes) + " | CPU for 0.1 s of data (ms) |"]
    lines.append("|---|" + "---|" * (len(scenes) + 1))
    for name, cost in figures["ms_per_0.1s"].items():
        cells = [_error(details[s]["error_m"][name], details[s]["lost_s"][name]) for s in scenes]
        lines.append(f"| {name} | " + " | ".join(cells) + f" | {cost:.1f} |")
    if ratios := figures["ratio"]:
        cells = [f"{ratios[log]:.1f}" if log in ratios else "" for log in scenes]
        lines.append("| best reference / livo_no_camera | " + " | ".join(cells) + " | |")
    lines.append("\nmean error in metres, not aligned")
    if ratios:
        lines.append(f"geometric mean of the ratio: {ratios['geometric_mean']:.2f}")
    for scene in scenes:
        for method, setting in details[scene]["best"].items():
            text = ", ".join(f"{name} {value}" for name, value in setting.items())
            lines.append(f"{scene}: best of {method}: {text}")
    return "\n".join(lines)


def _error(error_m: float, lost_s: float | None) -> str:
    if lost_s is None:
        return f"{error_m:.3f}"
    until = "" if math.isnan(error_m) else f"{error_m:.2f} until "
    return f"{until}lost at {lost_s:.0f} s"


@click.command("imu")
@click.option("--data", type=PATH, required=True, metavar="DIR",
              help="Recorded flights of Hurwitz and Klein (2023).")  # fmt: skip
@JSON
def bench_imu(data: Path, as_json: bool) -> int:
    """Compare the vibration of the simulated IMU with that of recorded flights, band by band.

    Example: touchdown bench imu --data flights
    """
    from touchdown.experiments.benchmarks import imu_spectra

    found = usage_errors(lambda: imu_spectra.measure(data))
    plain = {name: array.tolist() for name, array in found.items()}
    return answer(plain, as_json, lambda _: say("\n".join(imu_spectra.rows(found))))


@click.command("limit")
@click.argument("runs", nargs=-1, required=True, type=PATH)
@click.option("--replay/--no-replay", "replays", default=True,
              help="Replay livo on the same logs.  [replay]")  # fmt: skip
@JSON
@QUIET
def bench_limit(runs: tuple[Path, ...], replays: bool, as_json: bool, quiet: bool) -> int:
    """Print the Cramér-Rao bound of the position error of logged surveys, by sets of sensors, and
    the error of livo on the same logs.

    RUNS: run directories flown with --log-sensors. The bound is computed from the true path, the
    true surface and the noises; it is no estimator.

    Example: touchdown bench limit runs/survey
    """
    from touchdown.experiments.benchmarks.limit import survey

    report = _quiet if quiet else _to_stderr
    figures = usage_errors(lambda: [survey.measure(run, replays, report) for run in runs])
    return answer({"runs": figures}, as_json, lambda _: say(survey.table(figures)))
