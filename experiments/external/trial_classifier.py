"""The examination of a ground classifier on textures of plain colours."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.experiments.external.conformance_report import Findings
from touchdown.experiments.external.loading import Build
from touchdown.experiments.external.part_checks import wrong_classifier, wrong_prediction
from touchdown.experiments.external.trial import COMMON_RULES, Trial
from touchdown.landing.api import ClassifierRig, GroundPrediction

RULES: Mapping[str, str] = {
    **COMMON_RULES,
    "probabilities": "those of an image are 0 or more and add up to 1",
    "batch": "an image is classified the same alone as among others",
    "images": "images of other colours have other probabilities",
}

_COLOURS = ((100, 130, 70), (170, 130, 95), (95, 95, 100), (60, 85, 110), (40, 60, 30))
_SAME, _ROUNDING = 1e-6, 1e-3


def textures(size: int) -> NDArray[np.uint8]:
    """(5, S, S, 3) RGB: a lawn, a field, a road, water and trees by their colours, with noise."""
    rng = np.random.default_rng(3)
    plain = np.array(_COLOURS, float)[:, None, None, :]
    noise = rng.normal(0.0, 12.0, (len(_COLOURS), size, size, 1))
    return np.clip(plain + noise, 0, 255).astype(np.uint8)


def examine_classifier(build: Build, rig: ClassifierRig, params: Mapping[str, Any]) -> Findings:
    """The broken rules of a classifier and its latency."""
    trial = Trial("classifier", build, params, rig, wrong_classifier)
    trial.sessions(lambda part: _session(trial, part))
    return trial.findings


def _session(trial: Trial, part: Any) -> Iterator[Any]:
    images = textures(part.image_size)
    together = trial.ask(part, "classify", images, when="of five images")
    yield together
    if not _judged(trial, together, len(images), "of five images"):
        return
    table = together.probabilities
    if np.ptp(table, axis=0).max() < _SAME:
        trial.note("images", "five textures of other colours have the same probabilities")
    first = zip(_names(trial, table), table.max(axis=1), strict=True)
    trial.findings.figures["textures"] = ", ".join(f"{name} {p:.2f}" for name, p in first)
    for number, image in enumerate(images, start=1):
        alone = trial.ask(part, "classify", image[None], when=f"of image {number} alone")
        yield alone
        if not _judged(trial, alone, 1, f"of image {number} alone"):
            return
        off = float(abs(alone.probabilities[0] - table[number - 1]).max())
        if off > _ROUNDING:
            trial.note("batch", f"image {number} alone has probabilities {off:.2g} off")
    black = np.zeros_like(images[:1])
    dark = trial.ask(part, "classify", black, when="of a black image", rule="missing data")
    yield dark
    _judged(trial, dark, 1, "of a black image")


def _names(trial: Trial, table: NDArray[np.float64]) -> list[str]:
    return [trial.rig.classes[int(row.argmax())] for row in table]


def _judged(trial: Trial, answer: GroundPrediction | None, count: int, what: str) -> bool:
    if answer is None and trial.findings.violations:
        return False  # it raised
    wrong = wrong_prediction(answer, count, len(trial.rig.classes))
    trial.judge(wrong, f"{what} classify returned")
    return wrong is None
