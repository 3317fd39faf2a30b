"""Speed of site selection on the map of a whole survey, beside Open3D and scikit-image."""

from __future__ import annotations

import json
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from touchdown.estimator.api import Estimate
from touchdown.experiments.benchmarks.posed_survey import SCAN_PERIOD_S, Surveyed, posed_survey
from touchdown.experiments.benchmarks.selection.stages import reference_selection, staged_selection
from touchdown.experiments.config.loading import load_config
from touchdown.experiments.errors import UsageError
from touchdown.experiments.flight.wiring import build_classifier
from touchdown.landing.api import GroundClassifier
from touchdown.landing.classification.site_check import SiteClassCheck
from touchdown.sim.api import Observation, SensorRig

PATCHES, PATCH_PX = 10, 128
"""number and side of the images that the time of classification is measured with"""


def bench_landing(
    *,
    scene: str = "crossroad",
    seed: int = 0,
    rounds: int = 9,
    reference: bool = True,
    network: Path | None = None,
    threads: int = 2,
) -> dict[str, Any]:
    """Maps a scene with every scan of the survey and measures the time of the selection, one
    thread.

    ``stage_ms``: the steps of the paper's Table 7 and their ``sum``; ``selection``: the whole
    decision of the lander, geometric check included; ``reference_ms``: the same steps by Open3D,
    SciPy and scikit-image; ``ratio.reference``: its sum over ours. Medians over ``rounds``, after
    one to warm up; the reference runs once warm. ``classifier_ms``: see `_classifier_figures`,
    where ``network`` is given or comes with the project; it works on ``threads``. Raises UsageError
    and ValueError as `load_config`, `build_classifier` and `build_scene`."""
    if reference and find_spec("skimage") is None:
        raise UsageError("the comparison needs scikit-image: install it, or give --no-reference")
    overrides = ["sim.threads=1", f"landing.classifier_threads={threads}"]
    if network is not None:
        overrides.append(f"landing.classifier={json.dumps(str(network))}")
    config = load_config(
        None, overrides, profile_default="ideal",
        scene=scene, seed=seed, estimator="oracle", record=False,
    )  # fmt: skip
    classifier = build_classifier(config)
    checks: list[SiteClassCheck] = []

    def remember(rig: SensorRig, obs: Observation, estimate: Estimate) -> None:
        assert classifier is not None
        if not checks:
            checks.append(SiteClassCheck(classifier, rig, config.landing))
        checks[0].images.update(obs, estimate)

    watch = None if classifier is None else remember
    surveyed = posed_survey(config, period_s=SCAN_PERIOD_S, watch=watch)
    view, estimate = surveyed.map_view, surveyed.estimate
    position = estimate.odom_from_body.translation
    radius_m = surveyed.survey.rig.vehicle.footprint_radius_m
    laps: dict[str, list[float]] = {}
    for number in range(rounds + 1):
        ours = staged_selection(view.coarse, position, config.landing, radius_m)
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
        figures |= _classifier_figures(classifier, checks[0], surveyed, rounds)
        figures["classifier_threads"] = threads
    if reference:
        for _ in range(2):
            other = reference_selection(view.coarse, position, config.landing, radius_m)
        sums = other.seconds | {"sum": sum(other.seconds.values())}
        figures["reference_ms"] = {name: 1e3 * seconds for name, seconds in sums.items()}
        figures["ratio"] = {"reference": figures["reference_ms"]["sum"] / stage_ms["sum"]}
    return figures


def _classifier_figures(
    classifier: GroundClassifier, check: SiteClassCheck, surveyed: Surveyed, rounds: int
) -> dict[str, Any]:
    """Returns ``classifier_ms.ten_patches``: milliseconds to classify ten images of 128 x 128,
    scaling included; ``classifier_ms.selection``: of a whole decision, in which sites are
    classified best first until one is safe; ``classified_sites``: their number."""
    rng = np.random.default_rng(0)
    patches = rng.integers(0, 256, (PATCHES, PATCH_PX, PATCH_PX, 3), dtype=np.uint8)
    size = (classifier.image_size, classifier.image_size)
    walls: dict[str, list[float]] = {"ten_patches": [], "selection": []}
    for _ in range(rounds + 1):
        started = time.perf_counter()
        scaled = [cv2.resize(patch, size, interpolation=cv2.INTER_AREA) for patch in patches]
        classifier.classify(np.stack(scaled))
        walls["ten_patches"].append(time.perf_counter() - started)
        started = time.perf_counter()
        selection = surveyed.survey.select(surveyed.map_view, surveyed.estimate)
        judged = check.judge(selection.candidates, surveyed.map_view, selection=selection)
        walls["selection"].append(time.perf_counter() - started)
    asked = sum(
        after is not before for before, after in zip(selection.candidates, judged, strict=True)
    )
    medians = {name: 1e3 * float(np.median(taken[1:])) for name, taken in walls.items()}
    return {"classifier_ms": medians, "classified_sites": asked}
