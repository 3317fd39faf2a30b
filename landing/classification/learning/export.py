"""Export of torch networks to ONNX files.

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
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from touchdown.landing.classification.learning.training import normalised
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
