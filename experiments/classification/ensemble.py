"""`touchdown ensemble`: several networks as one classifier, with its weights and limits."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from touchdown.experiments.classification.evaluate import Progress, all_scores
from touchdown.experiments.classification.image_folders import load_images, read_catalogue
from touchdown.experiments.errors import UsageError
from touchdown.landing.classification import ensemble as pool
from touchdown.landing.classification.decision import decision_summary, fitted_limits
from touchdown.landing.classification.engine import OnnxClassifier, miss_cost_logs
from touchdown.landing.classification.weights import NetworkFacts

_NAME = 64
"""characters"""


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
    """Writes ``out``, an ensemble of ``networks`` that lie beside it, and its checksum. Returns
    weights, and top-1 on the validation images of each network and of all.

    Without ``weights`` they are fitted to the validation images (`fitted_weights`); without
    ``miss_costs`` they are those of the first network. ``false_safe``, ``confidence``: see
    `fitted_limits`. Raises UsageError and ValueError for bad input, before anything is written."""
    _check(networks, out, weights)
    members = [OnnxClassifier(path) for path in networks]
    first = members[0].facts
    for path, member in zip(networks, members, strict=True):
        pool.check_classes(first, member.facts, path.name)
    facts = NetworkFacts(
        network="+".join(member.facts.network for member in members)[:_NAME],
        labels=first.labels,
        image_size=max(member.facts.image_size for member in members),
        classes=first.classes,
        miss_costs=tuple(miss_costs) or first.miss_costs,
    )
    catalogues = [read_catalogue(argument, facts.labels) for argument in data]
    shown = load_images(catalogues, "val", facts.labels, facts.image_size, progress, others=True)
    found = []
    for member in members:
        images = pool.scaled(shown.images, member.facts.image_size)
        scores = all_scores(member, dataclasses.replace(shown, images=images), progress)
        found.append(scores - miss_cost_logs(member.facts))
    known = shown.labels >= 0
    chosen = (
        np.array(weights, np.float64)
        if weights
        else pool.fitted_weights([scores[known] for scores in found], shown.labels[known])
    )
    together = pool.combined(found, chosen.tolist(), facts)
    if facts.labels == "d_land":
        limits = fitted_limits(together, shown.labels, false_safe, confidence)
        facts = dataclasses.replace(facts, limits=limits)
    pool.write_ensemble(out, networks, chosen.tolist(), facts)
    return {
        "ensemble_file": str(out),
        "networks": [path.name for path in networks],
        "weights": chosen.tolist(),
        "pictures": len(shown.labels),
        "top1_alone": [_top1(scores, shown.labels) for scores in found],
        "top1": _top1(together, shown.labels),
        "decision": decision_summary(together, shown.labels, facts.limits)
        if facts.labels == "d_land"
        else None,
    }


def _check(networks: Sequence[Path], out: Path, weights: Sequence[float]) -> None:
    if out.suffix != pool.SUFFIX or out.is_dir():
        raise UsageError(f"--out: '{out}' is no ensemble's file: give a name that ends in .json")
    if not 2 <= len(networks) <= pool.MOST:
        raise UsageError(f"{len(networks)} networks given, 2 to {pool.MOST} needed")
    if weights and len(weights) != len(networks):
        raise UsageError(f"--weight: {len(weights)} given for {len(networks)} networks")
    for path in networks:
        if path.resolve().parent != out.resolve().parent:
            raise UsageError(f"--out: '{out}' does not lie in the folder of '{path}'")


def _top1(scores: Any, labels: Any) -> float:
    known = labels >= 0
    return float((scores.argmax(axis=1) == labels)[known].mean())
