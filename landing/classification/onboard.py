"""``landing.api.GroundClassifier`` of the file of a network or of an ensemble, in ONNX Runtime."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.landing.api import GroundClassifier, GroundPrediction
from touchdown.landing.classification.decision import energies
from touchdown.landing.classification.engine import Classifier
from touchdown.landing.classification.ensemble import EnsembleClassifier, load_network
from touchdown.landing.classification.scores import probabilities
from touchdown.landing.classification.weights import checksum_file

SHIPPED = Path(__file__).with_name("trained") / "efficientnet_lite0.onnx"
"""the network that is shipped with the project, as `touchdown train` wrote it"""
ZOU2024 = SHIPPED.with_name("onboard.onnx")
"""a ResNet50 with CBAM, that of Zou, Sun and Kong (2024), in int8, for flights with their selector;
its weights lie in files beside it"""
_LABELS = "d_land"


class NetworkGroundClassifier:
    """Classifies ground by a loaded classifier of D_Land."""

    def __init__(self, network: Classifier) -> None:
        self._network = network

    @property
    def image_size(self) -> int:
        """As `landing.api.GroundClassifier.image_size`."""
        return self._network.facts.image_size

    @property
    def min_probability(self) -> float:
        """As `landing.api.GroundClassifier.min_probability`."""
        return self._network.facts.limits.min_probability

    def classify(self, images: NDArray[np.uint8]) -> GroundPrediction:
        """As `landing.api.GroundClassifier.classify`."""
        scores = self._network.scores(images)
        return GroundPrediction(
            probabilities=probabilities(scores),
            in_distribution=energies(scores) >= self._network.facts.limits.min_energy,
        )


class OnnxGroundClassifier(NetworkGroundClassifier):
    """Classifies ground into the classes of D_Land by a network's or an ensemble's file.

    Raises ValueError, FileNotFoundError and ImportError as `load_network`, and ValueError for
    other classes than those of D_Land."""

    def __init__(self, path: Path, threads: int = 1) -> None:
        super().__init__(load_network(path, threads))
        self._sha256 = checksum_file(path).read_text(encoding="utf-8").split()[0].lower()
        facts = self._network.facts
        if facts.labels != _LABELS:
            raise ValueError(
                f"'{path}' predicts the classes of '{facts.labels}'; a flight needs a network "
                f"trained with --labels {_LABELS}"
            )

    @property
    def quick(self) -> NetworkGroundClassifier:
        """Of an ensemble the first network alone, else the network itself."""
        if isinstance(self._network, EnsembleClassifier):
            return NetworkGroundClassifier(self._network.first)
        return self

    def description(self) -> dict[str, Any]:
        """Returns the network's name, image size, checksum (first 16 digits) and limit for a
        result."""
        facts = self._network.facts
        return {
            "network": facts.network,
            "image_size": facts.image_size,
            "sha256": self._sha256[:16],
            "min_probability": facts.limits.min_probability,
        }


def for_map(classifier: GroundClassifier) -> GroundClassifier:
    """Returns what classifies squares of the semantic map, two every tenth of a second: of an
    ensemble the first network alone, for its time."""
    return classifier.quick if isinstance(classifier, OnnxGroundClassifier) else classifier


def load_onboard_classifier(path: Path, threads: int = 1) -> OnnxGroundClassifier:
    """Returns the classifier in ``path``, loaded once in a process until the file changes.

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
