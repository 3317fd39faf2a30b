"""Checkpoints of a training after every epoch, from which it resumes."""

from __future__ import annotations

import os
import pickle
import reprlib
import zipfile
from pathlib import Path
from typing import Any, Protocol
from zlib import crc32

import torch
from torch import Tensor, nn

from touchdown.landing.classification.learning.weights_file import load_weights, read_weights
from touchdown.landing.classification.networks.registry import load_pretrained
from touchdown.landing.classification.weights import SUFFIX
from touchdown.sim.files.opening import no_file

LAST, BEST = "last.pt", "best.pt"
IMAGENET = Path("imagenet")
"""in place of a folder: the weights for ImageNet that a package brings"""
MAX_BYTES = 4 << 30
_OTHER = {
    "data": "other images",
    "start": "other weights to begin with",
    "teachers": "other teachers",
}


class Resumable(Protocol):
    """A training that resumes from a checkpoint."""

    def take_state(self, state: dict[str, Any]) -> None:
        """Takes over the state of a checkpoint."""


def restore(trainer: Resumable, folder: Path, identity: dict[str, Any]) -> None:
    """Resumes from ``last.pt`` in ``folder``, if it exists. No other training may use the folder.

    Raises ValueError where it belongs to a training with other parameters or images, or cannot be
    read.
    """
    for name in (LAST, BEST):
        _partial(folder / name).unlink(missing_ok=True)  # of a training that was killed
    path = folder / LAST
    if no_file(path) == "does not exist":
        return
    state = _read(path)
    before = state.get("identity")
    if not isinstance(before, dict) or _history_fault(state):
        raise ValueError(f"'{path}' is not the checkpoint of a training; name another folder")
    for key, value in identity.items():
        if not _same(before.get(key), value):
            found = before.get(key)
            shown = found if isinstance(found, str | float | int) else reprlib.repr(found)
            what = _OTHER.get(key, f"{key} {shown}, not {value}")
            raise ValueError(f"'{folder}' holds a training with {what}; name another folder")
    try:
        trainer.take_state(state)
    except (RuntimeError, ValueError, KeyError, TypeError, AttributeError, IndexError):
        raise ValueError(
            f"'{path}' does not hold the state of this training; name another folder"
        ) from None


def _same(found: Any, value: Any) -> bool:
    try:
        return bool(found == value)
    except (RuntimeError, RecursionError):  # tensors, or lists that hold themselves
        return False


def _history_fault(state: dict[str, Any]) -> bool:
    """True where the epochs of a checkpoint are not what a training writes."""
    history, best = state.get("history"), state.get("best_epoch")
    if not isinstance(history, list):
        return True
    number = (int, float)
    return not (
        all(isinstance(row, dict) and "val_macro_f1" in row for row in history)
        and all(isinstance(k, str) and isinstance(v, number) for r in history for k, v in r.items())
        and isinstance(best, int)
        and -1 <= best < max(1, len(history))
    )


def write_last(folder: Path, state: dict[str, Any]) -> None:
    """Writes the checkpoint of the last epoch."""
    _write(folder / LAST, state)


def write_best(folder: Path, weights: dict[str, Any]) -> None:
    """Writes the weights of the best epoch."""
    _write(folder / BEST, weights)


def read_best(folder: Path) -> dict[str, Any]:
    """Returns the weights of the best epoch. Raises ValueError where they cannot be read, or are
    not weights."""
    path = folder / BEST
    weights = _read(path)
    named = all(isinstance(k, str) and isinstance(v, Tensor) for k, v in weights.items())
    if not named or not weights:
        raise ValueError(f"'{path}' holds something else than the weights of a network")
    if not all(bool(torch.isfinite(v).all()) for v in weights.values() if v.is_floating_point()):
        raise ValueError(f"'{path}' holds weights that are NaN or infinite; train anew")
    return weights


def begin_with(network: nn.Module, name: str, classes: tuple[str, ...], start: Path) -> None:
    """Loads the best weights of the training in the folder ``start``, or those of the network's
    file ``start``, or those for ImageNet where it is ``IMAGENET``.

    ``name`` and ``classes`` are of ``network``. Raises ValueError as ``read_best`` and
    ``read_weights``, and for weights of another network or of other classes."""
    if start == IMAGENET:
        load_pretrained(network, name)
        return
    other = ValueError(f"'{start}' holds weights of another network or of other classes")
    try:
        if start.suffix != SUFFIX:
            network.load_state_dict(read_best(start))
            return
        facts, weights = read_weights(start)
        if (facts.network, facts.classes) != (name, classes):
            raise other
        load_weights(network, weights, "network.")
    except RuntimeError:
        raise other from None


def fingerprint(start: Path) -> int:
    """Returns the CRC-32 of the best weights in a folder, or of a network's file; 0 for those for
    ImageNet."""
    if start == IMAGENET:
        return 0
    return crc32((start if start.suffix == SUFFIX else start / BEST).read_bytes())


def _partial(path: Path) -> Path:
    return path.with_name(f".{path.name}.partial")


def _write(path: Path, value: dict[str, Any]) -> None:
    partial = _partial(path)
    try:
        torch.save(value, partial)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def _read(path: Path) -> dict[str, Any]:
    """The content of a file that `torch.save` wrote: tensors, numbers and text, never code."""
    if reason := no_file(path):
        raise ValueError(
            f"'{path}' cannot be read as a checkpoint: it {reason}; name the folder of a training"
        )
    if not zipfile.is_zipfile(path):
        raise ValueError(f"'{path}' cannot be read as a checkpoint: it is none, or was cut short")
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > MAX_BYTES:
            raise ValueError(f"it has {size >> 20} MiB, more than {MAX_BYTES >> 20} MiB")
        value = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(value, dict) or _bytes_of(value) > MAX_BYTES:
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


def _bytes_of(value: Any) -> int:
    """Bytes of all tensors within, each as large as its shape says: a view may repeat a number.
    What a pickle names many times counts once, so that lists of lists end."""
    total, seen, waiting = 0, {id(value)}, [value]
    while waiting:
        part = waiting.pop()
        if isinstance(part, Tensor):
            total += part.numel() * part.element_size()
            continue
        for one in part.values() if isinstance(part, dict) else part:
            if isinstance(one, Tensor | dict | list | tuple) and id(one) not in seen:
                seen.add(id(one))
                waiting.append(one)
    return total
