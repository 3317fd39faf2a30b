"""`touchdown quantize` and `touchdown ensemble`: networks made of trained ones, with the limits at
which ground counts as safe refitted to validation images."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from touchdown.experiments.classification.evaluate import (
    Progress,
    load_classifier,
    top1,
    training_libraries,
)
from touchdown.experiments.classification.image_folders import load_images, read_catalogue
from touchdown.experiments.errors import UsageError
from touchdown.landing.api import LabelledImages
from touchdown.landing.classification import onboard
from touchdown.landing.classification.decision import decision_summary, fitted_limits
from touchdown.landing.classification.engine import OnnxClassifier, all_scores, miss_cost_logs
from touchdown.landing.classification.weights import SUFFIX, NetworkFacts

_RANGE_IMAGES = 256
"""number of training images, evenly spread, that give the ranges of int8 activations"""
_NAME = 64
"""characters"""
_MAX_MEMBERS = 8


def quantize_network(
    network: Path | None,
    out: Path,
    data: Sequence[str],
    weight_type: str,
    progress: Progress,
    false_safe: float,
    confidence: float,
) -> dict[str, Any]:
    """Writes ``network``, or the shipped one, with weights of ``weight_type`` to ``out``, and its
    checksum. Returns top-1 on the validation images before and after.

    ``false_safe``, ``confidence``: see `fitted_limits`. Raises UsageError and ValueError for bad
    input, before anything is written."""
    network = network or onboard.SHIPPED
    _check_target(out, [network])
    with training_libraries():
        from touchdown.landing.classification.learning import export
    before = load_classifier(network)
    facts = before.facts
    catalogues = [read_catalogue(argument, facts.labels) for argument in data]
    train = load_images(catalogues, "train", facts.labels, facts.image_size, progress)
    val = load_images(catalogues, "val", facts.labels, facts.image_size, progress, others=True)
    count = len(train.labels)
    spread = np.linspace(0, count - 1, min(_RANGE_IMAGES, count)).astype(int)
    out.parent.mkdir(parents=True, exist_ok=True)
    export.write_variant(network, out, weight_type, train.images[spread])
    return {
        "network_file": str(out),
        "weight_type": weight_type,
        "pictures": len(val.labels),
        "top1_before": top1(all_scores(before, val.images, progress), val.labels),
        **_with_fitted_limits(out, facts, val, progress, false_safe, confidence),
        "bytes": out.stat().st_size,
    }


def make_ensemble(
    networks: Sequence[Path],
    out: Path,
    data: Sequence[str],
    progress: Progress,
    *,
    weights: Sequence[float] = (),
    miss_costs: Sequence[tuple[str, float]] = (),
    false_safe: float,
    confidence: float,
) -> dict[str, Any]:
    """Writes ``out``, one network of ``networks``, and its checksum. Returns weights, and top-1 on
    the validation images of each network and of all.

    Without ``weights`` they are fitted to the validation images (`fitted_weights`); without
    ``miss_costs`` they are those of the first network. ``false_safe``, ``confidence``: see
    `fitted_limits`. Raises UsageError and ValueError for bad input, before anything is written."""
    _check_target(out, networks)
    if not 2 <= len(networks) <= _MAX_MEMBERS:
        raise UsageError(f"{len(networks)} networks given, 2 to {_MAX_MEMBERS} needed")
    if weights and len(weights) != len(networks):
        raise UsageError(f"--weight: {len(weights)} given for {len(networks)} networks")
    with training_libraries():
        from touchdown.landing.classification.learning import ensemble
    members = [OnnxClassifier(path) for path in networks]
    first = members[0].facts
    for path, member in zip(networks, members, strict=True):
        _check_alike(first, member.facts, path.name)
    facts = replace(
        first,
        network="+".join(member.facts.network for member in members)[:_NAME],
        miss_costs=tuple(miss_costs) or first.miss_costs,
    )
    catalogues = [read_catalogue(argument, facts.labels) for argument in data]
    val = load_images(catalogues, "val", facts.labels, facts.image_size, progress, others=True)
    found = [
        all_scores(member, val.images, progress) - miss_cost_logs(member.facts)
        for member in members
    ]
    known = val.labels >= 0
    chosen = (
        np.array(weights, np.float64)
        if weights
        else ensemble.fitted_weights([scores[known] for scores in found], val.labels[known])
    )
    ensemble.write_ensemble(out, networks, chosen.tolist(), facts)
    return {
        "ensemble_file": str(out),
        "networks": [path.name for path in networks],
        "weights": chosen.tolist(),
        "pictures": len(val.labels),
        "top1_alone": [top1(scores, val.labels) for scores in found],
        **_with_fitted_limits(out, facts, val, progress, false_safe, confidence),
    }


def _check_target(out: Path, networks: Sequence[Path]) -> None:
    """Raises UsageError where a network cannot be written to ``out``."""
    if out.suffix != SUFFIX or out.is_dir():
        raise UsageError(f"--out: '{out}' is no network's file: give a name that ends in {SUFFIX}")
    if out.resolve() in [network.resolve() for network in networks]:
        raise UsageError(f"--out: '{out}' is one of the networks: give another name")


def _check_alike(first: NetworkFacts, other: NetworkFacts, name: str) -> None:
    """Raises UsageError where two networks differ in their classes or the size of their images."""
    if (other.labels, other.classes) != (first.labels, first.classes):
        raise UsageError(
            f"'{name}' predicts the classes of '{other.labels}', the first network those of "
            f"'{first.labels}'"
        )
    if other.image_size != first.image_size:
        raise UsageError(
            f"'{name}' sees images of {other.image_size} pixels, the first network of "
            f"{first.image_size}"
        )


def _with_fitted_limits(
    network: Path,
    facts: NetworkFacts,
    val: LabelledImages,
    progress: Progress,
    false_safe: float,
    confidence: float,
) -> dict[str, Any]:
    """Fits the limits of a network's file to validation images and writes them into it. Returns
    its top-1 and the `decision_summary`; None for classes other than those of D_Land."""
    from touchdown.landing.classification.learning.export import with_facts

    scores = all_scores(load_classifier(network), val.images, progress)
    decision = None
    if facts.labels == "d_land":
        limits = fitted_limits(scores, val.labels, false_safe, confidence)
        with_facts(network, replace(facts, limits=limits))
        decision = decision_summary(scores, val.labels, limits)
    return {"top1": top1(scores, val.labels), "decision": decision}
