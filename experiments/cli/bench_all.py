"""``touchdown bench all``, ``bench compare`` and ``bench profile``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from touchdown.experiments.cli.common import JSON, PATH, SEED, answer
from touchdown.experiments.errors import UsageError, usage_errors
from touchdown.experiments.terminal import say

ROUNDS = click.IntRange(1, 100)


@click.command("all")
@click.option("--rounds", type=ROUNDS, default=1, show_default=True, help="Medians are printed.")
@JSON
def bench_all(rounds: int, as_json: bool) -> int:
    """Measure what a flight costs: a landing on one core as a worker flies it, the real-time factor
    with recording, the LIDAR beside other ray casters, the choice of a site.

    Example: touchdown bench all --json
    """
    import touchdown

    return _measure([Path(touchdown.__file__).parents[2]], rounds, as_json)


@click.command("compare")
@click.argument("a", type=PATH)
@click.argument("b", type=PATH)
@click.option("--rounds", type=ROUNDS, default=1, show_default=True, help="Medians are printed.")
@JSON
def bench_compare(a: Path, b: Path, rounds: int, as_json: bool) -> int:
    """Run the measures of `bench all` on the checkouts A and B in turns, in this environment.

    Example: touchdown bench compare ../touchdown-before .
    """
    return _measure([a, b], rounds, as_json)


@click.command("profile")
@click.argument("scene", default="crossroad")
@click.option("--estimator", default="livo", show_default=True)
@click.option("--profile", default="field", show_default=True)
@click.option("--seed", type=SEED, default=0, show_default=True)
@click.option("--full", is_flag=True, help="The whole survey instead of a short one.")
@click.option("--out", type=PATH, default=None, metavar="DIR",
              help="Write stages.json and, with py-spy, flame.svg there.")  # fmt: skip
@JSON
def bench_profile(out: Path | None, as_json: bool, **chosen: Any) -> int:
    """Fly once on one core, without recording: the processor time of each stage, and a flame graph.

    The time of a stage is without that of the stages that it calls. The flame graph needs py-spy
    (pip install py-spy).

    Example: touchdown bench profile forest --out profile
    """
    from touchdown.experiments.benchmarks import flight_profile

    def measure() -> dict[str, Any]:
        config = flight_profile.profile_config(**chosen)
        figures = None
        if out is not None:
            if out.exists() and not out.is_dir():
                raise UsageError(f"--out '{out}' is a file: name a directory")
            out.mkdir(parents=True, exist_ok=True)
            again = [chosen["scene"]]
            for name in ("estimator", "profile", "seed"):
                again += [f"--{name}", str(chosen[name])]
            again += ["--full"] if chosen["full"] else []
            figures = flight_profile.profile_with_flames(again, out / "flame.svg")
            if figures is None:
                say("no flame graph: py-spy is not installed (pip install py-spy)", err=True)
        figures = figures or flight_profile.profile_flight(config)
        if out is not None:
            (out / "stages.json").write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
        return figures

    return answer(usage_errors(measure), as_json, lambda found: say(flight_profile.table(found)))


def _measure(trees: Sequence[Path], rounds: int, as_json: bool) -> int:
    from touchdown.experiments.benchmarks.all_measures import Figures, measure_all

    found: list[Figures] = []

    def run() -> None:
        for name, figures in measure_all(trees, rounds):
            found.extend(figures)
            if as_json:
                say(f"bench {name}: done", err=True)
                continue
            for one in figures:
                click.echo(_line(one))

    usage_errors(run)
    return answer(as_plain(found), as_json, lambda _figures: None)


def as_plain(found: Sequence[Any]) -> dict[str, Any]:
    """Figures by title: unit, values of the checkouts, and the last over the first of two."""
    return {
        one.measure.title: {"unit": one.measure.unit, "values": list(one.values)}
        | ({"ratio": one.ratio} if len(one.values) > 1 else {})
        for one in found
    }


def _line(one: Any) -> str:
    values = "".join("         -" if v is None else f"{v:10.3g}" for v in one.values)
    ratio = f"  x {one.ratio:.2f}" if len(one.values) > 1 and one.ratio is not None else ""
    return f"{one.measure.title:38}{values} {one.measure.unit}{ratio}"
