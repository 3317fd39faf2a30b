"""A network's file as the lander asks it: ``landing.api.GroundClassifier`` by ONNX Runtime."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.landing.api import GroundPrediction
from touchdown.landing.classification.decision import energies
from touchdown.landing.classification.engine import OnnxClassifier
from touchdown.landing.classification.scores import probabilities
from touchdown.landing.classification.weights import checksum_file

SHIPPED = Path(__file__).with_name("trained") / "network.onnx"
"""comes with the project"""
_LABELS = "d_land"


class OnnxGroundClassifier:
    """Raises ValueError, FileNotFoundError, ImportError as `OnnxClassifier`, ValueError for a
    network that tells other classes apart than D_Land."""

    def __init__(self, path: Path, threads: int = 1) -> None:
        self._network = OnnxClassifier(path, threads)
        self._sha256 = checksum_file(path).read_text(encoding="utf-8").split()[0].lower()
        facts = self._network.facts
        if facts.labels != _LABELS:
            raise ValueError(
                f"'{path}' tells the classes of '{facts.labels}' apart; a flight needs one trained "
                f"with --labels {_LABELS}"
            )

    @property
    def image_size(self) -> int:
        return self._network.facts.image_size

    @property
    def min_probability(self) -> float:
        return self._network.facts.limits.min_probability

    def description(self) -> dict[str, Any]:
        """For a flight's result: which network, and the beginning of its checksum."""
        facts = self._network.facts
        return {
            "network": facts.network,
            "image_size": facts.image_size,
            "sha256": self._sha256[:16],
            "min_probability": facts.limits.min_probability,
        }

    def classify(self, images: NDArray[np.uint8]) -> GroundPrediction:
        """As `landing.api.GroundClassifier.look`."""
        scores = self._network.scores(images)
        return GroundPrediction(
            probabilities=probabilities(scores),
            in_distribution=energies(scores) >= self._network.facts.limits.min_energy,
        )


def load_onboard_classifier(path: Path, threads: int = 1) -> OnnxGroundClassifier:
    """The network in ``path``, loaded once in a process for as long as the file does not change.
    Raises as `OnnxGroundClassifier`."""
    stamps = tuple(_stamp(file) for file in (path, checksum_file(path)))
    return _loaded(path.resolve(), threads, stamps)


def _stamp(file: Path) -> tuple[int, int] | None:
    if not file.is_file():
        return None
    facts = file.stat()
    return facts.st_size, facts.st_mtime_ns


@functools.lru_cache(maxsize=2)
def _loaded(
    path: Path, threads: int, stamps: tuple[tuple[int, int] | None, ...]
) -> OnnxGroundClassifier:
    return OnnxGroundClassifier(path, threads)
