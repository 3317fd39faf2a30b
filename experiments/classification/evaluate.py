"""`touchdown evaluate`: scores of a network on images that it was not trained on, and its cost."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from touchdown.experiments.classification.data_sets import HELD_OUT_SCENES
from touchdown.experiments.classification.footprint import measured_footprint
from touchdown.experiments.classification.image_folders import (
    Entry,
    entries_of,
    load_images,
    read_catalogue,
)
from touchdown.experiments.classification.optional_import import training_libraries
from touchdown.experiments.classification.reliability import draw_reliability, reliability
from touchdown.experiments.classification.train import of_classes
from touchdown.experiments.reporting.statistics import fraction_interval
from touchdown.landing.api import LabelledImages
from touchdown.landing.classification import onboard
from touchdown.landing.classification.decision import decision_summary
from touchdown.landing.classification.engine import OnnxClassifier, all_scores, comes_along
from touchdown.landing.classification.scores import fitted_temperature, summary
from touchdown.landing.classification.weights import NetworkFacts, weights_apart

Progress = Callable[[int, int, str], None]
_HEIGHTS_M = (0.0, 15.0, 25.0, 35.0, 60.0)


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
        "by_height": _by_height(scores, images.labels, entries_of(catalogues, split), facts),
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
    files = [network, *(weights_apart(network) if comes_along(network) else ())]
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


def _by_height(
    scores: Any, labels: Any, entries: Sequence[Entry], facts: NetworkFacts
) -> dict[str, dict[str, Any]]:
    """Returns the scores of rendered images by the height that they were seen from."""
    height_m = np.array([entry.height_m for entry in entries])
    found = {}
    for low, high in pairwise(_HEIGHTS_M):
        of = (height_m >= low) & (height_m < high)
        if of.any():
            found[f"{low:g} to {high:g} m"] = _summary(scores[of], labels[of], facts)
    return found


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
