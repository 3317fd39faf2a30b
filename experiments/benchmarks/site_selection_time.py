"""Speed of choosing a site on the map of a whole survey, beside Open3D and scikit-image."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.api import (
    Estimate,
    GridMap,
)
from touchdown.experiments.benchmarks.posed_survey import SCAN_PERIOD_S, Surveyed, posed_survey
from touchdown.experiments.config.loading import load_config
from touchdown.experiments.config.schema import Config
from touchdown.experiments.errors import UsageError
from touchdown.experiments.flight.wiring import build_classifier
from touchdown.landing.api import GroundClassifier
from touchdown.sim.api import Observation, SensorRig

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]


PATCHES, PATCH_PX = 10, 128
"""what the time of classification is given for"""


def bench_landing(
    *,
    scene: str = "crossroad",
    seed: int = 0,
    rounds: int = 9,
    reference: bool = True,
    network: Path | None = None,
    threads: int = 2,
) -> dict[str, Any]:
    """Maps a scene with every scan of the survey and times the selection on it, one thread.

    ``stage_ms``: the steps of the paper's Table 7 and their ``sum``; ``selection``, all that the
    lander does for a decision, the check of the ground included; ``reference_ms``: the same steps
    by Open3D, SciPy and scikit-image; ``ratio.reference``: its sum over ours; ``agreement``: how
    far the two results differ. Medians over ``rounds``, after one to warm up; the reference runs
    once warm. ``place_ms``: see `_place_figures`, where ``network`` is given or comes with the
    project; it works on ``threads``. Raises UsageError and ValueError as `load_config`,
    `build_classifier` and `build_scene`.
    """
    overrides = ["sim.threads=1", f"landing.classifier_threads={threads}"]
    if network is not None:
        overrides.append(f"landing.classifier={json.dumps(str(network))}")
    config = load_config(None, overrides, scene=scene, seed=seed, estimator="oracle", record=False)
    classifier = build_classifier(config)
    pictures: list[Any] = []

    def remember(rig: SensorRig, obs: Observation, estimate: Estimate) -> None:
        assert classifier is not None
        if not pictures:
            pictures.append(place_check(config, rig, classifier))
        pictures[0].take_in(obs, estimate)

    watch = None if classifier is None else remember
    surveyed = posed_survey(config, period_s=SCAN_PERIOD_S, watch=watch)
    stages = selection_stages(config, surveyed.survey.rig)
    view, estimate = surveyed.map_view, surveyed.estimate
    laps: dict[str, list[float]] = {}
    for number in range(rounds + 1):
        ours = stages.ours(view.coarse, estimate.odom_from_body.translation)
        started = time.perf_counter()
        selection = surveyed.survey.select(view, estimate)
        spent = ours.seconds | {
            "sum": sum(ours.seconds.values()),
            "selection": time.perf_counter() - started,
        }
        if number > 0:
            for name, seconds in spent.items():
                laps.setdefault(name, []).append(seconds)
    stage_ms = {name: 1e3 * float(np.median(walls)) for name, walls in laps.items()}
    figures: dict[str, Any] = {
        "scene": scene,
        "seed": seed,
        "cells": list(ours.total.shape),
        "clusters": len(ours.modes),
        "candidates": len(selection.candidates),
        "stage_ms": stage_ms,
    }
    if classifier is not None:
        figures |= _place_figures(classifier, pictures[0], surveyed, rounds)
        figures["classifier_threads"] = threads
    if reference:
        for _ in range(2):
            theirs = stages.reference(view.coarse, estimate.odom_from_body.translation)
        sums = theirs.seconds | {"sum": sum(theirs.seconds.values())}
        figures["reference_ms"] = {name: 1e3 * seconds for name, seconds in sums.items()}
        figures["ratio"] = {"reference": figures["reference_ms"]["sum"] / stage_ms["sum"]}
        figures["agreement"] = agreement(ours, theirs)
    return figures


def _place_figures(
    classifier: GroundClassifier, check: Any, surveyed: Surveyed, rounds: int
) -> dict[str, Any]:
    """``place_ms.ten_patches``: ten pictures of 128 x 128 to their classes, scaling included;
    ``place_ms.selection``: all of a decision, the pictures cut out and classified best first until
    one is safe; ``place_asked``: of how many sites."""
    rng = np.random.default_rng(0)
    patches = rng.integers(0, 256, (PATCHES, PATCH_PX, PATCH_PX, 3), dtype=np.uint8)
    size = (classifier.image_size, classifier.image_size)
    walls: dict[str, list[float]] = {"ten_patches": [], "selection": []}
    for _ in range(rounds + 1):
        started = time.perf_counter()
        scaled = [cv2.resize(patch, size, interpolation=cv2.INTER_AREA) for patch in patches]
        classifier.look(np.stack(scaled))
        walls["ten_patches"].append(time.perf_counter() - started)
        started = time.perf_counter()
        selection = surveyed.survey.select(surveyed.map_view, surveyed.estimate)
        judged = check.judge(selection.candidates, surveyed.map_view, selection=selection)
        walls["selection"].append(time.perf_counter() - started)
    asked = sum(
        after is not before for before, after in zip(selection.candidates, judged, strict=True)
    )
    medians = {name: 1e3 * float(np.median(taken[1:])) for name, taken in walls.items()}
    return {"place_ms": medians, "place_asked": asked}


def agreement(ours: Any, theirs: Any) -> dict[str, float]:
    """How far two results on the same cells differ: correlation and mean absolute difference of
    C_sum, metres between the best modes, and what C_sum ours loses at its best mode beside theirs.
    """
    both = np.isfinite(ours.total) & np.isfinite(theirs.total)
    a, b = ours.total[both].astype(np.float64), theirs.total[both].astype(np.float64)
    best = [_best(staged) for staged in (ours, theirs)]
    cell_m = float(ours.cell_m)
    return {
        "correlation": float(np.corrcoef(a, b)[0, 1]),
        "mean_difference": float(np.abs(a - b).mean()),
        "best_apart_m": cell_m * float(np.hypot(*(best[0] - best[1]))),
        "best_loss": float(theirs.total[tuple(best[1])] - theirs.total[tuple(best[0])]),
    }


def _best(staged: Any) -> NDArray[np.int32]:
    values: Float32 = staged.total[tuple(staged.modes.T)]
    mode: NDArray[np.int32] = staged.modes[int(np.nanargmax(values))]
    return mode


@dataclass(slots=True)
class SelectionStages:
    """The steps of selection, timed one by one: a map and the vehicle's position (3,) in the odom
    frame to ``experiments.benchmarks.selection_stages.Staged``."""

    ours: Callable[[GridMap, Array], Any]
    reference: Callable[[GridMap, Array], Any]
    """by Open3D, SciPy and scikit-image"""


def selection_stages(config: Config, rig: SensorRig) -> SelectionStages:
    """As `experiments.benchmarks.selection_stages.staged_selection` and
    `experiments.benchmarks.selection_reference.reference_selection`."""
    from touchdown.experiments.benchmarks.selection_stages import staged_selection

    params, radius_m = config.landing, rig.vehicle.footprint_radius_m

    def reference(grid: GridMap, position: Array) -> Any:
        try:
            from touchdown.experiments.benchmarks.selection_reference import reference_selection
        except ImportError as error:
            raise UsageError(
                f"the comparison needs scikit-image ({error}): install it, or give --no-reference"
            ) from error
        return reference_selection(grid, position, params, radius_m)

    def ours(grid: GridMap, position: Array) -> Any:
        return staged_selection(grid, position, params, radius_m)

    return SelectionStages(ours=ours, reference=reference)


def place_check(config: Config, rig: SensorRig, classifier: GroundClassifier) -> Any:
    """``landing.classification.site_check.SiteClassCheck`` of a flight."""
    from touchdown.landing.classification.site_check import SiteClassCheck

    return SiteClassCheck(classifier, rig, config.landing)
