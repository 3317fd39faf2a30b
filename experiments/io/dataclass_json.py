"""Dataclasses of numbers as plain JSON and back, equal to the bit.

Not by pydantic: it has no schema for the numpy arrays of `sim.api`, whose dtype, NaN and infinity
must survive.
"""

import dataclasses
import functools
import types
import typing
from typing import Any

import numpy as np


def to_plain(value: Any) -> Any:
    """Dicts, lists, numbers and text of a dataclass. Their JSON text keeps every float64; a vector
    of float64 becomes a list, any other array a dict with dtype and shape."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {
            field.name: to_plain(getattr(value, field.name)) for field in dataclasses.fields(value)
        }
    if isinstance(value, np.ndarray):
        if value.dtype == np.float64 and value.ndim == 1:
            return value.tolist()
        return {
            "dtype": value.dtype.str,
            "shape": list(value.shape),
            "data": value.ravel().tolist(),
        }
    if isinstance(value, tuple | list):
        return [to_plain(item) for item in value]
    if isinstance(value, np.generic):
        return value.item()
    return value


def from_plain(kind: Any, plain: Any) -> Any:
    """Value of type ``kind`` from the output of ``to_plain``. A field that ``plain`` lacks gets
    its default. Raises TypeError or KeyError if ``plain`` does not fit ``kind``."""
    if plain is None and kind is not Any and types.NoneType in typing.get_args(kind):
        return None
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        hints = _hints(kind)
        known = {name: from_plain(hints[name], plain[name]) for name in hints if name in plain}
        return typing.cast(Any, kind)(**known)
    origin = typing.get_origin(kind)
    if origin in (typing.Union, types.UnionType):
        (inner,) = [part for part in typing.get_args(kind) if part is not type(None)]
        return from_plain(inner, plain)
    if origin is np.ndarray or kind is np.ndarray:
        return _array(plain)
    if origin is tuple:
        parts = typing.get_args(kind)
        if len(parts) == 2 and parts[1] is Ellipsis:
            return tuple(from_plain(parts[0], item) for item in plain)
        return tuple(from_plain(part, item) for part, item in zip(parts, plain, strict=True))
    wanted = _SCALARS.get(kind)
    if wanted is not None and type(plain) not in wanted:
        raise TypeError(f"{plain!r} is no {kind.__name__}")
    return plain


_SCALARS: dict[Any, tuple[type, ...]] = {
    int: (int,),
    float: (float, int),
    bool: (bool,),
    str: (str,),
}


def _array(plain: Any) -> np.ndarray:
    if isinstance(plain, list):
        array = np.array(plain, dtype=np.float64)
    else:
        array = np.array(plain["data"], dtype=np.dtype(plain["dtype"])).reshape(plain["shape"])
    array.setflags(write=False)
    return array


@functools.cache
def _hints(kind: type) -> dict[str, Any]:
    """Resolved types of the fields of a dataclass."""
    hints = typing.get_type_hints(kind)
    return {field.name: hints[field.name] for field in dataclasses.fields(kind)}
