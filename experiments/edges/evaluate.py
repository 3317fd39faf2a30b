"""`touchdown edges evaluate`: scores of the structured edge detector beside Canny's, on scenes that
it was not trained on: precision, recall, and F by the measures of the Berkeley benchmark (Martin,
Fowlkes and Malik 2004; Arbelaez et al. 2011).

Detections and boundaries are thinned to lines of one pixel and matched one to one, each pair no
further apart than 0.0075 of the image's diagonal. The number of pairs is that of a maximum
matching (Hopcroft and Karp); the benchmark's own, of least total distance with outliers, differs
from it by little.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import maximum_bipartite_matching

from touchdown.estimator.zou2024.structured_edges import edge_detector
from touchdown.experiments.edges.dataset import EdgeView, boundaries, edge_views

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Float32 = NDArray[np.float32]

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
TOLERANCE = 0.0075
"""Fraction of the image's diagonal"""
THRESHOLDS = (np.arange(1, 36) / 36.0) ** 2
"""denser where the energy of faint edges lies"""
_NMS_RADIUS = 2
_RECALLS = np.linspace(0.0, 1.0, 101)


@dataclass(frozen=True, slots=True)
class Counts:
    """Counts of one image at (T,) thresholds: ``true`` (one number) and ``detected`` pixels, and
    the pairs that were ``matched``."""

    true: int
    detected: NDArray[np.int64]
    matched: NDArray[np.int64]


@dataclass(frozen=True, kw_only=True, slots=True)
class Score:
    """Score of a set of images. ``ods``: best F at one threshold for all, whose index is ``best``;
    ``ois``: F with the best threshold for each; ``ap``: average precision."""

    ods: float
    ois: float
    ap: float
    best: int
    precision: Array
    """(T,)"""
    recall: Array
    """(T,)"""


def thinned(mask: Mask) -> Mask:
    """Lines of one pixel's width (Zhang and Suen 1984)."""
    return np.asarray(cv2.ximgproc.thinning(mask.astype(np.uint8) * 255) > 0)


def ridges(energy: Float32) -> Float32:
    """Energy where it is greatest across the edge, 0 elsewhere; (H, W).

    The direction across is that of the strongest second derivative of the smoothed energy.
    """
    smooth = cv2.GaussianBlur(energy, (0, 0), 2.0)
    dxx = cv2.Sobel(smooth, cv2.CV_32F, 2, 0, ksize=5)
    dyy = cv2.Sobel(smooth, cv2.CV_32F, 0, 2, ksize=5)
    dxy = cv2.Sobel(smooth, cv2.CV_32F, 1, 1, ksize=5)
    # the eigenvector of the most negative curvature of the Hessian
    angle = 0.5 * np.arctan2(-2.0 * dxy, dyy - dxx)
    cols, rows = np.meshgrid(
        np.arange(energy.shape[1], dtype=np.float32), np.arange(energy.shape[0], dtype=np.float32)
    )
    greatest = np.ones(energy.shape, bool)
    step_x, step_y = np.cos(angle).astype(np.float32), np.sin(angle).astype(np.float32)
    for distance in (*range(-_NMS_RADIUS, 0), *range(1, _NMS_RADIUS + 1)):
        beside = cv2.remap(
            energy,
            cols + np.float32(distance) * step_x,
            rows + np.float32(distance) * step_y,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        greatest &= energy >= beside
    return np.where(greatest, energy, np.float32(0.0)).astype(np.float32)


def matched_pairs(detected: Mask, true: Mask) -> int:
    """Size of a maximum one-to-one matching of detected and true pixels within the tolerance."""
    height, width = true.shape
    radius = TOLERANCE * float(np.hypot(height, width))
    rows, cols = np.nonzero(detected)
    number = np.full((height, width), -1, np.int64)
    number[true] = np.arange(int(true.sum()))
    if not len(rows) or not true.any():
        return 0
    reach = int(radius)
    sources, targets = [], []
    for dy, dx in np.ndindex(2 * reach + 1, 2 * reach + 1):
        dy, dx = dy - reach, dx - reach
        if dx * dx + dy * dy > radius * radius:
            continue
        y, x = rows + dy, cols + dx
        inside = np.flatnonzero((y >= 0) & (y < height) & (x >= 0) & (x < width))
        there = number[y[inside], x[inside]]
        sources.append(inside[there >= 0])
        targets.append(there[there >= 0])
    links = (np.concatenate(sources), np.concatenate(targets))
    graph = csr_array((np.ones(len(links[0]), np.int8), links), shape=(len(rows), int(true.sum())))
    return int((maximum_bipartite_matching(graph, perm_type="column") >= 0).sum())


def counts_of_masks(masks: Sequence[Mask], true: Mask) -> Counts:
    """Counts of one mask per threshold; all are thinned here."""
    target = thinned(true)
    lines = [thinned(mask) for mask in masks]
    return Counts(
        int(target.sum()),
        np.array([int(line.sum()) for line in lines]),
        np.array([matched_pairs(line, target) for line in lines]),
    )


def counts_of_energy(energy: Float32, true: Mask, thresholds: Array = THRESHOLDS) -> Counts:
    """Counts of an energy in [0, 1], cut at every threshold after non-maximum suppression."""
    ridge = ridges(energy)
    return counts_of_masks([ridge >= threshold for threshold in thresholds], true)


def score(counts: Sequence[Counts]) -> Score:
    """Score over all images, whose counts are of the same thresholds in ascending order."""
    detected = np.sum([c.detected for c in counts], axis=0)
    matched = np.sum([c.matched for c in counts], axis=0)
    true = sum(c.true for c in counts)
    precision, recall = _ratio(matched, detected, 1.0), _ratio(matched, np.array(true), 0.0)
    f = f_measure(precision, recall)
    each = [_best_of(c) for c in counts]
    ois = _f_of_counts(each)
    return Score(
        ods=float(f.max()),
        ois=ois,
        ap=_average_precision(precision, recall),
        best=int(f.argmax()),
        precision=precision,
        recall=recall,
    )


def f_measure(precision: Array, recall: Array) -> Array:
    """Harmonic mean; 0 where both are 0."""
    total = precision + recall
    return np.where(total > 0.0, 2.0 * precision * recall / np.where(total > 0.0, total, 1.0), 0.0)


def _ratio(part: NDArray[np.int64], whole: NDArray[np.int64], empty: float) -> Array:
    return np.where(whole > 0, part / np.maximum(whole, 1), empty)


def _best_of(counts: Counts) -> tuple[int, int, int]:
    """True, detected, matched at the threshold of one image's own best F."""
    precision = _ratio(counts.matched, counts.detected, 1.0)
    recall = _ratio(counts.matched, np.array(counts.true), 0.0)
    best = int(f_measure(precision, recall).argmax())
    return counts.true, int(counts.detected[best]), int(counts.matched[best])


def _f_of_counts(each: Sequence[tuple[int, int, int]]) -> float:
    true, detected, matched = np.sum(each, axis=0)
    return float(2.0 * matched / max(true + detected, 1))


def _average_precision(precision: Array, recall: Array) -> float:
    """Area below precision over recall, no precision beyond the greatest recall."""
    order = np.argsort(recall, kind="stable")
    along = np.interp(
        _RECALLS, recall[order], precision[order], left=precision[order][0], right=0.0
    )
    return float(along.mean())


# ------------------------------------------------------------------------------- the command


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
