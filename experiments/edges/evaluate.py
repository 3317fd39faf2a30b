"""Scores of the structured edge detector beside Canny's, on scenes that it was not trained on."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.estimator.zou2024.structured_edges.detector import edge_detector
from touchdown.experiments.edges.dataset import EdgeView, boundaries, edge_views
from touchdown.experiments.edges.score import (
    Counts,
    Score,
    counts_of_energy,
    counts_of_masks,
    score,
)

Notes = Callable[[str], None]

TEST_SCENES = ("houses", "pools")
"""held-out scenes, which no training image shows"""
TEST_VIEWS = 4
"""images of each scene and seed"""
CANNY_SIGMAS = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0)
"""blur, in pixels, before Canny"""
CANNY_THRESHOLDS = np.geomspace(40.0, 400.0, 8)
_CANNY_LOW = 0.4
"""low threshold as a fraction of the high one, as in Matlab"""
_TIMED = 40


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
