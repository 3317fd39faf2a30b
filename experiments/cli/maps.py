"""Command ``touchdown maps``."""

from pathlib import Path
from typing import Any

import click

from touchdown.experiments.cli.common import (
    JSON,
    ONE_JOB,
    OVERRIDES,
    PATH,
    PROFILE,
    CommandGroup,
    answer,
)
from touchdown.experiments.errors import UsageError, usage_errors
from touchdown.experiments.terminal import say


def _dial(text: str) -> tuple[str, list[float]]:
    """The key and the values of KEY=FROM:TO:STEPS. Raises UsageError for another text."""
    from touchdown.experiments.campaign.campaign_file import unrolled

    key, _, given = text.partition("=")
    try:
        low, high, steps = (int(n) if n.isdecimal() else float(n) for n in given.split(":"))
        return key, unrolled({"from": low, "to": high, "steps": steps})
    except ValueError:
        raise UsageError(
            f"--dial '{text}' is no KEY=FROM:TO:STEPS, such as rugged.slope_deg=0:20:6"
        ) from None


@click.group(cls=CommandGroup)
def maps() -> None:
    """Keep maps of surveys with their true ground.

    Example: touchdown maps make crossroad --seeds 0-4 --out maps
    """


@maps.command("make")
@click.argument("scenes", nargs=-1)
@click.option("--seeds", default="0-11", show_default=True, help="Such as 0-24 or 100,101.")
@click.option("--profile", type=PROFILE, default="field", show_default=True)
@click.option("--out", type=PATH, required=True, metavar="DIR", help="Folder of the maps.")
@click.option("--dial", "dials", multiple=True, metavar="KEY=FROM:TO:STEPS",
              help="Make each map at so many values of a key. May be repeated: each dial is turned "
              "alone.")  # fmt: skip
@ONE_JOB
@OVERRIDES
@JSON
def maps_make(
    scenes: tuple[str, ...],
    seeds: str,
    profile: str,
    out: Path,
    dials: tuple[str, ...],
    as_json: bool,
    **options: Any,
) -> int:
    """Survey SCENES at their planned poses, without a flight, and keep each map with its true
    ground as DIR/SCENE-SEED.map.npz. SCENES: by default all scenes but flat and open_water.

    Example: touchdown maps make rugged --dial rugged.slope_deg=0:20:6 --out maps --jobs 2
    """
    from touchdown.experiments.benchmarks.selection import sites

    options["dials"] = dict(map(_dial, dials))
    source = sites.Posed(scenes or sites.SCENES, seeds, profile)
    options["report"] = lambda file: say(file, err=as_json)
    files = usage_errors(lambda: sites.make_maps(source, out, **options))
    return answer({"maps": [str(file) for file in files]}, as_json, lambda _figures: None)
