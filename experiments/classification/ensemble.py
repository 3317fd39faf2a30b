"""`touchdown ensemble`: several networks as one, with its weights and limits."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from touchdown.experiments.classification.evaluate import Progress, top1
from touchdown.experiments.classification.image_folders import load_images, read_catalogue
from touchdown.experiments.classification.optional_import import training_libraries
from touchdown.experiments.classification.quantize import with_fitted_limits
from touchdown.experiments.errors import UsageError
from touchdown.landing.classification.engine import OnnxClassifier, all_scores, miss_cost_logs
from touchdown.landing.classification.weights import SUFFIX, NetworkFacts

_NAME = 64
"""characters"""
_MAX_MEMBERS = 8


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
    _check(networks, out, weights)
    with training_libraries():
        from touchdown.landing.classification.learning import ensemble
    members = [OnnxClassifier(path) for path in networks]
    first = members[0].facts
    for path, member in zip(networks, members, strict=True):
        _check_alike(first, member.facts, path.name)
    facts = dataclasses.replace(
        first,
        network="+".join(member.facts.network for member in members)[:_NAME],
        miss_costs=tuple(miss_costs) or first.miss_costs,
    )
    catalogues = [read_catalogue(argument, facts.labels) for argument in data]
    shown = load_images(catalogues, "val", facts.labels, facts.image_size, progress, others=True)
    found = [
        all_scores(member, shown.images, progress) - miss_cost_logs(member.facts)
        for member in members
    ]
    known = shown.labels >= 0
    chosen = (
        np.array(weights, np.float64)
        if weights
        else ensemble.fitted_weights([scores[known] for scores in found], shown.labels[known])
    )
    ensemble.write_ensemble(out, networks, chosen.tolist(), facts)
    together = all_scores(OnnxClassifier(out), shown.images, progress)
    decision = with_fitted_limits(out, facts, together, shown.labels, false_safe, confidence)
    return {
        "ensemble_file": str(out),
        "networks": [path.name for path in networks],
        "weights": chosen.tolist(),
        "pictures": len(shown.labels),
        "top1_alone": [top1(scores, shown.labels) for scores in found],
        "top1": top1(together, shown.labels),
        "decision": decision,
    }


def _check(networks: Sequence[Path], out: Path, weights: Sequence[float]) -> None:
    if out.suffix != SUFFIX or out.is_dir():
        raise UsageError(f"--out: '{out}' is no network's file: give a name that ends in {SUFFIX}")
    if not 2 <= len(networks) <= _MAX_MEMBERS:
        raise UsageError(f"{len(networks)} networks given, 2 to {_MAX_MEMBERS} needed")
    if weights and len(weights) != len(networks):
        raise UsageError(f"--weight: {len(weights)} given for {len(networks)} networks")
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
