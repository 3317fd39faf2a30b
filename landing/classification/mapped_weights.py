"""Weights of a network as pages of its file, which the system can drop, and not as memory of this
process."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]

_GRAPH, _INITIALIZER = 7, 5
_SIZES, _TYPE, _NAME, _CONTENT = 1, 2, 8, 9
_FLOAT16 = 10
"""numbers of onnx.proto's ModelProto, GraphProto and TensorProto"""
_INTEGER, _EIGHT_BYTES, _BYTES = 0, 1, 2
"""of the wire format of Protocol Buffers"""


def float16_weights(path: Path) -> dict[str, NDArray[np.float16]]:
    """The float16 initializers of an ONNX file that lie at even places in it, by name, read-only.
    The file must stay as it is while they are in use."""
    found = {}
    for number, graph in _fields(np.memmap(path, np.uint8, "r")):
        for part, tensor in _fields(graph) if number == _GRAPH else ():
            if part != _INITIALIZER:
                continue
            fields = list(_fields(tensor))
            values = dict(fields)
            content = values.get(_CONTENT)
            if values[_TYPE] == _FLOAT16 and content is not None and content.ctypes.data % 2 == 0:
                sizes = [value for number, value in fields if number == _SIZES]
                found[values[_NAME].tobytes().decode()] = content.view(np.float16).reshape(sizes)
    return found


def _fields(message: Bytes) -> Iterator[tuple[int, Any]]:
    """Numbers and values, integers or bytes, of the fields of a message."""
    at = 0
    while at < len(message):
        key, at = _integer(message, at)
        if key & 7 == _INTEGER:
            value, at = _integer(message, at)
            yield key >> 3, value
            continue
        size = 8 if key & 7 == _EIGHT_BYTES else 4
        if key & 7 == _BYTES:
            size, at = _integer(message, at)
        yield key >> 3, message[at : at + size]
        at += size


def _integer(message: Bytes, at: int) -> tuple[int, int]:
    """The number at ``at``, seven bits a byte, and the place behind it."""
    value, shift = 0, 0
    while True:
        byte = int(message[at])
        value, shift, at = value | (byte & 127) << shift, shift + 7, at + 1
        if byte < 128:
            return value, at
