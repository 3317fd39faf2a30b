"""Trained networks with other metadata, and with int8 computation."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper

from touchdown.landing.classification.engine import as_input
from touchdown.landing.classification.weights import (
    INPUT,
    NetworkFacts,
    read_network,
    write_network,
)

Image = NDArray[np.uint8]

_BATCH = 16


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
