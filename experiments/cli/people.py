"""The network that finds people: ``touchdown people``."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from touchdown.experiments.cli.common import (
    LIGHT,
    OVERRIDES,
    PATH,
    QUIET,
    SEED,
    CommandGroup,
    Number,
    answered,
)
from touchdown.experiments.terminal import progress_bar, say


@click.group(cls=CommandGroup)
def people() -> None:
    """The network with which the watch finds people in images.

    Example: touchdown people evaluate people.onnx --data people/held
    """


def _print_images(done: Mapping[str, Any]) -> None:
    say(f"written: {done['file']} ({done['images']} images)")


@people.command("render")
@click.argument("scene")
@click.option("--out", type=PATH, required=True, help="A folder; a file of images is added.")
@click.option("--light", type=LIGHT, default="day", show_default=True)
@click.option("--images", type=click.IntRange(1, 100_000), default=100, show_default=True)
@click.option("--other-clothes", is_flag=True, help="Colours that nobody wears in the scenes.")
@SEED
@OVERRIDES
@answered(_print_images)
def people_render(
    scene: str, out: Path, light: str, images: int, other_clothes: bool, seed: int,
    overrides: tuple[str, ...],
) -> dict[str, Any]:  # fmt: skip
    """Render a scene's crowd by the vehicle's camera, from 1.5 m to 15 m up, with boxes.

    Example: touchdown people render crossroad --out people/train --seed 500
    """
    from touchdown.experiments.people.images import rendered, write_images
    from touchdown.scenes.api import short_name

    what = "-".join([short_name(scene), *(text.partition("=")[2] for text in overrides)])
    file = out / f"{what}-{seed}-{light}.npz"
    made = rendered(scene, seed, light, images, overrides, other_clothes=other_clothes)
    return {"file": str(file), "images": write_images(file, made)}


def _print_trained(done: Mapping[str, Any]) -> None:
    say(f"written: {done['network']} (loss {done['loss']:.3f}, {done['images']} images)")


@people.command("train")
@click.option("--data", type=PATH, required=True, help="Of `touchdown people render`.")
@click.option("--out", type=PATH, required=True, help="A file *.onnx.")
@click.option("--epochs", type=click.IntRange(1), default=20, show_default=True)
@SEED
@answered(_print_trained)
@QUIET
def people_train(data: Path, out: Path, epochs: int, seed: int, quiet: bool) -> dict[str, Any]:
    """Train the network anew.

    Example: touchdown people train --data people/train --out people.onnx
    """
    from touchdown.experiments.people.images import read_images
    from touchdown.experiments.people.learning.network import export, train

    found = list(read_images(data))
    losses: list[float] = []
    with progress_bar(quiet) as progress:

        def report(epoch: int, loss: float) -> None:
            losses.append(loss)
            progress(epoch + 1, epochs, f"loss {loss:.3f}")

        network = train(found, epochs, seed, report)
    export(network, out)
    return {"network": str(out), "loss": losses[-1], "images": len(found)}


def _print_figures(done: Mapping[str, Any]) -> None:
    say(f"{done['images']} images, {done['false_boxes']:.1f} false boxes in a hundred images, "
        f"{done['ms']:.1f} ms an image")  # fmt: skip
    for row in done["rows"]:
        part = 100.0 * row["found"] / row["there"]
        say(f"{row['what']:>18}: {row['found']} of {row['there']} found, {part:.1f} %")


@people.command("evaluate")
@click.argument("network", type=PATH)
@click.option("--data", type=PATH, required=True, help="Of `touchdown people render`.")
@click.option("--least-score", type=Number(0.0, 1.0), default=None,
              help="[that of flights]")  # fmt: skip
@answered(_print_figures)
def people_evaluate(network: Path, data: Path, least_score: float | None) -> dict[str, Any]:
    """Recall of people and animals by posture, light and distance, and false boxes.

    Example: touchdown people evaluate people.onnx --data people/held
    """
    from touchdown.experiments.people.figures import measured, summary
    from touchdown.experiments.people.images import read_images
    from touchdown.landing.watch.people import LEAST, PeopleDetector

    least = LEAST if least_score is None else least_score
    detector = PeopleDetector(network, least_score=least)
    return summary(measured(detector, read_images(data)), least)
