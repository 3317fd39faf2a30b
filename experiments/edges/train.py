"""Training of the structured edge detector, and its score beside Canny's on held-out scenes."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.zou2024.structured_edges.detector import edge_detector
from touchdown.experiments.edges.dataset import EdgeView, boundaries, edge_views
from touchdown.experiments.edges.forest import ForestParams, TrainingImages, grow_forest
from touchdown.experiments.edges.model_file import check_target, write_model
from touchdown.experiments.edges.score import (
    Counts,
    Score,
    counts_of_energy,
    counts_of_masks,
    score,
)

Array = NDArray[np.float64]
Notes = Callable[[str], None]

TRAIN_SCENES = (
    "cottage", "crossroad", "flat", "footbridge", "forest", "lake", "rooftop_parking", "turf",
    "open_water",
)  # fmt: skip
TEST_SCENES = ("houses", "pools")
"""Held-out scenes, which no training image shows"""
TRAIN_SEEDS = (100, 101)
TRAIN_VIEWS, TEST_VIEWS = 15, 4
"""Images of each scene and seed"""
CANNY_SIGMAS = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0)
"""blur, in pixels, before Canny"""
CANNY_THRESHOLDS = np.geomspace(40.0, 400.0, 8)
_CANNY_LOW = 0.4
"""Low threshold as a share of the high one, as in Matlab"""
_TIMED = 40


def train(out: Path, seed: int, notes: Notes) -> dict[str, Any]:
    """Renders the images, grows the forest and writes it to ``out``."""
    check_target(out)
    begin = time.process_time()
    seeds = tuple(s + seed for s in TRAIN_SEEDS)
    views = list(edge_views(TRAIN_SCENES, seeds, TRAIN_VIEWS, notes))
    rendered = time.process_time()
    about = {
        "structured edges": "trained by `touchdown edges train`",
        "scenes": " ".join(TRAIN_SCENES),
        "seeds": " ".join(map(str, seeds)),
        "pictures": str(len(views)),
    }
    images = [(view.rgb, view.segments) for view in views]
    size = train_edges(
        images, out, seed, about, lambda tree, nodes: notes(f"tree {tree}: {nodes} nodes")
    )
    return {
        "file": str(out),
        "pictures": len(views),
        **size,
        "render_s": rendered - begin,
        "train_s": time.process_time() - rendered,
    }


def evaluate(model: str, seeds: int, notes: Notes) -> dict[str, Any]:
    """Scores of ``model``, of gradient edges and of the best Canny, on the test scenes with seeds
    from 0 on."""
    detector = edge_detector(model)
    views = list(edge_views(TEST_SCENES, range(seeds), TEST_VIEWS, notes))
    notes("scoring the structured detector")
    counts = {model: _counts(detector, views)}
    notes("scoring gradient edges")
    counts["gradient"] = _counts(edge_detector("gradient"), views)
    canny, setting = _best_canny(views, notes)
    counts["canny"] = canny
    scores = {name: score(counts[name]) for name in counts}
    return {
        "pictures": len(views),
        "scenes": {
            name: {
                scene: score(
                    [c for c, v in zip(of_all, views, strict=True) if v.scene == scene]
                ).ods
                for scene in TEST_SCENES
            }
            for name, of_all in counts.items()
        },
        "detectors": {name: _row(result) for name, result in scores.items()},
        "canny_setting": setting,
        "ods_above_canny": scores[model].ods - scores["canny"].ods,
        "detect_ms": _milliseconds(detector, views),
        "curves": {
            name: {"precision": result.precision.tolist(), "recall": result.recall.tolist()}
            for name, result in scores.items()
        },
    }


def canny_masks(rgb: NDArray[np.uint8], sigma: float) -> list[NDArray[np.bool_]]:
    """(H, W) edges by Canny at every one of `CANNY_THRESHOLDS`, of the blurred image. At each
    pixel the colour channel with the strongest gradient counts, which finds more than grey does."""
    blurred = cv2.GaussianBlur(rgb, (0, 0), sigma)
    return [
        np.asarray(cv2.Canny(blurred, _CANNY_LOW * high, high, L2gradient=True) > 0)
        for high in CANNY_THRESHOLDS
    ]


def _counts(
    detector: Callable[[NDArray[np.uint8]], NDArray[np.float32]], views: Sequence[EdgeView]
) -> list[Counts]:
    return [counts_of_energy(detector(v.rgb), boundaries(v.segments)) for v in views]


def _best_canny(views: Sequence[EdgeView], notes: Notes) -> tuple[list[Counts], dict[str, float]]:
    """Counts with the blur that gives the best F on the test images themselves. Canny is tuned on
    the test, the structured detector is not."""
    best: tuple[float, list[Counts], dict[str, float]] = (-1.0, [], {})
    for sigma in CANNY_SIGMAS:
        notes(f"scoring Canny, blur {sigma:.1f} px")
        counts = [counts_of_masks(canny_masks(v.rgb, sigma), boundaries(v.segments)) for v in views]
        result = score(counts)
        if result.ods > best[0]:
            setting = {"sigma_px": sigma, "threshold": float(CANNY_THRESHOLDS[result.best])}
            best = (result.ods, counts, setting)
    return best[1], best[2]


def _row(result: Score) -> dict[str, float]:
    return {
        "ods": result.ods,
        "ois": result.ois,
        "ap": result.ap,
        "precision": float(result.precision[result.best]),
        "recall": float(result.recall[result.best]),
    }


def _milliseconds(
    detector: Callable[[NDArray[np.uint8]], NDArray[np.float32]], views: Sequence[EdgeView]
) -> float:
    """Median time of one image, in one thread."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    times = []
    for view in views[:_TIMED]:
        begin = time.perf_counter()
        detector(view.rgb)
        times.append(time.perf_counter() - begin)
    cv2.setNumThreads(threads)
    return 1e3 * float(np.median(times))


def train_edges(
    images: Sequence[tuple[NDArray[np.uint8], NDArray[np.int32]]],
    out: Path,
    seed: int,
    notes: dict[str, str],
    progress: Callable[[int, int], None],
) -> dict[str, Any]:
    """Grows a structured forest from (image, segments), writes it and returns its size."""
    params = ForestParams()
    trees = grow_forest(TrainingImages.of(*zip(*images, strict=True)), params, seed, progress)
    write_model(out, trees, params, notes)
    leaves = sum(int((tree.child == 0).sum()) for tree in trees)
    return {"trees": len(trees), "leaves": leaves, "bytes": out.stat().st_size}
