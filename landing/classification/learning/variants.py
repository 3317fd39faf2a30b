"""Trained networks with smaller weights: bfloat16 in place of float16, or int8 computation."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from touchdown.landing.classification.engine import as_input
from touchdown.landing.classification.weights import (
    INPUT,
    NetworkFacts,
    read_network,
    write_network,
)

Image = NDArray[np.uint8]

TYPES = ("float16", "bfloat16", "int8")
_BATCH = 16


def write_variant(source: Path, target: Path, weight_type: str, images: Image) -> None:
    """Writes the network of ``source`` with weights of ``weight_type`` to ``target``.

    ``int8`` scales weights by channel and activations by tensor; ``images`` (N, S, S, 3) give the
    ranges. Additions and products are computed in int8 where ONNX Runtime supports it. Raises
    ValueError for another type, or a file whose weights are not float16.
    """
    if weight_type not in TYPES:
        raise ValueError(f"unknown type '{weight_type}': give one of {', '.join(TYPES)}")
    model = onnx.load_from_string(read_network(source))
    if not any(value.data_type == TensorProto.FLOAT16 for value in model.graph.initializer):
        raise ValueError(
            f"'{source}' has no float16 weights: give the file that `touchdown train` wrote"
        )
    if weight_type == "bfloat16":
        _to_bfloat16(model.graph)
        content = model.SerializeToString(deterministic=True)
    elif weight_type == "int8":
        content = _int8(model, images)
    else:
        content = model.SerializeToString(deterministic=True)
    write_network(target, content)


def with_facts(path: Path, facts: NetworkFacts) -> None:
    """Replaces the metadata in a network's file."""
    model = onnx.load_from_string(read_network(path))
    del model.metadata_props[:]
    helper.set_model_props(model, facts.properties())
    write_network(path, model.SerializeToString(deterministic=True))


def _to_bfloat16(graph: onnx.GraphProto) -> None:
    """Rounds float16 weights to the upper 16 bits of a float32, half to even."""
    for value in graph.initializer:
        if value.data_type == TensorProto.FLOAT16:
            bits = numpy_helper.to_array(value).astype(np.float32).view(np.uint32)
            upper = (bits + 0x7FFF + ((bits >> 16) & 1)) >> 16
            rounded = onnx.TensorProto(
                name=value.name, data_type=TensorProto.BFLOAT16, dims=value.dims,
                raw_data=upper.astype("<u2").tobytes(),
            )  # fmt: skip
            value.CopyFrom(rounded)


class _CalibrationImages:
    """Feeds the calibration of ranges batch by batch."""

    def __init__(self, images: Image) -> None:
        size = images.shape[1]
        self._batches: Iterator[Image] = iter(
            [images[first : first + _BATCH] for first in range(0, len(images), _BATCH)]
        )
        self._size = size

    def get_next(self) -> dict[str, NDArray[np.float32]] | None:
        """Returns the next batch, None at the end."""
        batch = next(self._batches, None)
        return None if batch is None else {INPUT: as_input(batch, self._size)}


def _int8(model: onnx.ModelProto, images: Image) -> bytes:
    """Returns the model in int8. ONNX Runtime simplifies the graph first, which merges norms into
    the filters."""
    import onnxruntime
    from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType
    from onnxruntime.quantization import quantize_static as quantize

    CalibrationDataReader.register(_CalibrationImages)
    with tempfile.TemporaryDirectory() as folder:
        plain, simple, small = (
            Path(folder) / f"{name}.onnx" for name in ("plain", "simple", "int8")
        )
        onnx.save(model, plain)
        options = onnxruntime.SessionOptions()
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_BASIC
        options.optimized_model_filepath = str(simple)
        options.intra_op_num_threads = 1
        options.log_severity_level = 3
        onnxruntime.InferenceSession(plain, options, providers=["CPUExecutionProvider"])
        prepared = onnx.load(simple)
        # marks the step as done, else the quantizer warns
        prepared.metadata_props.add(key="onnx.quant.pre_process", value="onnxruntime.quant")
        onnx.save(prepared, simple)
        quantize(
            simple,
            small,
            _CalibrationImages(images),
            quant_format=QuantFormat.QDQ,
            per_channel=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
        )
        quantized = onnx.load(small)
    del quantized.metadata_props[:]
    quantized.metadata_props.extend(model.metadata_props)
    return quantized.SerializeToString(deterministic=True)
