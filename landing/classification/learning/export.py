"""Network files: export of torch networks, other metadata, and int8 computation.

Matrices and filters are stored as float16 under their torch names and cast to float32 before use;
biases and the parameters of the norms stay float32, a thousandth of the file.
"""

import tempfile
import warnings
from pathlib import Path

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from touchdown.landing.classification.engine import as_input
from touchdown.landing.classification.learning.training import normalised
from touchdown.landing.classification.weights import (
    INPUT,
    OUTPUT,
    NetworkFacts,
    read_network,
    write_network,
)
from touchdown.sim.typing import Image

_OPSET = 17
_CAST = "/float32"
_BATCH = 16
"""images that int8 is calibrated with at a time"""


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


def write_variant(source: Path, target: Path, weight_type: str, images: Image) -> None:
    """Writes the network of ``source`` with weights of ``weight_type``, ``float16`` or ``int8``, to
    ``target``.

    ``int8`` scales weights by channel and activations by tensor; ``images`` (N, S, S, 3) give the
    ranges. Additions and products are computed in int8 where ONNX Runtime supports it. Raises
    ValueError for a file whose weights are not float16.
    """
    content = read_network(source)
    model = onnx.load_from_string(content)
    if not any(value.data_type == TensorProto.FLOAT16 for value in model.graph.initializer):
        raise ValueError(
            f"'{source}' has no float16 weights: give the file that `touchdown train` wrote"
        )
    write_network(target, _int8(model, images) if weight_type == "int8" else content)


def with_facts(path: Path, facts: NetworkFacts) -> None:
    """Replaces the metadata in a network's file."""
    model = onnx.load_from_string(read_network(path))
    del model.metadata_props[:]
    helper.set_model_props(model, facts.properties())
    write_network(path, model.SerializeToString(deterministic=True))


def _int8(model: onnx.ModelProto, images: Image) -> bytes:
    """Returns the model in int8. ONNX Runtime simplifies the graph first, which merges norms into
    the filters."""
    from onnxruntime.quantization import CalibrationDataReader, QuantType, quantize_static
    from onnxruntime.quantization.shape_inference import quant_pre_process

    class Batches(CalibrationDataReader):  # type: ignore[misc]
        """Feeds the calibration of ranges batch by batch."""

        def get_next(self) -> dict[str, NDArray[np.float32]] | None:
            batch = next(batches, None)
            return None if batch is None else {INPUT: batch}

    inputs = as_input(images, images.shape[1])
    batches = iter([inputs[i : i + _BATCH] for i in range(0, len(inputs), _BATCH)])
    with tempfile.TemporaryDirectory() as folder:
        simple, small = Path(folder) / "simple.onnx", Path(folder) / "int8.onnx"
        quant_pre_process(model, simple, skip_symbolic_shape=True)
        quantize_static(
            simple,
            small,
            Batches(),
            per_channel=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
        )
        quantized = onnx.load(small)
    del quantized.metadata_props[:]
    quantized.metadata_props.extend(model.metadata_props)
    return quantized.SerializeToString(deterministic=True)
