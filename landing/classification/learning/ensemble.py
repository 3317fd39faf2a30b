"""Several networks as one, a logarithmic opinion pool: in one file, or as the teachers of another.

The probabilities of the pool are the weighted geometric mean of those of its members, normalised
(Genest and Zidek, Statistical Science 1, 1986). In scores before the softmax, that is their
weighted sum. With weights of sum 1 its loss is the mean of theirs less their disagreement (Heskes,
NIPS 1997). Miss costs are those of the pool, added once.

How far an image lies from the training data is asked of the first member alone: its energy is that
of the pool. The mean of several energies tells less where one member was trained without images of
no class.

A small network learns what several know together (Hinton, Vinyals and Dean, 2015; Beyer et al.,
CVPR 2022: teachers see the same augmented images).
"""

from collections.abc import Sequence
from pathlib import Path
from zlib import crc32

import cv2
import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import compose, helper, numpy_helper
from torch import Tensor

from touchdown.landing.classification.engine import OnnxClassifier, miss_cost_logs
from touchdown.landing.classification.scores import log_loss
from touchdown.landing.classification.weights import (
    INPUT,
    OUTPUT,
    NetworkFacts,
    read_network,
    write_network,
)
from touchdown.sim.typing import Array, Float32

Labels = NDArray[np.int64]

MAX_WEIGHT = 4.0
_DIGITS = 4
"""of fitted weights, after the point"""
_COSTS, _POOL = "miss_costs", "pool"


def pooled(found: Sequence[Float32], weights: Sequence[float]) -> Float32:
    """Returns the weighted sum (N, C) of the scores of members, each (N, C) without miss costs."""
    total = np.zeros(found[0].shape, np.float32)
    for scores, weight in zip(found, weights, strict=True):
        total += np.float32(weight) * scores
    return total


def fitted_weights(found: Sequence[Float32], labels: Labels) -> Array:
    """Returns the weights (M,), 0 to 4, at which the loss of the pool is smallest; it is convex in
    them. Their sum calibrates the pool, as a temperature does one network.

    ``found`` holds the scores (N, C) of the M members, without miss costs, of images that none was
    trained on; ``labels`` (N,) index into C."""
    from scipy.optimize import minimize

    start = np.full(len(found), 1.0 / len(found))
    done = minimize(
        lambda weights: log_loss(pooled(found, weights.tolist()), labels),
        start,
        bounds=[(0.0, MAX_WEIGHT)] * len(found),
        method="L-BFGS-B",
        options={"eps": 1e-3},  # scores are single precision
    )
    return np.round(done.x, _DIGITS)


def write_ensemble(
    path: Path, networks: Sequence[Path], weights: Sequence[float], facts: NetworkFacts
) -> None:
    """Writes one network whose scores are the pool of those of ``networks``, and its checksum.

    Its members see the same images. Raises ValueError for networks of different versions of
    ONNX."""
    models = [onnx.load_from_string(read_network(network)) for network in networks]
    parts = [compose.add_prefix(m, f"{n}/") for n, m in enumerate(models)]
    if any(part.opset_import[0] != parts[0].opset_import[0] for part in parts):
        raise ValueError("the networks are of different versions of ONNX: export them anew")
    nodes = [helper.make_node("Identity", [INPUT], [p.graph.input[0].name]) for p in parts]
    initial = [numpy_helper.from_array(miss_cost_logs(facts), _COSTS)]
    for part in parts:
        nodes += part.graph.node
        initial += part.graph.initializer
    scores = [part.graph.output[0].name for part in parts]
    total = []
    for number, (name, weight) in enumerate(zip(scores, weights, strict=True)):
        factor = f"weight_{number}"
        initial.append(numpy_helper.from_array(np.array(weight, np.float32), factor))
        total.append(f"weighted_{number}")
        nodes.append(helper.make_node("Mul", [name, factor], [total[-1]]))
    nodes.append(helper.make_node("Sum", total, [_POOL]))
    nodes += [*_energy(scores[0], "first"), *_energy(_POOL, "own")]
    nodes.append(helper.make_node("Sub", ["first_energy", "own_energy"], ["shift"]))
    nodes.append(helper.make_node("Add", [_POOL, "shift"], [OUTPUT]))
    image, result = models[0].graph.input[0], models[0].graph.output[0]
    graph = helper.make_graph(nodes, "ensemble", [image], [result], initial)
    domains = {entry.domain: entry for part in parts for entry in part.opset_import}
    model = helper.make_model(
        graph, opset_imports=list(domains.values()), ir_version=max(m.ir_version for m in models)
    )
    helper.set_model_props(model, facts.properties())
    onnx.checker.check_model(model)
    write_network(path, model.SerializeToString(deterministic=True))


def _energy(scores: str, name: str) -> list[onnx.NodeProto]:
    """Returns nodes that compute the energy (N, 1) of scores with the miss costs added."""
    with_costs = f"{name}_with_costs"
    return [
        helper.make_node("Add", [scores, _COSTS], [with_costs]),
        helper.make_node("ReduceLogSumExp", [with_costs], [f"{name}_energy"], axes=[1]),
    ]


class Teachers:
    """Networks whose mean calibrated score is taught.

    Raises as `landing.classification.engine.OnnxClassifier`, and ValueError for a network of other
    classes than ``classes``."""

    def __init__(self, files: Sequence[Path], classes: Sequence[str], threads: int) -> None:
        self._networks = [OnnxClassifier(file, threads) for file in files]
        for file, network in zip(files, self._networks, strict=True):
            if tuple(network.facts.classes) != tuple(classes):
                raise ValueError(
                    f"'{file}' predicts {', '.join(network.facts.classes)}; name a teacher of the "
                    f"classes {', '.join(classes)}"
                )
        self.fingerprint = [crc32(file.read_bytes()) for file in files]
        """of each network's file"""

    def probabilities(self, images: Tensor) -> Tensor:
        """Returns class probabilities (B, C) of images (B, 3, S, S) in [0, 1], without the costs of
        misses."""
        seen = (255.0 * images).round().to(torch.uint8).permute(0, 2, 3, 1).cpu().numpy()
        found = [_costless(network, seen) for network in self._networks]
        mean = pooled(found, np.full(len(found), 1.0 / len(found)).tolist())
        return torch.softmax(torch.from_numpy(mean), dim=1).to(images.device)


def _costless(network: OnnxClassifier, images: NDArray[np.uint8]) -> Float32:
    """Returns the scores (N, C) of images (N, S, S, 3) of any size, without the costs of misses;
    images are averaged down to the size of the network."""
    size = (network.facts.image_size,) * 2
    scaled = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in images]
    return network.scores(np.stack(scaled).astype(np.uint8)) - miss_cost_logs(network.facts)


def taught(targets: Tensor, known: Tensor, given: Tensor, weight: float) -> Tensor:
    """Returns targets (B, C) that are those ``given`` (B, C) with ``weight``; ``known`` (B,) tells
    which images are of a class: the others keep theirs."""
    return torch.where(known[:, None], torch.lerp(targets, given, weight), targets)
