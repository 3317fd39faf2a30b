"""``landing.api.GroundClassifier`` of a network's file, in ONNX Runtime."""

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

SHIPPED = Path(__file__).with_name("trained") / "efficientnet_lite0.onnx"
"""the network that is shipped with the project, as `touchdown train` wrote it"""
ZOU2024 = SHIPPED.with_name("onboard.onnx")
"""a ResNet50 with CBAM, that of Zou, Sun and Kong (2024), in int8, for flights with their selector;
its weights lie in files beside it"""
_LABELS = "d_land"


class OnnxGroundClassifier:
    """Classifies ground into the classes of D_Land by a network's file.

    Raises ValueError, FileNotFoundError and ImportError as `OnnxClassifier`, and ValueError for
    other classes than those of D_Land."""

    def __init__(self, path: Path, threads: int = 1) -> None:
        self._network = OnnxClassifier(path, threads)
        self._sha256 = checksum_file(path).read_text(encoding="utf-8").split()[0].lower()
        facts = self._network.facts
        if facts.labels != _LABELS:
            raise ValueError(
                f"'{path}' predicts the classes of '{facts.labels}'; a flight needs a network "
                f"trained with --labels {_LABELS}"
            )

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
