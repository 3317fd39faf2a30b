"""`touchdown quantize`: a network's file with smaller weights and refitted limits."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from touchdown.experiments.classification.evaluate import Progress, all_scores, load_classifier
from touchdown.experiments.classification.image_folders import load_images, read_catalogue
from touchdown.experiments.classification.optional_import import training_libraries
from touchdown.experiments.errors import UsageError
from touchdown.landing.classification.decision import (
    CONFIDENCE,
    FALSE_SAFE,
    decision_summary,
    fitted_limits,
)


def quantize_network(
    network: Path,
    out: Path,
    data: Sequence[str],
    weight_type: str,
    pictures: int,
    progress: Progress,
    false_safe: float = FALSE_SAFE,
    confidence: float = CONFIDENCE,
) -> dict[str, Any]:
    """Writes ``out`` and its checksum. Returns top-1 on the validation images before and after.

    ``pictures``: number of images of the training split, evenly spread, that give the ranges of
    int8 activations. ``false_safe``, ``confidence``: see `fitted_limits`.
    Raises UsageError and ValueError for bad input, before anything is written.
    """
    if out.suffix != ".onnx" or out.is_dir():
        raise UsageError(f"--out: '{out}' is not a network's file: give a name that ends in .onnx")
    if out.resolve() == network.resolve():
        raise UsageError(f"--out: '{out}' is the network itself: give another name")
    with training_libraries():
        from touchdown.landing.classification.learning import variants
    before = load_classifier(network, "onnx", 1)
    facts = before.facts
    catalogues = [read_catalogue(argument, facts.labels) for argument in data]
    train, val = (
        load_images(
            catalogues, split, facts.labels, facts.image_size, progress, others=split == "val"
        )
        for split in ("train", "val")
    )
    spread = np.linspace(0, len(train.labels) - 1, min(pictures, len(train.labels))).astype(int)
    out.parent.mkdir(parents=True, exist_ok=True)
    variants.write_variant(network, out, weight_type, train.images[spread])
    scores = all_scores(load_classifier(out, "onnx", 1), val, progress)
    if facts.labels == "d_land":
        limits = fitted_limits(scores, val.labels, false_safe, confidence)
        facts = dataclasses.replace(facts, limits=limits)
        variants.with_facts(out, facts)
    own = all_scores(before, val, progress)
    known = val.labels >= 0
    return {
        "network_file": str(out),
        "weight_type": weight_type,
        "bytes": out.stat().st_size,
        "pictures": len(val.labels),
        "top1_before": float((own.argmax(axis=1) == val.labels)[known].mean()),
        "top1": float((scores.argmax(axis=1) == val.labels)[known].mean()),
        "limits": facts.properties() if facts.labels == "d_land" else None,
        "decision": decision_summary(scores, val.labels, facts.limits)
        if facts.labels == "d_land"
        else None,
    }
