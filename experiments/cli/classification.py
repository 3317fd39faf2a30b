"""Ground classification: ``touchdown dataset``, ``train``, ``evaluate``, ``quantize``,
``ensemble``, ``classify``."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import click

from touchdown.experiments.cli.common import (
    OVERRIDES,
    PATH,
    QUIET,
    SEED,
    SEEDS,
    CommandGroup,
    Number,
    Parsed,
    answered,
)
from touchdown.experiments.terminal import make_notes, progress_bar, say

SCHEMES = ("d_land", "d_scene")
"""Keys of `landing.classification.labels.SCHEMES`, repeated to keep `--help` fast."""


def _cost(text: str) -> tuple[str, float]:
    """``water=10`` as ("water", 10.0); the class is checked once the labels are known."""
    name, equals, number = text.partition("=")
    if not equals or not 0.0 < float(number) < math.inf:
        raise ValueError
    return name.strip(), float(number)


_DATA = click.option(
    "--data", multiple=True, required=True, metavar="[KIND=]DIR",
    help="Of `touchdown dataset render`, UC Merced, AID, Places365, or folders named as the "
    "classes of D_Land; aerial=, caliterra= and textures= for such folders of photographs. May be "
    "repeated.",
)  # fmt: skip
_LEFT_OUT = click.option(
    "--left-out", multiple=True, metavar="SOURCE",
    help="Photographs of this source are all for the test. May be repeated.",
)  # fmt: skip
_FALSE_SAFE = click.option(
    "--false-safe", type=Number(0.0, 1.0), default=0.01, show_default=True,
    help="Fraction of unsafe ground that may count as safe.",
)  # fmt: skip
_CONFIDENCE = click.option(
    "--confidence", type=Number(0.0, 1.0, max_open=True), default=0.95, show_default=True,
    help="That the fraction is not larger.",
)  # fmt: skip
_NETWORK = click.argument("network", required=False, type=PATH)
_NETWORK_OUT = click.option("--out", type=PATH, required=True, help="A file *.onnx.")


def _miss_cost(default: str) -> Callable[[Any], Any]:
    return click.option(
        "--miss-cost", "miss_costs", multiple=True,
        type=Parsed("CLASS=K", "with K above 0, such as water=10", _cost),
        help="Cost of predicting another class for CLASS, relative to any other error, such as "
        f"water=10. May be repeated.  {default}",
    )  # fmt: skip


def _fraction(name: str, help_text: str, maximum: float = 1.0) -> Callable[[Any], Any]:
    return click.option(
        name, type=Number(0.0, maximum), default=0.0, show_default=True, help=help_text
    )


def _threads(default: int | None, shown: str = "") -> Callable[[Any], Any]:
    return click.option("--threads", type=click.IntRange(1), default=default, show_default=True,
                        help=f"Of the processor.{shown}")  # fmt: skip


@click.group(cls=CommandGroup)
def dataset() -> None:
    """Labelled images of ground for training.

    Example: touchdown dataset render --out patches --images 4000
    """


def _print_dataset(done: Mapping[str, Any]) -> None:
    for kind in ("classes", "splits"):
        say("  ".join(f"{name} {count}" for name, count in done[kind].items()))
    say(f"written: {done['directory']} ({done['images']} images)")


@dataset.command("render")
@click.option("--out", type=PATH, required=True, help="A new folder.")
@click.option("--images", type=click.IntRange(1, 10_000_000), default=4000, show_default=True)
@click.option("--seed", type=SEEDS, default=0, show_default=True,
              help="Of layouts, poses and light; scene seeds start at 1000.")  # fmt: skip
@click.option("--scene", "scenes", multiple=True, metavar="NAME",
              help="Only this scene. May be repeated.  [all]")  # fmt: skip
@click.option("--per-seed", type=click.IntRange(1), default=40, show_default=True,
              help="Images of each seed of a scene.")  # fmt: skip
@_fraction("--new-colours", "Fraction of views with random colours of roads, paving, roofs …")
@_fraction("--new-materials", "Fraction of seeds whose ground is of other materials of its class.")
@OVERRIDES
@click.option("--jobs", type=click.IntRange(1), default=1, show_default=True,
              help="Processes; the images do not depend on it.")  # fmt: skip
@answered(_print_dataset)
@QUIET
def dataset_render(
    out: Path, jobs: int, quiet: bool, overrides: tuple[str, ...], **options: Any
) -> dict[str, Any]:
    """Render patches of the scenes by the vehicle's camera, labelled by the class of their ground.

    Heights from 5 to 60 m, squares of ground from 3 to 26 m, random light, blur and noise. Writes
    PNG files by scene and seed, manifest.csv with both labels and the split, and a contact sheet.

    Example: touchdown dataset render --out patches --images 4000 --jobs 2
    """
    from touchdown.experiments.classification.render_dataset import DatasetParams, render_dataset

    with progress_bar(quiet) as progress:
        params = DatasetParams(settings=overrides, **options)
        return render_dataset(out, params, jobs=jobs, progress=progress)


def _print_training(report: Mapping[str, Any]) -> None:
    best = report["validation"]
    say(
        f"best epoch {report['best_epoch']} of {report['epochs']}: validation top-1 "
        f"{best['val_top1']:.3f}, macro F1 {best['val_macro_f1']:.3f}\n"
        f"written, validation top-1 {report['written']['top1']:.3f}: "
        f"{report['network_file']} ({report['bytes'] / 1e6:.1f} MB)"
    )


@click.command()
@click.option("--network", default="resnet50_cbam", show_default=True,
              help="resnet18, resnet34, resnet50, resnet101, resnet50_cbam, resnext50, vgg19, "
              "mobilenet_v3_large, inception_v4 or efficientnet_lite0.")  # fmt: skip
@click.option("--labels", type=click.Choice(SCHEMES), default="d_land", show_default=True)
@_DATA
@click.option("--out", type=PATH, required=True,
              help="Folder; an interrupted training in it is resumed.")  # fmt: skip
@click.option("--start-from", "start", type=PATH, metavar="PATH",
              help="Folder of another training, or a network's file, with the initial "
              "weights, or imagenet for those of efficientnet_lite0.  [random]")  # fmt: skip
@click.option("--teacher", "teachers", metavar="FILE", multiple=True,
              help="A network to learn from, too. May be repeated.")  # fmt: skip
@click.option("--epochs", type=click.IntRange(1), default=30, show_default=True)
@click.option("--image-size", type=click.IntRange(32, 512), default=96, show_default=True,
              help="Side of the network's input, pixels.")  # fmt: skip
@click.option("--batch-size", type=click.IntRange(2), default=64, show_default=True)
@click.option("--learning-rate", type=Number(0.0, min_open=True), default=1e-3, show_default=True)
@click.option("--variation", type=Number(0.0, 2.0), default=1.0, show_default=True,
              help="Strength of the augmentation of zoom, light, colour and noise.")  # fmt: skip
@_fraction("--markings", "Fraction of images with painted lines, as of lanes and bays.")
@_fraction("--colours", "Fraction of images of another colour: not of plants.")
@_fraction("--textures", "Fraction of images with a photographed texture of their class.")
@_fraction(
    "--weather", "Fraction of coarse, hazy, wet, snowy, shaded, over- and underexposed images.", 2
)
@click.option("--frozen", type=click.IntRange(0), default=0, show_default=True,
              help="First layers that keep the weights of --start-from.")  # fmt: skip
@_LEFT_OUT
@_miss_cost("[1 each]")
@click.option("--patience", type=click.IntRange(1), default=8, show_default=True,
              help="Epochs without a better validation score before training ends.")  # fmt: skip
@SEED
@click.option("--device", default="auto", show_default=True, help="auto, cpu or cuda.")
@_threads(None, "  [all]")
@answered(_print_training)
@QUIET
def train(
    data: tuple[str, ...],
    out: Path,
    start: Path | None,
    device: str,
    threads: int | None,
    quiet: bool,
    **options: Any,
) -> dict[str, Any]:
    """Train a network to classify ground.

    Writes network.onnx (float16 weights) and its checksum, curves.csv, curves.rrd for the Rerun
    viewer, training.json, and after every epoch a checkpoint, from which the same command resumes.
    Ends early when the validation score no longer improves.

    Example: touchdown train --data patches --out trained --epochs 20
    """
    from touchdown.experiments.classification.evaluate import training_libraries
    from touchdown.experiments.classification.train import train_network

    if threads is not None:
        with training_libraries():
            import torch
        torch.set_num_threads(threads)
    with progress_bar(quiet) as progress:
        return train_network(data, out, options, device, progress, make_notes(quiet), start=start)


def _print_scores(report: Mapping[str, Any]) -> None:
    from touchdown.experiments.classification.evaluate import print_evaluation

    print_evaluation(report)


@click.command()
@_NETWORK
@_DATA
@click.option("--split", type=click.Choice(("train", "val", "test")), default="test",
              show_default=True)  # fmt: skip
@_miss_cost("[those of the file, which its limits are fitted to]")
@_threads(1)
@click.option("--cost/--no-cost", "measure", default=True, show_default=True,
              help="Measure RAM and run time in a process of its own.")  # fmt: skip
@_LEFT_OUT
@click.option("--reliability", "diagram", type=PATH, metavar="PNG",
              help="Write reliability diagrams.")  # fmt: skip
@answered(_print_scores)
@QUIET
def evaluate(
    network: Path | None, data: tuple[str, ...], split: str, quiet: bool, **options: Any
) -> dict[str, Any]:
    """Score NETWORK, a file of `touchdown train`, on images that it was not trained on.

    Without NETWORK: the one that is shipped with touchdown.

    Loss, macro F1, recall, top-1 with its interval, calibration error (ECE), confusion matrix; size
    of the file (ROM), peak memory (RAM) and time an image.

    Example: touchdown evaluate trained/network.onnx --data patches
    """
    from touchdown.experiments.classification.evaluate import EvaluateParams, evaluate_network

    params = EvaluateParams(**options)
    with progress_bar(quiet) as progress:
        return evaluate_network(network, data, split, progress, options=params)


def _print_quantized(report: Mapping[str, Any]) -> None:
    say(
        f"validation top-1 {report['top1_before']:.4f} before, {report['top1']:.4f} after\n"
        f"written: {report['network_file']} ({report['bytes'] / 1e6:.1f} MB)"
    )


@click.command()
@_NETWORK
@click.option("--type", "weight_type", type=click.Choice(("float16", "int8")), default="int8",
              show_default=True, help="Of the weights.")  # fmt: skip
@_DATA
@_NETWORK_OUT
@_FALSE_SAFE
@_CONFIDENCE
@answered(_print_quantized)
@QUIET
def quantize(quiet: bool, **options: Any) -> dict[str, Any]:
    """Write NETWORK, a file of `touchdown train`, with smaller weights.

    Without NETWORK: the one that is shipped with touchdown.

    int8 computes in int8 too; float16 is stored so and computed in float32. The limits at which
    ground counts as safe are refitted to the validation images. `touchdown evaluate` measures the
    result.

    Example: touchdown quantize trained/network.onnx --data patches --out network-int8.onnx
    """
    from touchdown.experiments.classification.derived import quantize_network

    with progress_bar(quiet) as progress:
        return quantize_network(progress=progress, **options)


def _print_ensemble(report: Mapping[str, Any]) -> None:
    from touchdown.experiments.classification.evaluate import decision_text

    rows = zip(report["networks"], report["weights"], report["top1_alone"], strict=True)
    for name, weight, top1 in rows:
        say(f"{name}: weight {weight:.3f}, validation top-1 {top1:.4f}")
    say(f"together {report['top1']:.4f}")
    if report["decision"] is not None:
        say(decision_text(report["decision"]))
    say(f"written: {report['ensemble_file']}")


@click.command()
@click.argument("networks", nargs=-1, required=True, type=PATH)
@_DATA
@_NETWORK_OUT
@click.option("--weight", "weights", type=Number(0.0, 4.0), multiple=True,
              help="Of a network's scores; once for each.  [fitted]")  # fmt: skip
@_miss_cost("[those of the first network]")
@_FALSE_SAFE
@_CONFIDENCE
@answered(_print_ensemble)
@QUIET
def ensemble(quiet: bool, **options: Any) -> dict[str, Any]:
    """Join several NETWORKS, files of `touchdown train` for images of one size, in one file.

    Their log-probabilities are added with weights that fit the validation images best, and the
    limits at which ground counts as safe are fitted to the same images. Whether an image lies far
    from the training data is asked of the first network.

    Example: touchdown ensemble small.onnx large.onnx --data patches --out both.onnx
    """
    from touchdown.experiments.classification.derived import make_ensemble

    with progress_bar(quiet) as progress:
        return make_ensemble(progress=progress, **options)


def _print_classes(report: Mapping[str, Any]) -> None:
    for row in report["pictures"]:
        fractions = "  ".join(f"{name} {fraction:.0%}" for name, fraction in row["shares"].items())
        say(f"{row['classes']}: {fractions}")


@click.command()
@click.argument("images", nargs=-1, required=True, type=PATH)
@click.option("--network", type=PATH,
              help="A file of `touchdown train`.  [the shipped one]")  # fmt: skip
@click.option("--out", type=PATH, default=Path("classes"), show_default=True,
              help="Folder for NAME-classes.png.")  # fmt: skip
@click.option("--window", "window_px", type=click.IntRange(16),
              help="Side of the classified square.  [a quarter of the image]")  # fmt: skip
@click.option("--least", "minimum", type=Number(0.0, 1.0), default=0.5, show_default=True,
              help="Probability below which the class is unsure.")  # fmt: skip
@_threads(1)
@answered(_print_classes)
@QUIET
def classify(
    images: tuple[Path, ...], network: Path | None, threads: int, quiet: bool, **options: Any
) -> dict[str, Any]:
    """Draw the classes of ground over aerial photographs.

    A window slides over each image; the predictions of overlapping windows are averaged.

    Example: touchdown classify photograph.jpg --network trained/network.onnx
    """
    from touchdown.experiments.classification.class_map import classify_images
    from touchdown.experiments.classification.evaluate import load_classifier

    classifier = load_classifier(network, threads)
    rows = classify_images(images, classifier=classifier, notes=make_notes(quiet), **options)
    return {"pictures": rows}
