"""Benchmark of site selection without flights: posed surveys of many scenes, judged by the
ground-truth maps."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from touchdown.experiments.benchmarks.posed_survey import Surveyed, posed_survey
from touchdown.experiments.config.loading import load_config
from touchdown.experiments.config.schema import Config
from touchdown.experiments.config.seeds import parse_seeds
from touchdown.experiments.flight.wiring import check_scene_name
from touchdown.landing.api import CostmapView
from touchdown.landing.selection.terms import probability as risk
from touchdown.scenes.api import TruthMaps
from touchdown.scenes.truth.maps import truth_maps

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

SCENES = (
    "cottage", "crossroad", "footbridge", "forest", "houses", "lake", "pools", "rooftop_parking",
    "turf",
)  # fmt: skip
"""all scenes except ``flat`` and ``open_water``, which offer no choice"""
TRUTH_CELL_M = 0.1
AROUND_M = 15.0
"""width of the judged area beside the path: more than the field of view ahead, less than half of it
aside"""
SAMPLES = 4000
"""cells of a scene by which calibration is judged"""
_CELL_KEYS = ("safe", "allowed", "both")
CLEARANCE_CAP_M = 3.0
"""distance to unsafe ground from which the clearance no longer rises"""


def check_scene(config: Config, figure: Path | None = None) -> dict[str, Any]:
    """Judges the selection in one scene by the ground-truth map. Raises ValueError as
    `posed_survey`.

    Draws the steps of the selection into the file ``figure``, if given. Returns:

    ``chosen_safe`` (None where nothing was accepted), ``accepted`` and ``accepted_safe`` sites;
    ``cells``: numbers of surveyed cells that are safe, allowed, and both; ``clearance_m`` of the
    chosen site and ``best_clearance_m``: distance to the nearest unsafe ground, at most 3 m;
    ``sample``: predicted probabilities and truth of evenly spread cells, with their features.
    """
    surveyed = posed_survey(config)
    truth = truth_maps(surveyed.scene, TRUTH_CELL_M, _region(surveyed))
    selection, costmap = surveyed.selection, surveyed.selection.costmap
    accepted = [site for site in selection.candidates if site.accepted]
    verdicts = [_value_at(truth, truth.safe_geometry, site.position_odom[:2]) for site in accepted]
    clearance = np.minimum(
        distance_transform_edt(truth.safe_geometry) * TRUTH_CELL_M, CLEARANCE_CAP_M
    )
    if costmap is None:
        raise ValueError(f"scene '{config.scene}': the survey mapped nothing")
    if figure is not None:
        from touchdown.experiments.benchmarks.selection.figures import write_steps

        write_steps(figure, config, selection)
    safe, judged = _on_grid(truth, costmap)
    seen = judged & np.isfinite(costmap.flatness)
    features = risk.features_of(surveyed.map_view, surveyed.estimate, config.landing)
    rows, cols = np.nonzero(seen & features.open)
    spread = np.s_[:: max(1, rows.size // SAMPLES)]
    rows, cols = rows[spread], cols[spread]
    return {
        "scene": config.scene,
        "seed": config.seed,
        "chosen_safe": bool(verdicts[0]) if verdicts else None,
        "accepted": len(accepted),
        "accepted_safe": sum(map(bool, verdicts)),
        "cells": {
            "safe": int((safe & seen).sum()),
            "allowed": int((selection.allowed & seen).sum()),
            "both": int((safe & selection.allowed & seen).sum()),
        },
        "clearance_m": float(_value_at(truth, clearance, accepted[0].position_odom[:2]))
        if accepted
        else 0.0,
        "best_clearance_m": float(clearance.max()),
        "sample": {
            "predicted": selection.probability[rows, cols],
            "safe": safe[rows, cols],
            "features": features.values[rows, cols],
        },
    }


def summary(places: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Returns figures over many scenes.

    ``precision``: share of chosen sites that are safe; ``precision_sites``: of all accepted ones;
    ``precision_cells`` and ``recall_cells`` of the cells; ``found``: share of scenes with safe
    ground where a site was accepted; ``regret_m``: mean loss of clearance relative to the best safe
    site; ``calibration_error`` and ``reliability``: see
    `landing.selection.terms.probability.calibration`."""
    chosen = [place["chosen_safe"] for place in places if place["chosen_safe"] is not None]
    offered = [place for place in places if place["best_clearance_m"] > 0.0]
    cells = {key: sum(place["cells"][key] for place in places) for key in _CELL_KEYS}
    predicted, safe = (
        np.concatenate([place["sample"][key] for place in places]) for key in ("predicted", "safe")
    )
    error, rows = risk.calibration(predicted, safe)
    regrets = [place["best_clearance_m"] - _chosen_clearance(place) for place in offered]
    return {
        "places": len(places),
        "precision": _share(sum(chosen), len(chosen)),
        "precision_sites": _share(
            sum(place["accepted_safe"] for place in places),
            sum(place["accepted"] for place in places),
        ),
        "precision_cells": _share(cells["both"], cells["allowed"]),
        "recall_cells": _share(cells["both"], cells["safe"]),
        "found": _share(sum(place["accepted"] > 0 for place in offered), len(offered)),
        "regret_m": float(np.mean(regrets)) if regrets else None,
        "calibration_error": error,
        "reliability": rows,
    }


def check_scenes(
    configs: Sequence[Config],
    jobs: int,
    report: Callable[[dict[str, Any]], None],
    pictures: Sequence[Path | None] | None = None,
) -> list[dict[str, Any]]:
    """Returns `check_scene` of each, in ``jobs`` processes; calls ``report`` in the order given."""
    files = pictures or [None] * len(configs)
    if jobs == 1:
        pairs = zip(configs, files, strict=True)
        return [_reported(check_scene(config, file), report) for config, file in pairs]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, mp_context=context) as pool:
        return [_reported(place, report) for place in pool.map(check_scene, configs, files)]


def fit(places: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Returns ``weights`` fitted to all samples, and ``calibration_error`` and ``reliability`` by
    two-fold cross-validation over seeds. Raises ValueError for fewer than two seeds."""
    seeds = sorted({place["seed"] for place in places})
    if len(seeds) < 2:
        raise ValueError(
            "a fit needs at least two seeds, since it is judged on data that it was not fitted to"
        )
    halves = [
        [place for place in places if seeds.index(place["seed"]) % 2 == parity] for parity in (0, 1)
    ]
    predicted, truth = [], []
    for ours, others in (halves, halves[::-1]):
        weights = risk.fit_weights(_gathered(ours, "features"), _gathered(ours, "safe"))
        predicted.append(risk.predict(_gathered(others, "features"), weights))
        truth.append(_gathered(others, "safe"))
    error, rows = risk.calibration(np.concatenate(predicted), np.concatenate(truth))
    weights = risk.fit_weights(_gathered(places, "features"), _gathered(places, "safe"))
    return {"weights": list(weights), "calibration_error": error, "reliability": rows}


def _gathered(places: Sequence[dict[str, Any]], key: str) -> NDArray[Any]:
    return np.concatenate([place["sample"][key] for place in places])


def _chosen_clearance(place: dict[str, Any]) -> float:
    return float(place["clearance_m"]) if place["chosen_safe"] else 0.0


def _share(part: int, whole: int) -> float | None:
    return part / whole if whole else None


def _reported(place: dict[str, Any], report: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    report(place)
    return place


def _region(surveyed: Surveyed) -> Array:
    """Returns [[x_min, y_min], [x_max, y_max]] of the judged area."""
    path = surveyed.survey.path
    track = np.array([path.sample(t)[0][:2] for t in np.linspace(0.0, path.duration_s, 73)])
    bounds = np.asarray(surveyed.scene.bounds_xy_m)
    low = np.maximum(track.min(axis=0) - AROUND_M, bounds[0])
    high = np.minimum(track.max(axis=0) + AROUND_M, bounds[1])
    return np.array([low, high])


def _value_at(truth: TruthMaps, raster: NDArray[Any], xy: Array) -> Any:
    """Returns the raster's value at a point; False outside."""
    col, row = np.floor((xy - truth.origin_xy_m) / truth.cell_m).astype(int)
    inside = 0 <= row < raster.shape[0] and 0 <= col < raster.shape[1]
    return raster[row, col] if inside else False


def _on_grid(truth: TruthMaps, costmap: CostmapView) -> tuple[Mask, Mask]:
    """Returns the true safety at the centres of the cells, and the mask where it is known."""
    rows, cols = costmap.total.shape
    x = costmap.origin_xy_m[0] + (np.arange(cols) + 0.5) * costmap.cell_m
    y = costmap.origin_xy_m[1] + (np.arange(rows) + 0.5) * costmap.cell_m
    col = np.floor((x - truth.origin_xy_m[0]) / truth.cell_m).astype(int)
    row = np.floor((y - truth.origin_xy_m[1]) / truth.cell_m).astype(int)
    height, width = truth.safe_geometry.shape
    inside = ((row >= 0) & (row < height))[:, None] & ((col >= 0) & (col < width))[None, :]
    near = np.ix_(np.clip(row, 0, height - 1), np.clip(col, 0, width - 1))
    return truth.safe_geometry[near] & inside, inside


# ------------------------------------------------------------------------------- the command


def run(
    scenes: Sequence[str],
    *,
    seeds: str,
    selector: str | None,
    jobs: int,
    fit_model: bool,
    overrides: Sequence[str],
    report: Callable[[dict[str, Any]], None],
    pictures: Path | None = None,
) -> dict[str, Any]:
    """Checks every scene with every seed. Returns ``{"selector", "places": [...], "summary",
    "fit"}``, the last one with ``fit_model`` only.

    ``pictures``: folder for a figure of each scene. Raises UsageError for invalid seeds or a folder
    that cannot be created, and as `load_config`."""
    for name in scenes:
        check_scene_name(name)
    given = ["sim.threads=1", *overrides, *([f"landing.selector={selector}"] if selector else [])]
    configs = [
        load_config(
            None,
            given,
            profile_default="ideal",
            scene=scene,
            seed=seed,
            estimator="oracle",
            record=False,
        )
        for scene in scenes
        for seed in parse_seeds(seeds, "--seeds")
    ]
    files = None
    if pictures is not None:
        from touchdown.experiments.benchmarks.selection.figures import figure_files

        files = figure_files(configs, pictures)
    places = check_scenes(configs, jobs, report, files)
    figures: dict[str, Any] = {"selector": configs[0].landing.selector, "summary": summary(places)}
    if fit_model:
        figures["fit"] = fit(places)
    figures["places"] = [
        {key: value for key, value in place.items() if key != "sample"} for place in places
    ]
    return figures


def row(place: dict[str, Any]) -> str:
    """Returns the result of one scene as a line of text."""
    verdict = {True: "safe", False: "UNSAFE", None: "no site"}[place["chosen_safe"]]
    cells = place["cells"]
    precision, recall = (
        _share(cells["both"], cells["allowed"]),
        _share(cells["both"], cells["safe"]),
    )
    return (
        f"{place['scene']:16} seed {place['seed']:4}  {verdict:8}"
        f" sites {place['accepted_safe']}/{place['accepted']}"
        f"  cells precision {_percent(precision)} recall {_percent(recall)}"
        f"  clearance {place['clearance_m']:.1f} of {place['best_clearance_m']:.1f} m"
    )


def text(figures: dict[str, Any]) -> str:
    """Returns the summary as text."""
    total = figures["summary"]
    lines = [
        f"selector {figures['selector']}, {total['places']} scenes: precision of the chosen site "
        f"{_percent(total['precision'])}, of all sites {_percent(total['precision_sites'])}, "
        f"of cells {_percent(total['precision_cells'])}; recall of cells "
        f"{_percent(total['recall_cells'])}; a site found in {_percent(total['found'])}",
        f"regret {total['regret_m'] or 0.0:.2f} m; calibration error "
        f"{total['calibration_error']:.4f}",
    ]
    lines += [f"  predicted {mean:.3f}  safe {share:.3f}  ({number})"
              for mean, share, number in total["reliability"]]  # fmt: skip
    if "fit" in figures:
        weights = ", ".join(f"{weight:.2f}" for weight in figures["fit"]["weights"])
        lines.append(f"landing.risk_weights=[{weights}]")
        lines.append(f"calibration error held out: {figures['fit']['calibration_error']:.4f}")
    return "\n".join(lines)


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100.0 * share:.1f}%"
