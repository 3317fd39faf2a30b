"""Commands ``touchdown bench ...``, which measure speed and accuracy."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from touchdown.experiments.cli.common import (
    EXIT_DONE,
    EXIT_FAILED,
    JSON,
    OVERRIDES,
    PATH,
    QUIET,
    SEED,
    CommandGroup,
    answer,
)
from touchdown.experiments.cli.console import print_stages
from touchdown.experiments.errors import usage_errors
from touchdown.experiments.terminal import end_progress, make_progress, say


@click.group(
    cls=CommandGroup,
    modules={
        "all": "bench_all:bench_all",
        "compare": "bench_all:bench_compare",
        "estimator": "bench_odometry:bench_estimator",
        "imu": "bench_odometry:bench_imu",
        "limit": "bench_odometry:bench_limit",
        "profile": "bench_all:bench_profile",
    },
)
def bench() -> int:
    """Measure speed.

    Example: touchdown bench loop
    """
    return EXIT_DONE


@bench.command("loop")
@click.option("--scene", default="crossroad", show_default=True)
@click.option("--estimator", default="livo", show_default=True)
@click.option("--seed", type=SEED, default=0, show_default=True)
@click.option("--full", is_flag=True, help="The whole survey instead of a short one.")
@JSON
@QUIET
def bench_loop(as_json: bool, quiet: bool, **chosen: Any) -> int:
    """Fly with all sensors and recording: real-time factor and the share of each stage.

    Example: touchdown bench loop --json
    """
    from touchdown.experiments.benchmarks.loop import bench_config, measure_loop
    from touchdown.experiments.flight.run import fly_with_usage_errors

    config = bench_config(record=True, **chosen)
    progress = make_progress(quiet)
    found = measure_loop(config, lambda cfg, out: fly_with_usage_errors(cfg, out, progress))
    end_progress(quiet)
    if as_json:
        click.echo(json.dumps(found["figures"], indent=2))
    else:
        print_stages(found["result"])
    return EXIT_DONE if found["result"].is_success else EXIT_FAILED


@bench.command("lidar")
@click.option("--scene", default="crossroad", show_default=True)
@click.option("--preset", default="horizon", show_default=True, help="horizon, avia or mid360.")
@click.option("--seed", type=SEED, default=0, show_default=True)
@click.option("--rounds", type=click.IntRange(1, 100), default=7, show_default=True)
@JSON
def bench_lidar(as_json: bool, **options: Any) -> int:
    """Measure rays per second of the LIDAR sensor and of bare ray casters, one thread each.

    Example: touchdown bench lidar --json
    """
    from touchdown.experiments.benchmarks.lidar import bench_lidar as measure

    def show(figures: dict[str, Any]) -> None:
        for name, rate in figures["rays_per_s"].items():
            beside = f"  sensor {figures['ratio'][name]:.2f}x" if name in figures["ratio"] else ""
            click.echo(f"{name:13} {rate / 1e6:7.2f} million rays/s{beside}")

    return answer(usage_errors(lambda: measure(**options)), as_json, show)


@bench.command("landing")
@click.option("--scene", default="crossroad", show_default=True)
@click.option("--seed", type=SEED, default=0, show_default=True)
@click.option("--rounds", type=click.IntRange(1, 100), default=9, show_default=True)
@click.option("--reference/--no-reference", default=True, help="Time the reference code too.")
@click.option("--network", type=PATH, default=None,
              help="Ground classifier (ONNX).  [the one that comes with touchdown]")  # fmt: skip
@click.option("--threads", type=click.IntRange(1, 1024), default=2, show_default=True,
              help="Processor threads of the network.")  # fmt: skip
@JSON
def bench_landing(reference: bool, threads: int, as_json: bool, **options: Any) -> int:
    """Time each step of site selection on the map of a whole survey, in milliseconds (Table 7 of
    the paper), beside the same steps by Open3D, SciPy and scikit-image, one thread each.

    ``selection`` is a whole decision of the lander, the check of the ground included. With a
    network: the time to classify ten patches of 128 x 128, and a whole decision with it.

    Example: touchdown bench landing --json
    """
    from touchdown.experiments.benchmarks.selection.timing import bench_landing as measure

    figures = usage_errors(lambda: measure(reference=reference, threads=threads, **options))
    if as_json:
        click.echo(json.dumps(figures, indent=2))
        return EXIT_DONE
    beside = figures.get("reference_ms", {})
    for name, milliseconds in figures["stage_ms"].items():
        other = f"{beside[name]:9.1f}" if name in beside else ""
        click.echo(f"{name:14}{milliseconds:8.2f} ms{other}")
    if "classifier_ms" in figures:
        sites, ms = figures["classified_sites"], figures["classifier_ms"]
        click.echo(f"{'ten patches':14}{ms['ten_patches']:8.2f} ms on {threads} threads")
        click.echo(f"{'with classes':14}{ms['selection']:8.2f} ms ({sites} sites classified)")
    if reference:
        click.echo(f"ratio.reference {figures['ratio']['reference']:.1f}")
    return EXIT_DONE


@bench.command("selector")
@click.argument("scenes", nargs=-1)
@click.option("--seeds", default="0-24", show_default=True, help="Such as 0-24 or 100,101.")
@click.option("--maps", type=PATH, default=None, metavar="DIR",
              help="Take the maps that `touchdown maps make` kept in DIR.")  # fmt: skip
@click.option("--selector", "selectors", multiple=True, metavar="NAME",
              help="risk, zou2024, or MODULE:FUNCTION, which both are compared with. May be "
              "repeated.  [risk]")  # fmt: skip
@click.option("--jobs", type=click.IntRange(1, 1024), default=1, show_default=True)
@click.option("--fit", "fit_model", is_flag=True, help="Fit landing.risk_weights to these maps.")
@click.option("--pictures", type=PATH, default=None, metavar="DIR",
              help="Draw the steps to each site (Fig. 11 of the paper) into DIR.")  # fmt: skip
@click.option("--worst", type=click.IntRange(1), default=None, metavar="N",
              help="Draw the N places of the largest regret alone.")  # fmt: skip
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
    from touchdown.experiments.benchmarks.selection import sites as selector_check
    from touchdown.experiments.errors import UsageError

    if maps is not None and scenes:
        raise UsageError("SCENES and --maps exclude each other: maps are of their own scenes")
    named = list(selectors)
    if any(":" in name for name in named):
        named += [name for name in ("risk", "zou2024") if name not in named]
    posed = selector_check.Posed(scenes or selector_check.SCENES, seeds)
    figures = usage_errors(
        lambda: selector_check.run(
            posed if maps is None else maps,
            named,
            report=lambda result: say(selector_check.row(result), err=as_json),
            **options,
        )
    )
    return answer(figures, as_json, lambda figures: say(selector_check.text(figures)))


@click.group(cls=CommandGroup)
def maps() -> int:
    """Keep maps of surveys with their true ground.

    Example: touchdown maps make crossroad --seeds 0-4 --out maps
    """
    return EXIT_DONE


@maps.command("make")
@click.argument("scenes", nargs=-1)
@click.option("--seeds", default="0-11", show_default=True, help="Such as 0-24 or 100,101.")
@click.option("--profile", type=click.Choice(["ideal", "field", "harsh"]), default="field",
              show_default=True)  # fmt: skip
@click.option("--out", type=PATH, required=True, metavar="DIR", help="Folder of the maps.")
@click.option("--jobs", type=click.IntRange(1, 1024), default=1, show_default=True)
@OVERRIDES
@JSON
def maps_make(
    scenes: tuple[str, ...], seeds: str, profile: str, out: Path, as_json: bool, **options: Any
) -> int:
    """Survey SCENES at their planned poses, without a flight, and keep each map with its true
    ground as DIR/SCENE-SEED.map.npz. SCENES: by default all scenes but flat and open_water.

    Example: touchdown maps make --out maps --jobs 2
    """
    from touchdown.experiments.benchmarks.selection import sites as selector_check

    source = selector_check.Posed(scenes or selector_check.SCENES, seeds, profile)
    files = usage_errors(
        lambda: selector_check.make_maps(
            source, out, report=lambda file: say(str(file), err=as_json), **options
        )
    )
    return answer({"maps": [str(file) for file in files]}, as_json, lambda _figures: None)
