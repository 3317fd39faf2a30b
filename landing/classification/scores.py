"""Metrics of a classifier. Scores before the softmax are (N, C), labels (N,) index into C."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.sim.typing import Array, Float32

Labels = NDArray[np.int64]

_BINS = 15


def probabilities(scores: Float32) -> Array:
    """Returns the softmax (N, C)."""
    shifted = scores.astype(np.float64)
    exponents = np.exp(shifted - shifted.max(axis=1, keepdims=True))
    return np.asarray(exponents / exponents.sum(axis=1, keepdims=True))


def confusion(labels: Labels, predicted: Labels, classes: int) -> Labels:
    """Returns the confusion matrix (C, C) of counts: true class by row, predicted class by
    column."""
    counts = np.bincount(labels * classes + predicted, minlength=classes**2)
    return counts.reshape(classes, classes).astype(np.int64)


def recalls(counts: Labels) -> Array:
    """Returns the recall (C,) of each class; NaN where the class does not occur."""
    present = counts.sum(axis=1)
    return np.where(present > 0, np.diag(counts) / np.maximum(present, 1), np.nan)


def f1_scores(counts: Labels) -> Array:
    """Returns the F1 score (C,) of each class, 2 TP / (2 TP + FP + FN); NaN where the class does
    not occur."""
    hits, present, claimed = np.diag(counts), counts.sum(axis=1), counts.sum(axis=0)
    return np.where(present > 0, 2.0 * hits / np.maximum(present + claimed, 1), np.nan)


def log_loss(scores: Float32, labels: Labels) -> float:
    """Returns the mean cross-entropy, natural logarithm."""
    shifted = scores.astype(np.float64)
    shifted -= shifted.max(axis=1, keepdims=True)
    total = np.log(np.exp(shifted).sum(axis=1))
    return float((total - shifted[np.arange(len(labels)), labels]).mean())


def calibration(
    predicted: Float32, right: NDArray[np.bool_], bins: int = 10
) -> tuple[float, list[tuple[float, float, int]]]:
    """Returns the expected calibration error of probabilities (N,), and the reliability diagram:
    mean probability, fraction that is right and number of each bin of equal width that holds
    any."""
    index = np.minimum((predicted * bins).astype(int), bins - 1)
    rows, error = [], 0.0
    for number in range(bins):
        inside = index == number
        if inside.any():
            mean, fraction = float(predicted[inside].mean()), float(right[inside].mean())
            rows.append((mean, fraction, int(inside.sum())))
            error += abs(mean - fraction) * float(inside.mean())
    return error, rows


def calibration_error(scores: Float32, labels: Labels) -> float:
    """Returns the expected calibration error of the probability of the best class, in 15
    bins of equal width (Guo et al., ICML 2017)."""
    chance = probabilities(scores)
    right = chance.argmax(axis=1) == labels
    return calibration(chance.max(axis=1).astype(np.float32), right, _BINS)[0]


def fitted_temperature(scores: Float32, labels: Labels) -> float:
    """Returns the temperature T between 0.05 and 20 that minimises the loss of scores / T (Guo et
    al. 2017)."""
    from scipy.optimize import minimize_scalar

    found = minimize_scalar(
        lambda log_t: log_loss((scores / np.exp(log_t)).astype(np.float32), labels),
        bounds=(np.log(0.05), np.log(20.0)),
        method="bounded",
    )
    return float(np.exp(found.x))


def summary(scores: Float32, labels: Labels, classes: Sequence[str]) -> dict[str, Any]:
    """Returns loss, macro F1, mean recall and recall of each class (over classes that occur),
    top-1, calibration error and confusion matrix."""
    predicted = scores.argmax(axis=1)
    counts = confusion(labels, predicted, len(classes))
    recall, hits = recalls(counts), int(np.trace(counts))
    return {
        "pictures": len(labels),
        "loss": log_loss(scores, labels),
        "macro_f1": float(np.nanmean(f1_scores(counts))),
        "recall": float(np.nanmean(recall)),
        "hits": hits,
        "top1": hits / len(labels),
        "ece": calibration_error(scores, labels),
        "recall_of": {
            name: float(value)
            for name, value in zip(classes, recall, strict=True)
            if np.isfinite(value)
        },
        "confusion": counts.tolist(),
    }
