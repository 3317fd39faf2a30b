"""Export of torch networks to ONNX files, and their import into torch.

Matrices and filters are stored as float16 under their torch names and cast to float32 before use;
biases and the parameters of the norms stay float32, a thousandth of the file.
"""

from __future__ import annotations

import tempfile
import warnings
from pathlib import Path

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from touchdown.landing.classification.engine import apply_miss_costs, as_input
from touchdown.landing.classification.learning.training import normalised
from touchdown.landing.classification.learning.weights_file import load_weights, read_weights
from touchdown.landing.classification.networks.registry import build_network
from touchdown.landing.classification.weights import INPUT, OUTPUT, NetworkFacts, write_network

_OPSET = 17
_CAST = "/float32"


class Calibrated(nn.Module):
    """A network that maps images in [0, 1] to scores whose softmax is a calibrated probability."""

    temperature: Tensor

    def __init__(self, network: nn.Module, temperature: float) -> None:
        super().__init__()
        self.network = network
        self.register_buffer("temperature", torch.tensor([temperature]))

    def forward(self, images: Tensor) -> Tensor:
        """Returns scores (B, C) of images (B, 3, S, S)."""
        scores: Tensor = self.network(normalised(images))
        return scores / self.temperature


def export_network(path: Path, network: nn.Module, temperature: float, facts: NetworkFacts) -> None:
    """Writes ``network`` to ``path``, and its checksum."""
    module = Calibrated(network, temperature).eval()
    size = facts.image_size
    with warnings.catch_warnings(), tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "network.onnx"
        # torch warns in favour of its newer exporter, which renames weights
        warnings.simplefilter("ignore")
        torch.onnx.export(
            module,
            (torch.zeros(1, 3, size, size),),
            target,
            dynamo=False,
            # the norms stay what they are, so that torch can read its own weights back
            training=torch.onnx.TrainingMode.PRESERVE,
            do_constant_folding=False,
            input_names=[INPUT],
            output_names=[OUTPUT],
            dynamic_axes={INPUT: {0: "batch"}, OUTPUT: {0: "batch"}},
            opset_version=_OPSET,
        )
        model = onnx.load(target)
    _halve(model.graph)
    helper.set_model_props(model, facts.properties())
    onnx.checker.check_model(model)
    write_network(path, model.SerializeToString(deterministic=True))


def _halve(graph: onnx.GraphProto) -> None:
    """Converts initial values of two or more dimensions to float16, with a cast where they are
    used."""
    casts = {}
    for value in graph.initializer:
        if value.data_type == TensorProto.FLOAT and len(value.dims) >= 2:
            half = numpy_helper.to_array(value).astype(np.float16)
            value.CopyFrom(numpy_helper.from_array(half, value.name))
            casts[value.name] = value.name + _CAST
    for node in graph.node:
        for place, name in enumerate(node.input):
            if name in casts:
                node.input[place] = casts[name]
    nodes = [
        helper.make_node("Cast", [name], [cast], to=TensorProto.FLOAT)
        for name, cast in casts.items()
    ]
    kept = list(graph.node)
    del graph.node[:]
    graph.node.extend(nodes + kept)


class TorchClassifier:
    """A network's file in torch.

    Raises ValueError and FileNotFoundError as `landing.classification.weights.read_network`.
    """

    def __init__(self, path: Path, device: torch.device | None = None) -> None:
        self.facts, weights = read_weights(path)
        self._device = device or torch.device("cpu")
        network = build_network(self.facts.network, len(self.facts.classes), self.facts.image_size)
        self._module = Calibrated(network, 1.0)
        try:
            load_weights(self._module, weights)
        except RuntimeError:
            raise ValueError(
                f"'{path}' does not hold the weights of a {self.facts.network}"
            ) from None
        self._module.eval().to(self._device)

    def scores(self, images: NDArray[np.uint8]) -> NDArray[np.float32]:
        """As `landing.classification.engine.Classifier.scores`."""
        inputs = torch.from_numpy(as_input(images, self.facts.image_size))
        with torch.inference_mode():
            scores: Tensor = self._module(inputs.to(self._device))
        return apply_miss_costs(scores.float().cpu().numpy(), self.facts)
