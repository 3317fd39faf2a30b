"""Commands ``touchdown bench ...``, which measure speed and accuracy."""

import json
import pkgutil
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import click

from touchdown.experiments.cli.common import (
    JOB_COUNT,
    JSON,
    ONE_JOB,
    OVERRIDES,
    PATH,
    PROFILE,
    QUIET,
    SEED,
    CommandGroup,
    Number,
    answer,
    answered,
)
from touchdown.experiments.cli.console import print_stages
from touchdown.experiments.errors import UsageError, usage_errors
from touchdown.experiments.terminal import end_progress, make_progress, say

_SCENE = click.option("--scene", default="crossroad", show_default=True)
_ESTIMATOR = click.option("--estimator", default="livo", show_default=True)
_FULL = click.option("--full", is_flag=True, help="The whole survey instead of a short one.")


def _rounds(default: int) -> Any:
    return click.option("--rounds", type=click.IntRange(1, 100), default=default,
                        show_default=True, help="Medians are printed.")  # fmt: skip


def _seeds(default: str) -> Any:
    return click.option("--seeds", default=default, show_default=True,
                        help="Such as 0-24 or 100,101.")  # fmt: skip


@click.group(cls=CommandGroup, modules={"tune": "tune:bench_tune"})
def bench() -> None:
    """Measure speed.

    Example: touchdown bench loop
    """


@bench.command("loop")
@_SCENE
@_ESTIMATOR
@SEED
@_FULL
@JSON
@QUIET
def bench_loop(as_json: bool, quiet: bool, **chosen: Any) -> int:
    """Fly with all sensors and recording: real-time factor and the fraction of each stage.

    Example: touchdown bench loop --json
    """
    from touchdown.experiments.benchmarks.loop import bench_config, measure_loop
    from touchdown.experiments.flight.run import fly_with_usage_errors

    config = bench_config(record=True, **chosen)
    progress = make_progress(quiet)
    found = measure_loop(config, lambda cfg, out: fly_with_usage_errors(cfg, out, progress))
    end_progress(quiet)
    result = found["result"]
    return answer(
        found["figures"], as_json, lambda _figures: print_stages(result), good=result.is_success
    )


def _print_lidar(figures: dict[str, Any]) -> None:
    for name, rate in figures["rays_per_s"].items():
        beside = f"  sensor {figures['ratio'][name]:.2f}x" if name in figures["ratio"] else ""
        click.echo(f"{name:13} {rate / 1e6:7.2f} million rays/s{beside}")


@bench.command("lidar")
@_SCENE
@click.option("--preset", default="horizon", show_default=True, help="horizon, avia or mid360.")
@SEED
@_rounds(7)
@answered(_print_lidar)
def bench_lidar(**options: Any) -> dict[str, Any]:
    """Measure rays per second of the LIDAR sensor and of bare ray casters, one thread each.

    Example: touchdown bench lidar --json
    """
    from touchdown.experiments.benchmarks.lidar import bench_lidar as measure

    return measure(**options)


def _print_landing(figures: dict[str, Any]) -> None:
    beside = figures.get("reference_ms", {})
    for name, milliseconds in figures["stage_ms"].items():
        other = f"{beside[name]:9.1f}" if name in beside else ""
        click.echo(f"{name:14}{milliseconds:8.2f} ms{other}")
    if "classifier_ms" in figures:
        sites, ms = figures["classified_sites"], figures["classifier_ms"]
        click.echo(f"{'ten patches':14}{ms['ten_patches']:8.2f} ms")
        click.echo(f"{'with classes':14}{ms['selection']:8.2f} ms ({sites} sites classified)")
    if beside:
        click.echo(f"ratio.reference {figures['ratio']['reference']:.1f}")


@bench.command("landing")
@_SCENE
@SEED
@_rounds(9)
@click.option("--reference/--no-reference", default=True, help="Time the reference code too.")
@click.option("--network", type=PATH, help="Ground classifier (ONNX).  [the shipped one]")
@click.option("--threads", type=JOB_COUNT, default=2, show_default=True, help="Of the network.")
@answered(_print_landing)
def bench_landing(**options: Any) -> dict[str, Any]:
    """Time each step of site selection on the map of a whole survey, in milliseconds (Table 7 of
    the paper), beside the same steps by Open3D, SciPy and scikit-image, one thread each.

    ``selection`` is a whole decision of the lander, the check of the ground included. With a
    network: the time to classify ten patches of 128 x 128, and a whole decision with it.

    Example: touchdown bench landing --json
    """
    from touchdown.experiments.benchmarks.selection.timing import bench_landing as measure

    return measure(**options)


@bench.command("selector")
@click.argument("scenes", nargs=-1)
@_seeds("0-24")
@click.option("--maps", type=PATH, metavar="DIR",
              help="Take the maps that `touchdown maps make` kept in DIR.")  # fmt: skip
@click.option("--selector", "selectors", multiple=True, metavar="NAME",
              help="risk, zou2024, or MODULE:FUNCTION, which both are compared with. May be "
              "repeated.  [risk]")  # fmt: skip
@ONE_JOB
@click.option("--fit", "fit_model", is_flag=True, help="Fit landing.risk_weights to these maps.")
@click.option("--pictures", type=PATH, metavar="DIR",
              help="Draw the steps to each site (Fig. 11 of the paper) into DIR.")  # fmt: skip
@click.option("--worst", type=click.IntRange(1), metavar="N",
              help="Draw the N places of the largest regret alone.")  # fmt: skip
@click.option("--curves", type=PATH, metavar="DIR",
              help="Draw the reliability diagram, and curves against the dials of the maps, into "
              "DIR.")  # fmt: skip
@OVERRIDES
@JSON
def bench_selector(
    scenes: tuple[str, ...],
    seeds: str,
    maps: Path | None,
    selectors: tuple[str, ...],
    as_json: bool,
    **options: Any,
) -> int:
    """Choose sites without flying and compare them with the true ground: precision, recall, regret,
    time and calibration. The sensors take the planned poses of the survey. SCENES: by default all
    scenes but flat and open_water.

    Example: touchdown bench selector --maps maps --selector examples.flat_disc:build
    """
    from touchdown.experiments.benchmarks.selection import sites
    from touchdown.experiments.benchmarks.selection.curves import Drawings

    if maps is not None and scenes:
        raise UsageError("SCENES and --maps exclude each other: maps are of their own scenes")
    named = list(selectors)
    if any(":" in name for name in named):
        named += [name for name in ("risk", "zou2024") if name not in named]
    source = maps or sites.Posed(scenes or sites.SCENES, seeds)
    options["report"] = lambda result: say(sites.row(result), err=as_json)
    folders = (options.pop(name) for name in Drawings._fields)
    options["drawings"] = Drawings(*folders)
    figures = usage_errors(lambda: sites.run(source, named, **options))
    return answer(figures, as_json, lambda found: say(sites.text(found)))


@bench.command("all")
@_rounds(1)
@JSON
def bench_all(rounds: int, as_json: bool) -> int:
    """Measure what a flight costs: a landing on one core as a worker flies it, the real-time factor
    with recording, the LIDAR beside other ray casters, the choice of a site.

    Example: touchdown bench all --json
    """
    import touchdown

    return _measure([Path(touchdown.__file__).parents[2]], rounds, as_json)


@bench.command("compare")
@click.argument("a", type=PATH)
@click.argument("b", type=PATH)
@_rounds(1)
@JSON
def bench_compare(a: Path, b: Path, rounds: int, as_json: bool) -> int:
    """Run the measures of `bench all` on the checkouts A and B in turns, in this environment.

    Example: touchdown bench compare ../touchdown-before .
    """
    return _measure([a, b], rounds, as_json)


def _measure(trees: Sequence[Path], rounds: int, as_json: bool) -> int:
    """Figures by title: unit, values of the checkouts, and the last over the first of two."""
    from touchdown.experiments.benchmarks.all_measures import measure_all

    plain: dict[str, Any] = {}

    def run() -> None:
        for name, figures in measure_all(trees, rounds):
            for one in figures:
                ratio = {"ratio": one.ratio} if len(one.values) > 1 else {}
                plain[one.measure.title] = {
                    "unit": one.measure.unit, "values": list(one.values), **ratio
                }  # fmt: skip
            say(f"bench {name}: done" if as_json else "\n".join(map(_line, figures)), err=as_json)

    usage_errors(run)
    return answer(plain, as_json, lambda _figures: None)


def _line(one: Any) -> str:
    values = "".join("         -" if v is None else f"{v:10.3g}" for v in one.values)
    ratio = f"  x {one.ratio:.2f}" if len(one.values) > 1 and one.ratio is not None else ""
    return f"{one.measure.title:38}{values} {one.measure.unit}{ratio}"


def _table_by(place: str) -> Callable[[dict[str, Any]], None]:
    """Prints the text that MODULE:FUNCTION in `experiments.benchmarks` makes of figures."""
    name = f"touchdown.experiments.benchmarks.{place}"
    return lambda figures: say(pkgutil.resolve_name(name)(figures))


@bench.command("profile")
@click.argument("scene", default="crossroad")
@_ESTIMATOR
@click.option("--profile", default="field", show_default=True)
@SEED
@_FULL
@click.option("--out", type=PATH, metavar="DIR",
              help="Write stages.json and, with py-spy, flame.svg there.")  # fmt: skip
@answered(_table_by("flight_profile:table"))
def bench_profile(out: Path | None, **chosen: Any) -> dict[str, Any]:
    """Fly once on one core, without recording: the processor time of each stage, and a flame graph.

    The time of a stage is without that of the stages that it calls. The flame graph needs py-spy
    (pip install py-spy).

    Example: touchdown bench profile forest --out profile
    """
    from touchdown.experiments.benchmarks import flight_profile

    config = flight_profile.profile_config(**chosen)
    if out is None:
        return flight_profile.profile_flight(config)
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
        figures = flight_profile.profile_flight(config)
    (out / "stages.json").write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    return figures


def _report(quiet: bool, text: str) -> None:
    if not quiet and sys.stderr.isatty():
        print(f"\r\x1b[K{text}"[:160], end="", file=sys.stderr, flush=True)


@bench.command("ablate")
@click.argument("runs", nargs=-1, required=True, type=PATH)
@click.option("--method", multiple=True, metavar="NAME",
              help="livo or zou2024, or one row of the table; may be given more than once.  "
              "[all]")  # fmt: skip
@click.option("--seconds", type=Number(min=0.0, max=86400.0, min_open=True),
              help="Duration of each log after lift-off.  [all]")  # fmt: skip
@answered(_table_by("ablation:ablation_table"))
@QUIET
def bench_ablate(
    runs: tuple[Path, ...], method: tuple[str, ...], seconds: float | None, quiet: bool
) -> dict[str, Any]:
    """Replay logged surveys through livo and zou2024 with one part after the other left out.

    RUNS: run directories flown with --log-sensors. Of three and more the table has an interval of
    what each part is worth. All of it is open loop.

    Example: touchdown bench ablate runs/survey --method livo
    """
    from touchdown.experiments.benchmarks.ablation import ablate

    return ablate(runs, method, seconds, lambda text: _report(quiet, text))


def _range(name: str, low: float, high: float, what: str) -> Any:
    number = Number(min=0.0, max=1000.0)
    return click.option(name, nargs=2, type=number, default=(low, high), show_default=True,
                        metavar="LOW HIGH", help=f"{what}, drawn evenly.")  # fmt: skip


@bench.command("touchdown")
@click.option("--contacts", type=click.IntRange(1, 100_000), default=100, show_default=True,
              help="Of each level of each ground: 43 levels.")  # fmt: skip
@SEED
@ONE_JOB
@click.option("--bound", type=Number(min=0.0, max=1.0), default=0.05, show_default=True,
              help="Probability to tip, strike or slide that is allowed.")  # fmt: skip
@_range("--friction", 0.3, 0.9, "Sliding friction of the feet")
@_range("--speed", 0.0, 0.5, "Speed over the ground at the contact, m/s")
@_range("--wind-kmh", 0.0, 40.0, "Wind")
@click.option("--profile", type=PROFILE, default="field", show_default=True)
@click.option("--out", type=PATH, metavar="DIR",
              help="Write touchdown.json and the maps, touchdown.svg, there.")  # fmt: skip
@OVERRIDES
@answered(_table_by("contact.tipping:table"))
@QUIET
def bench_touchdown(out: Path | None, quiet: bool, **options: Any) -> dict[str, Any]:
    """Set the vehicle down by its own descent, detection and controller on slopes of 0 to 25
    degrees, and with one or two legs on steps and rocks of up to 0.4 m: how often it tips, strikes
    the ground or slides; and up to which slope and step it stands.

    Nothing is perceived: the estimate is true, but for a drift by which the vehicle moves over the
    ground.

    Example: touchdown bench touchdown --contacts 200 --jobs 2 --out touchdown
    """
    from touchdown.experiments.benchmarks.contact import tipping

    names = {"friction": "friction", "speed": "speed_mps", "wind_kmh": "wind_kmh"}
    ranges = tipping.Ranges(**{key: options.pop(name) for name, key in names.items()})
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    figures = tipping.measure(
        ranges=ranges, report=lambda n, of: _report(quiet, f"{n} of {of} contacts"), **options
    )
    if out is not None:
        from touchdown.experiments.benchmarks.contact.figure import draw

        text = json.dumps(figures, indent=2) + "\n"
        (out / "touchdown.json").write_text(text, encoding="utf-8")
        draw(figures, out / "touchdown.svg")
    return figures


@bench.command("hazards")
@click.argument("scenes", nargs=-1)
@_seeds("0-3")
@click.option("--places", type=click.IntRange(1, 100), default=6, show_default=True,
              help="Looked at in each scene, below the way of the survey.")  # fmt: skip
@ONE_JOB
@click.option("--out", type=PATH, metavar="DIR", help="Draw the curves, hazards.svg, there.")
@OVERRIDES
@answered(_table_by("selection.hazards:table"))
def bench_hazards(
    scenes: tuple[str, ...], seeds: str, overrides: Sequence[str], out: Path | None, **options: Any
) -> dict[str, Any]:
    """Find rocks and steps of known size on level ground: recall and precision against their
    diameter, in the survey's map and in the fine map of the rechecks at 10 m and 4 m. SCENES: by
    default rugged.

    Example: touchdown bench hazards --seeds 0-3 --out hazards
    """
    from touchdown.experiments.benchmarks.selection import hazards, sites

    source = sites.Posed(scenes or ("rugged",), seeds, "field")
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    configs = [
        sites.config_of(source.profile, None, tuple(overrides), *place) for place in source.places()
    ]
    return hazards.measure(configs, out=out, **options)


def _print_limit(figures: dict[str, Any]) -> None:
    from touchdown.experiments.benchmarks.limit.survey import table

    say(table(figures["runs"]))


@bench.command("limit")
@click.argument("runs", nargs=-1, required=True, type=PATH)
@click.option("--replay/--no-replay", "replays", default=True, show_default=True,
              help="Replay livo on the same logs.")  # fmt: skip
@answered(_print_limit)
@QUIET
def bench_limit(runs: tuple[Path, ...], replays: bool, quiet: bool) -> dict[str, Any]:
    """Print the Cramér-Rao bound of the position error of logged surveys, by sets of sensors, and
    the error of livo on the same logs.

    RUNS: run directories flown with --log-sensors. The bound is computed from the true path, the
    true surface and the noises; it is no estimator.

    Example: touchdown bench limit runs/survey
    """
    from touchdown.experiments.benchmarks.limit import survey

    return {"runs": [survey.measure(run, replays, lambda t: _report(quiet, t)) for run in runs]}
