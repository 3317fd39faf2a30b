"""`touchdown quantize`: a network's file with smaller weights and refitted limits."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.classification.evaluate import Progress, load_classifier, top1
from touchdown.experiments.classification.image_folders import load_images, read_catalogue
from touchdown.experiments.classification.optional_import import training_libraries
from touchdown.experiments.errors import UsageError
from touchdown.landing.classification import onboard
from touchdown.landing.classification.decision import (
    CONFIDENCE,
    FALSE_SAFE,
    decision_summary,
    fitted_limits,
)
from touchdown.landing.classification.engine import all_scores
from touchdown.landing.classification.weights import SUFFIX, NetworkFacts

_RANGE_IMAGES = 256
"""number of training images, evenly spread, that give the ranges of int8 activations"""


def quantize_network(
    network: Path | None,
    out: Path,
    data: Sequence[str],
    weight_type: str,
    progress: Progress,
    false_safe: float = FALSE_SAFE,
    confidence: float = CONFIDENCE,
) -> dict[str, Any]:
    """Writes ``out`` and its checksum. Returns top-1 on the validation images before and after.

    ``false_safe``, ``confidence``: see `fitted_limits`. Raises UsageError and ValueError for bad
    input, before anything is written."""
    if out.suffix != SUFFIX or out.is_dir():
        raise UsageError(f"--out: '{out}' is not a network's file: give a name that ends in .onnx")
    network = network or onboard.SHIPPED
    if out.resolve() == network.resolve():
        raise UsageError(f"--out: '{out}' is the network itself: give another name")
    with training_libraries():
        from touchdown.landing.classification.learning import quantization
    before = load_classifier(network)
    facts = before.facts
    catalogues = [read_catalogue(argument, facts.labels) for argument in data]
    train, val = (
        load_images(
            catalogues, split, facts.labels, facts.image_size, progress, others=split == "val"
        )
        for split in ("train", "val")
    )
    count = len(train.labels)
    spread = np.linspace(0, count - 1, min(_RANGE_IMAGES, count)).astype(int)
    out.parent.mkdir(parents=True, exist_ok=True)
    quantization.write_variant(network, out, weight_type, train.images[spread])
    scores = all_scores(load_classifier(out), val.images, progress)
    return {
        "network_file": str(out),
        "weight_type": weight_type,
        "pictures": len(val.labels),
        "top1_before": top1(all_scores(before, val.images, progress), val.labels),
        "top1": top1(scores, val.labels),
        "decision": with_fitted_limits(out, facts, scores, val.labels, false_safe, confidence),
        "bytes": out.stat().st_size,
    }


def with_fitted_limits(
    network: Path,
    facts: NetworkFacts,
    scores: NDArray[np.float32],
    labels: NDArray[np.int64],
    false_safe: float,
    confidence: float,
) -> dict[str, Any] | None:
    """Fits the limits of a network's file to validation images and writes them into it. Returns the
    `decision_summary`; None for classes other than those of D_Land."""
    from touchdown.landing.classification.learning.quantization import with_facts

    if facts.labels != "d_land":
        return None
    limits = fitted_limits(scores, labels, false_safe, confidence)
    with_facts(network, dataclasses.replace(facts, limits=limits))
    return decision_summary(scores, labels, limits)
