"""Inference of a trained network in ONNX Runtime, without torch."""

import hashlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from touchdown.landing.classification import network_check
from touchdown.landing.classification.weights import (
    INPUT,
    NetworkFacts,
    external_weights,
    facts_of,
    read_network,
)
from touchdown.sim.typing import Float32

_BATCH = 32
_TRAINED = Path(__file__).resolve().with_name("trained")
"""Folder of the networks of the project itself"""


class OnnxClassifier:
    """A network's file in ONNX Runtime, on ``threads`` threads of the processor.

    Raises ValueError and FileNotFoundError as `landing.classification.weights.read_network`, and
    ValueError for a network that cannot classify images within the limits of
    `landing.classification.network_check`, and ImportError without onnxruntime."""

    def __init__(self, path: Path, threads: int = 1) -> None:
        import onnxruntime

        content = read_network(path)
        own = is_shipped(path)
        # ONNX Runtime is not asked in this process about a file that it may break on; the network
        # of the project itself is known to load.
        if own:
            external_weights(path)
        else:
            network_check.check_loads(path, hashlib.sha256(content).hexdigest())
        options = network_check.session_options(threads, external=own)
        try:
            # Weights in files of their own are mapped, and not held twice.
            self._session = onnxruntime.InferenceSession(
                str(path) if own else content, options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # onnxruntime's errors share no base class
            text = network_check.plain_reason(error)
            raise ValueError(f"'{path}' cannot be loaded as a network: {text}") from error
        self.facts = facts_of(self._session.get_modelmeta().custom_metadata_map, path)

    def scores(self, images: NDArray[np.uint8]) -> Float32:
        """Returns calibrated scores (N, C) with miss costs applied, of images (N, S, S, 3) RGB
        with S = ``facts.image_size``. Raises ValueError for other images."""
        inputs = as_input(images, self.facts.image_size)
        found = np.asarray(self._session.run(None, {INPUT: inputs})[0], np.float32)
        return apply_miss_costs(found, self.facts)


def is_shipped(path: Path) -> bool:
    """True for a file of the project itself, which is known to load."""
    return path.resolve().parent == _TRAINED


def as_input(images: NDArray[np.uint8], size: int) -> Float32:
    """Returns images (N, S, S, 3) uint8 as (N, 3, S, S) float32 in [0, 1]. Raises ValueError for
    another shape or type."""
    if images.ndim != 4 or images.shape[1:] != (size, size, 3) or images.dtype != np.uint8:
        raise ValueError(
            f"images of shape {images.shape} and type {images.dtype} given, "
            f"(N, {size}, {size}, 3) uint8 needed"
        )
    return np.ascontiguousarray(images.transpose(0, 3, 1, 2), np.float32) / np.float32(255.0)


def apply_miss_costs(found: Float32, facts: NetworkFacts) -> Float32:
    """Returns scores (N, C) plus the logarithms of the miss costs of the classes.

    The highest score is then the class of least expected cost (Elkan, IJCAI 2001, section 2). The
    softmax is calibrated for data in which each class is as many times more frequent."""
    return found + miss_cost_logs(facts)


def miss_cost_logs(facts: NetworkFacts) -> Float32:
    """Returns the logarithms (C,) of the miss costs of the classes."""
    added = np.zeros(len(facts.classes), np.float32)
    for name, cost in facts.miss_costs:
        added[facts.classes.index(name)] = np.log(cost)
    return added


def all_scores(
    classifier: OnnxClassifier,
    images: NDArray[np.uint8],
    progress: Callable[[int, int, str], None] = lambda done, total, note: None,
) -> Float32:
    """Returns scores (N, C), computed batch by batch."""
    parts, count = [], len(images)
    for first in range(0, count, _BATCH):
        parts.append(classifier.scores(images[first : first + _BATCH]))
        progress(min(first + _BATCH, count), count, "classifying")
    return np.concatenate(parts)
