"""``touchdown edges``: the structured edge detector of the estimator `zou2024`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from touchdown.experiments.cli.common import (
    EXIT_DONE,
    JSON,
    PATH,
    QUIET,
    SEED,
    CommandGroup,
    answer,
)
from touchdown.experiments.errors import usage_errors
from touchdown.experiments.terminal import make_console, make_notes, make_table, say


@click.group(cls=CommandGroup)
def edges() -> None:
    """Score the edge detector of the estimator `zou2024`, and draw its output.

    Example: touchdown edges evaluate
    """


@edges.command("evaluate")
@click.option("--model", default="shipped", show_default=True,
              help="`shipped`, `gradient`, or a file in OpenCV's form.")  # fmt: skip
@click.option("--seeds", type=click.IntRange(1), default=5, show_default=True)
@click.option("--plot", type=PATH, help="Precision over recall, JPG or PNG.")
@JSON
@QUIET
def edges_evaluate(model: str, seeds: int, plot: Path | None, as_json: bool, quiet: bool) -> int:
    """Score the detector beside Canny on scenes and seeds that it was not trained on.

    Canny gets the blur and the threshold that suit these very pictures best.

    Example: touchdown edges evaluate --seeds 3 --plot edges.png
    """
    from touchdown.experiments.edges.evaluate import evaluate
    from touchdown.experiments.edges.figures import plot_curves

    report = usage_errors(lambda: evaluate(model, seeds, make_notes(quiet)))
    if plot is not None:
        plot_curves(plot, report)
    return answer(report, as_json, print_scores)


@edges.command("picture")
@click.option("--out", type=PATH, default=Path("edge-pictures"),
              show_default=True, help="Folder for edges.jpg and smoothness.jpg.")  # fmt: skip
@click.option("--seed", type=SEED, default=0, show_default=True)
@click.option("--model", default="shipped", show_default=True)
@QUIET
def edges_picture(out: Path, seed: int, model: str, quiet: bool) -> int:
    """Draw the edge energy beside Canny and the truth, and the smoothness of the estimator.

    Example: touchdown edges picture --out edge-pictures
    """
    from touchdown.experiments.edges.figures import draw_figures

    for path in usage_errors(lambda: draw_figures(out, seed, model, make_notes(quiet))):
        say(str(path))
    return EXIT_DONE


def print_scores(report: Mapping[str, Any]) -> None:
    from touchdown.experiments.edges.figures import DETECTOR_LABELS

    scenes = list(next(iter(report["scenes"].values())))
    heads = ("ODS", "OIS", "AP", "precision", "recall", *(f"ODS {scene}" for scene in scenes))
    table = make_table(f"{report['pictures']} pictures", "", *heads)
    for name, row in report["detectors"].items():
        figures = [*row.values(), *report["scenes"][name].values()]
        table.add_row(DETECTOR_LABELS.get(name, name), *(f"{figure:.3f}" for figure in figures))
    setting = report["canny_setting"]
    console = make_console()
    console.print(table)
    console.print(
        f"Canny at its best: blur {setting['sigma_px']:.1f} px, threshold "
        f"{setting['threshold']:.0f}"
    )
    console.print(f"ODS above Canny's: {report['ods_above_canny']:+.3f}")
    console.print(f"one picture: {report['detect_ms']:.1f} ms of one core")
