"""Reading the weights of a network's file under their torch names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from onnx.external_data_helper import uses_external_data
from torch import Tensor, nn

from touchdown.landing.classification.weights import NetworkFacts, facts_of, read_network


def read_weights(path: Path) -> tuple[NetworkFacts, dict[str, Tensor]]:
    """Returns the metadata of a file and its arrays (float32) by name.

    Raises ValueError and FileNotFoundError as `landing.classification.weights.read_network`, and
    ValueError for a file that is not a network."""
    content = read_network(path)
    try:
        model = onnx.load_from_string(content)
    except Exception as error:  # protobuf's own class moves between versions
        raise ValueError(f"'{path}' cannot be loaded as a network: {error}") from error
    facts = facts_of({p.key: p.value for p in model.metadata_props}, path)
    if any(uses_external_data(value) for value in model.graph.initializer):
        raise ValueError(f"'{path}' keeps its weights in another file; save it as one file")
    try:
        given = {value.name: numpy_helper.to_array(value) for value in model.graph.initializer}
    except (ValueError, TypeError, KeyError, MemoryError) as error:
        raise ValueError(f"'{path}' has weights that cannot be read: {error}") from error
    # the exporter gives values that are equal one name, and an Identity for each other
    for node in model.graph.node:
        if node.op_type == "Identity" and node.input[0] in given:
            given[node.output[0]] = given[node.input[0]]
    return facts, {
        name: torch.from_numpy(values.astype(np.float32))
        for name, values in given.items()
        if values.dtype.kind == "f"
    }


def load_weights(module: nn.Module, given: dict[str, Tensor], prefix: str = "") -> None:
    """Loads the weights of ``module`` by name after ``prefix``; counters of the norms are not in a
    file. Raises ValueError where a weight is missing, RuntimeError where one has another shape."""
    state = module.state_dict()
    for name, own in state.items():
        if prefix + name in given:
            state[name] = given[prefix + name]
        elif own.is_floating_point():
            raise ValueError(f"the file lacks the weights '{prefix + name}'")
    module.load_state_dict(state)
