"""Several networks that classify together: a logarithmic opinion pool.

The probabilities of the pool are the weighted geometric mean of those of its members, normalised
(Genest and Zidek, Statistical Science 1, 1986). In scores before the softmax, that is their
weighted sum. With weights of sum 1 its loss is the mean of theirs less their disagreement (Heskes,
NIPS 1997). Miss costs are those of the pool, added once.

How far an image lies from the training data is asked of the first member alone: its energy is that
of the pool. The mean of several energies tells less where one member was trained without images of
no class.

An ensemble's file is JSON with a checksum file, beside the files of its networks.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.landing.classification.decision import energies
from touchdown.landing.classification.engine import (
    Classifier,
    OnnxClassifier,
    apply_miss_costs,
    check_images,
    miss_cost_logs,
)
from touchdown.landing.classification.scores import log_loss
from touchdown.landing.classification.weights import (
    NetworkFacts,
    facts_of,
    read_network,
    write_network,
)

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]
Images = NDArray[np.uint8]
Labels = NDArray[np.int64]

SUFFIX = ".json"
MOST = 8
"""largest number of members"""
_MAX_BYTES = 1 << 16
_MAX_WEIGHT = 4.0
_DIGITS = 4
"""of fitted weights, after the point"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Member:
    """A network of an ensemble."""

    file: str
    """name, in the folder of the ensemble's file"""
    sha256: str
    """of the network's file: the limits of the ensemble are fitted to its scores"""
    weight: float
    """of its scores"""


class EnsembleClassifier:
    """The networks of an ensemble's file as one classifier.

    Raises ValueError and FileNotFoundError as `OnnxClassifier`, and ValueError for a damaged file,
    another network than the ensemble was fitted to, and networks that differ in their classes."""

    def __init__(self, path: Path, threads: int = 1) -> None:
        self.facts, self._members = read_ensemble(path)
        self._folder, self._threads = path.resolve().parent, threads
        for member in self._members:
            self._check(member)
        self._networks = [self._loaded(member) for member in self._members]
        self.first = self._networks[0]

    def scores(self, images: Images) -> Float32:
        """As ``Classifier.scores``; their energy is that of the first network."""
        check_images(images, self.facts.image_size)
        found = [costless(network, images) for network in self._networks]
        return combined(found, [member.weight for member in self._members], self.facts)

    def _check(self, member: Member) -> None:
        content = read_network(self._folder / member.file)
        if hashlib.sha256(content).hexdigest() != member.sha256:
            raise ValueError(
                f"'{member.file}' is not the network that the ensemble was fitted to; "
                "fit it anew: touchdown ensemble"
            )

    def _loaded(self, member: Member) -> OnnxClassifier:
        network = OnnxClassifier(self._folder / member.file, self._threads)
        check_classes(self.facts, network.facts, member.file)
        return network


def load_network(path: Path, threads: int = 1) -> Classifier:
    """Returns the classifier of a network's or an ensemble's file in ONNX Runtime.

    Raises as `OnnxClassifier` and `EnsembleClassifier`."""
    if path.suffix == SUFFIX:
        return EnsembleClassifier(path, threads)
    return OnnxClassifier(path, threads)


def files_of(path: Path) -> list[Path]:
    """Returns the files of the networks in ``path``: those of an ensemble, else ``path``."""
    if path.suffix != SUFFIX:
        return [path]
    return [path.with_name(member.file) for member in read_ensemble(path)[1]]


def check_classes(first: NetworkFacts, other: NetworkFacts, name: str) -> None:
    """Raises ValueError where two networks do not have the same classes."""
    if (other.labels, other.classes) != (first.labels, first.classes):
        raise ValueError(
            f"'{name}' predicts the classes of '{other.labels}', the ensemble those of "
            f"'{first.labels}'"
        )


def scaled(images: Images, size: int) -> Images:
    """Returns images (N, S, S, 3) at ``size`` pixels across, averaged over areas."""
    if images.shape[1:3] == (size, size):
        return images
    return np.stack(
        [cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA) for image in images]
    ).astype(np.uint8)


def costless(network: Classifier, images: Images) -> Float32:
    """Returns the scores (N, C) of ``network`` for images (N, S, S, 3) of any size, without the
    costs of misses."""
    return network.scores(scaled(images, network.facts.image_size)) - miss_cost_logs(network.facts)


def pooled(found: Sequence[Float32], weights: Sequence[float]) -> Float32:
    """Returns the weighted sum (N, C) of the scores of members, each (N, C) without miss costs."""
    total = np.zeros(found[0].shape, np.float32)
    for scores, weight in zip(found, weights, strict=True):
        total += np.float32(weight) * scores
    return total


def combined(found: Sequence[Float32], weights: Sequence[float], facts: NetworkFacts) -> Float32:
    """Returns the scores (N, C) of an ensemble by those of its members, each (N, C) without miss
    costs: the pool with the costs of ``facts``, at the energy of the first member."""
    scores = apply_miss_costs(pooled(found, weights), facts)
    energy = energies(apply_miss_costs(found[0], facts))
    return (scores + (energy - energies(scores))[:, None]).astype(np.float32)


def fitted_weights(found: Sequence[Float32], labels: Labels) -> Array:
    """Returns the weights (M,), 0 to 4, at which the loss of the pool is least; it is convex in
    them. Their sum calibrates the pool, as a temperature does one network.

    ``found`` holds the scores (N, C) of the M members, without miss costs, of images that none was
    trained on; ``labels`` (N,) index into C."""
    from scipy.optimize import minimize

    start = np.full(len(found), 1.0 / len(found))
    done = minimize(
        lambda weights: log_loss(pooled(found, weights.tolist()), labels),
        start,
        bounds=[(0.0, _MAX_WEIGHT)] * len(found),
        method="L-BFGS-B",
        options={"eps": 1e-3},  # scores are single precision
    )
    return np.round(done.x, _DIGITS)


def write_ensemble(
    path: Path, networks: Sequence[Path], weights: Sequence[float], facts: NetworkFacts
) -> None:
    """Writes an ensemble of ``networks``, files in the folder of ``path``, and its checksum."""
    members = [
        {
            "file": network.name,
            "sha256": hashlib.sha256(read_network(network)).hexdigest(),
            "weight": float(weight),
        }
        for network, weight in zip(networks, weights, strict=True)
    ]
    table = {"members": members, "facts": facts.properties()}
    write_network(path, (json.dumps(table, indent=2) + "\n").encode())


def read_ensemble(path: Path) -> tuple[NetworkFacts, tuple[Member, ...]]:
    """Returns the facts of an ensemble and its members. Raises FileNotFoundError and ValueError as
    `read_network`, and ValueError for a file that `touchdown ensemble` did not write."""
    content = read_network(path)
    try:
        if len(content) > _MAX_BYTES:
            raise ValueError("it is too large")
        table = json.loads(content)
        facts = facts_of({str(k): str(v) for k, v in table["facts"].items()}, path)
        members = tuple(_member(entry) for entry in table["members"])
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        text = str(error) if isinstance(error, ValueError) else "something is missing in it"
        raise ValueError(
            f"'{path}' is no ensemble of `touchdown ensemble`: {text.splitlines()[0][:200]}"
        ) from error
    if not 1 <= len(members) <= MOST:
        raise ValueError(f"'{path}' has {len(members)} networks, not 1 to {MOST}")
    return facts, members


def _member(entry: dict[str, object]) -> Member:
    name, weight = str(entry["file"]), float(str(entry["weight"]))
    if Path(name).name != name or not name.isprintable() or len(name) > 255:
        raise ValueError("a network of it is not a file in its folder")
    if not (math.isfinite(weight) and 0.0 <= weight <= _MAX_WEIGHT):
        raise ValueError(f"a weight is not 0 to {_MAX_WEIGHT:g}")
    return Member(file=name, sha256=str(entry["sha256"]), weight=weight)
