"""The checkpoint of a training, from which it resumes, and the weights that one begins with."""

import json
import os
import pickle
import reprlib
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol
from zlib import crc32

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from onnx.external_data_helper import uses_external_data
from torch import Tensor, nn

from touchdown.landing.classification.networks.registry import load_pretrained
from touchdown.landing.classification.weights import (
    SUFFIX,
    NetworkFacts,
    facts_of,
    read_network,
)
from touchdown.sim.files.opening import no_file

LAST = "last.pt"
IMAGENET = Path("imagenet")
"""in place of a folder: the weights for ImageNet that a package brings"""
NETWORK = "network.onnx"
"""name of the network's file in the folder of a training"""
MAX_BYTES = 4 << 30
_PREFIX = "network."
"""of names in a network's file"""
_OTHER = {
    "data": "other images",
    "start": "other weights to begin with",
    "teachers": "other teachers",
}


class Resumable(Protocol):
    """A training that resumes from a checkpoint."""

    history: list[dict[str, float]]
    best_epoch: int

    def take_state(self, state: dict[str, Any]) -> None:
        """Takes over the weights of a checkpoint."""


def restore(trainer: Resumable, folder: Path, identity: Mapping[str, Any]) -> None:
    """Resumes from ``last.pt`` in ``folder``, if it exists. No other training may use the folder.

    ``identity``, of numbers and text, is that of the training. Raises ValueError where the
    checkpoint belongs to a training with other parameters or images, or cannot be read.
    """
    path = folder / LAST
    _partial(path).unlink(missing_ok=True)  # of a training that was killed
    if no_file(path) == "does not exist":
        return
    state = _read(path)
    try:
        before, history, best = _course(state)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise ValueError(
            f"'{path}' is not the checkpoint of a training; name another folder"
        ) from None
    for key, value in json.loads(json.dumps(identity)).items():
        if key not in before or before[key] != value:
            found = reprlib.repr(before.get(key))
            what = _OTHER.get(key, f"{key} {found}, not {value!r}")
            raise ValueError(f"'{folder}' holds a training with {what}; name another folder")
    try:
        trainer.take_state(state)
    except (RuntimeError, ValueError, KeyError, TypeError, AttributeError, IndexError):
        raise ValueError(
            f"'{path}' does not hold the state of this training; name another folder"
        ) from None
    trainer.history, trainer.best_epoch = history, best


def write(trainer: Resumable, folder: Path, identity: Mapping[str, Any], state: Any) -> None:
    """Writes the checkpoint of the last epoch; ``state`` holds the weights."""
    course = {
        "identity": identity, "history": trainer.history, "best_epoch": trainer.best_epoch,
    }  # fmt: skip
    path = folder / LAST
    partial = _partial(path)
    try:
        torch.save({"course": json.dumps(course), **state}, partial)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def _course(state: dict[str, Any]) -> tuple[dict[str, Any], list[dict[str, float]], int]:
    """Returns identity, history and best epoch. Raises an error for anything else."""
    course = json.loads(state["course"])
    best = int(course["best_epoch"])
    history = [{key: float(value) for key, value in row.items()} for row in course["history"]]
    if not -1 <= best < max(1, len(history)) or any("val_macro_f1" not in row for row in history):
        raise ValueError("these are no epochs of a training")
    return dict(course["identity"]), history, best


def begin_with(network: nn.Module, name: str, classes: tuple[str, ...], start: Path) -> None:
    """Loads the weights of the network's file ``start``, or of that in the folder ``start`` of a
    training, or those for ImageNet where it is ``IMAGENET``.

    ``name`` and ``classes`` are of ``network``. Raises ValueError as ``read_weights``, and for
    weights of another network or of other classes."""
    if start == IMAGENET:
        load_pretrained(network, name)
        return
    facts, weights = read_weights(_file_of(start))
    other = ValueError(f"'{start}' holds weights of another network or of other classes")
    if (facts.network, facts.classes) != (name, classes):
        raise other
    if not finite(weights):
        raise ValueError(f"'{start}' holds weights that are NaN or infinite; train anew")
    try:
        load_weights(network, weights)
    except RuntimeError:
        raise other from None


def finite(weights: Mapping[str, Tensor]) -> bool:
    """True where no number of the weights is NaN or infinite."""
    return all(bool(torch.isfinite(values).all()) for values in weights.values())


def fingerprint(start: Path) -> int:
    """Returns the CRC-32 of the file that a training begins with; 0 for the weights for
    ImageNet."""
    return 0 if start == IMAGENET else crc32(_file_of(start).read_bytes())


def _file_of(start: Path) -> Path:
    return start if start.suffix == SUFFIX else start / NETWORK


def _partial(path: Path) -> Path:
    return path.with_name(f".{path.name}.partial")


def _read(path: Path) -> dict[str, Any]:
    """The content of a file that `torch.save` wrote: tensors, numbers and text, never code."""
    if reason := no_file(path):
        raise ValueError(f"'{path}' {reason}; name another folder")
    if not zipfile.is_zipfile(path):
        raise ValueError(f"'{path}' cannot be read as a checkpoint: it is none, or was cut short")
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > MAX_BYTES:
            raise ValueError(f"it has {size >> 20} MiB, more than {MAX_BYTES >> 20} MiB")
        value = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(value, dict):
            raise ValueError("it holds something else than weights")
    except pickle.UnpicklingError as error:
        raise ValueError(
            f"'{path}' cannot be read as a checkpoint: it holds something else than weights, which "
            "is not loaded"
        ) from error
    except Exception as error:  # damaged archives raise errors of many kinds
        if isinstance(error, OSError) and error.errno:
            raise
        reason = str(error).splitlines()[0] if str(error) else "it is damaged"
        raise ValueError(f"'{path}' cannot be read as a checkpoint: {reason}") from error
    return value


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


def load_weights(module: nn.Module, given: dict[str, Tensor]) -> None:
    """Loads the weights of ``module`` by name; counters of the norms are not in a file.

    Raises ValueError where a weight is missing, RuntimeError where one has another shape."""
    state = module.state_dict()
    for name, own in state.items():
        if _PREFIX + name in given:
            state[name] = given[_PREFIX + name]
        elif own.is_floating_point():
            raise ValueError(f"the file lacks the weights '{_PREFIX + name}'")
    module.load_state_dict(state)
