"""The command group `touchdown scenes`."""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from touchdown.experiments.cli.common import (
    JSON,
    LIGHT,
    OVERRIDES,
    PATH,
    QUIET,
    SCENES,
    SEED,
    CommandGroup,
    Number,
    answer,
)
from touchdown.experiments.cli.console import print_place, print_scene_check
from touchdown.experiments.errors import usage_errors
from touchdown.experiments.terminal import make_notes, say
from touchdown.scenes.api import Light, short_name

VIEW_NAMES = ("above", "oblique", "camera", "depth", "lidar", "height", "slope", "class", "safe")
"""Keys of `experiments.scene_tools.views.VIEWS`, repeated so that help is instant."""


@click.group(cls=CommandGroup)
def scenes() -> None:
    """Scenes: names, images, MJCF, checks, import of elevation models.

    Example: touchdown scenes list
    """


@scenes.command("list")
@JSON
def scenes_list(as_json: bool) -> int:
    """Print the names of the scenes.

    Example: touchdown scenes list
    """
    from touchdown.scenes.registry import scene_names

    return answer({"scenes": scene_names()}, as_json, lambda found: say("\n".join(found["scenes"])))


@scenes.command("render")
@click.argument("scene", required=False, shell_complete=SCENES)
@click.option("--all", "every_scene", is_flag=True, help="Every view of every scene.")
@click.option("--all-views", is_flag=True, help="Every view of SCENE.")
@click.option("--out", type=PATH,
              help="PNG file, or directory for several.  [SCENE-VIEW.png, SCENE-SEED, "
              "scenes-SEED]")  # fmt: skip
@SEED
@click.option("--view", type=click.Choice(VIEW_NAMES), default="above", show_default=True,
              help="From above or from a corner; the camera, its depth and one second of LIDAR "
              "(coloured by intensity) from 30 m above the take-off; the true height, slope, class "
              "and safe ground.")  # fmt: skip
@click.option("--light", type=LIGHT, default="day", show_default=True, help="Light of the scene.")
@OVERRIDES
@JSON
@QUIET
def scenes_render(
    scene: str | None,
    every_scene: bool,
    all_views: bool,
    out: Path | None,
    seed: int,
    view: str,
    light: Light,
    overrides: tuple[str, ...],
    **flags: bool,
) -> int:
    """Write an image of a scene, or all images of one or of every scene.

    --all writes DIR/SCENE/VIEW.png and DIR/contact_sheet.png; --all-views writes DIR/VIEW.png.

    Example: touchdown scenes render crossroad --view oblique --out crossroad.png
    """
    if every_scene == (scene is not None):
        raise click.UsageError("give either SCENE or --all")
    from touchdown.experiments.scene_tools import render as scene_tools

    if every_scene:
        folder = out or Path(f"scenes-{seed}")
        notes = make_notes(flags["quiet"])
        sheet = scene_tools.render_every_scene(seed, folder, notes, light)
        done = {"directory": str(folder), "contact_sheet": str(sheet)}
    elif scene is not None and all_views:
        folder = out or Path(f"{short_name(scene)}-{seed}")
        scene_tools.render_all_views(scene, seed, folder, light, overrides)
        done = {"directory": str(folder)}
    else:
        target = out or Path(f"{short_name(scene or '')}-{view}.png")
        scene_tools.render_view(scene or "", seed, view, target, light, overrides)
        done = {"picture": str(target)}
    return _written(done, flags["as_json"])


@scenes.command("check")
@click.argument("names", nargs=-1, metavar="[SCENE]...")
@click.option("--seeds", type=click.IntRange(1), default=25, show_default=True,
              help="Seeds of a named scene; a file has none.")  # fmt: skip
@OVERRIDES
@click.option("--as-is", is_flag=True, default=None, help="Check a file as it is.")
@click.option("--classes", metavar="FILE",
              help="Classes of a file's geoms: TOML by name, or a PNG from above.")  # fmt: skip
@JSON
@QUIET
def scenes_check(
    names: tuple[str, ...], seeds: int, overrides: tuple[str, ...], as_json: bool, quiet: bool,
    **more: Any,
) -> int:  # fmt: skip
    """Check that seeds of scenes (all, unless named) build, differ and offer safe ground.

    Exit code 1 when a seed does not build or two seeds of a scene are equal. Seeds without a safe
    site under the survey are named.

    An MJCF file is checked for a flight, as it is flown: take-off spot, ground under the survey,
    fraction of safe ground, classes that are guessed. Exit code 1 when it cannot be flown, with the
    reason and the keys that would change it.

    Example: touchdown scenes check crossroad --seeds 5
    """
    from touchdown.experiments.scene_tools.flyability import (
        check_scene,
        check_scene_file,
        passed,
    )
    from touchdown.scenes.registry import scene_names

    known = scene_names()
    chosen = names or tuple(known)
    places = [check_scene_file(name, overrides, **more) for name in chosen if name not in known]
    notes = make_notes(quiet)
    rows = [check_scene(name, seeds, notes, overrides) for name in chosen if name in known]

    def show(_figures: Mapping[str, Any]) -> None:
        for place in places:
            print_place(place)
        if rows:
            print_scene_check(rows)

    good = passed(rows) and not any(place["problems"] for place in places)
    return answer({"scenes": rows, "places": places}, as_json, show, good=good)


@scenes.command("export")
@click.argument("scene", shell_complete=SCENES)
@click.option("--out", type=PATH, help="Directory.  [SCENE-SEED]")
@SEED
@JSON
def scenes_export(scene: str, out: Path | None, seed: int, as_json: bool) -> int:
    """Write a scene's MJCF with its assets, to open in MuJoCo's own viewer.

    Example: touchdown scenes export crossroad --out crossroad &&
    python -m mujoco.viewer --mjcf=crossroad/scene.xml
    """
    from touchdown.experiments.scene_tools.render import export_scene_files

    target = out or Path(f"{short_name(scene)}-{seed}")
    model_file = export_scene_files(scene, seed, target)
    return _written({"mjcf": str(model_file)}, as_json)


@scenes.command("import-dem")
@click.argument("dem", type=PATH)
@click.argument("out", type=PATH)
@click.option("--ortho", type=PATH,
              help="Aerial image of that extent, or a GeoTIFF.  [relief in colours]")  # fmt: skip
@click.option("--cell", "cell_m", type=Number(), metavar="M", help="Node spacing.  [the model's]")
@click.option("--window", "window_m", type=Number(), default=200.0, show_default=True, metavar="M",
              help="Side of the square that is cut out.")  # fmt: skip
@click.option("--centre", "centre_m", nargs=2, type=Number(), metavar="E N",
              help="Its centre, metres from the south-west corner.  [the middle]")  # fmt: skip
@click.option("--class", "land_class", default="field", show_default=True,
              help="Land class of the ground.")  # fmt: skip
@JSON
def scenes_import_dem(dem: Path, out: Path, as_json: bool, **options: Any) -> int:
    """Make a scene of DEM, a GeoTIFF of heights, in the new folder OUT.

    Example: touchdown scenes import-dem hill.tif --ortho hill.png hill &&
    touchdown land hill/scene.xml
    """
    from touchdown.scenes.importers.dem import import_dem

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        model_file = usage_errors(lambda: import_dem(dem, out, **options))
    for warning in caught:
        say(f"touchdown: {warning.message}", err=True)
    return _written({"mjcf": str(model_file)}, as_json)


def _written(done: Mapping[str, str], as_json: bool) -> int:
    """Prints the paths of what was written."""
    return answer(done, as_json, lambda done: say("\n".join(done.values())))
