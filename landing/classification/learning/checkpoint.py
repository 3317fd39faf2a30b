"""Checkpoints of a training after every epoch, from which it resumes."""

from __future__ import annotations

import os
import pickle
from pathlib import Path
from typing import Any, Protocol
from zlib import crc32

import torch
from torch import nn

from touchdown.landing.classification.learning.weights_file import load_weights, read_weights
from touchdown.landing.classification.weights import SUFFIX

LAST, BEST = "last.pt", "best.pt"
_OTHER = {"data": "other images", "start": "other weights to begin with"}


class Resumable(Protocol):
    """A training that resumes from a checkpoint."""

    def take_state(self, state: dict[str, Any]) -> None:
        """Takes over the state of a checkpoint."""


def restore(trainer: Resumable, folder: Path, identity: dict[str, Any]) -> None:
    """Resumes from ``last.pt`` in ``folder``, if it exists. No other training may use the folder.

    Raises ValueError where it belongs to a training with other parameters or images, or cannot be
    read.
    """
    for left in folder.glob(".*.pt.partial*"):
        left.unlink(missing_ok=True)  # of a training that was killed
    path = folder / LAST
    if not path.is_file():
        return
    state = _read(path)
    before = state["identity"]
    for key, value in identity.items():
        if before.get(key) != value:
            what = _OTHER[key] if key in _OTHER else f"{key} {before.get(key)}, not {value}"
            raise ValueError(f"'{folder}' holds a training with {what}; name another folder")
    trainer.take_state(state)


def write_last(folder: Path, state: dict[str, Any]) -> None:
    """Writes the checkpoint of the last epoch."""
    _write(folder / LAST, state)


def write_best(folder: Path, weights: dict[str, Any]) -> None:
    """Writes the weights of the best epoch."""
    _write(folder / BEST, weights)


def read_best(folder: Path) -> dict[str, Any]:
    """Returns the weights of the best epoch. Raises ValueError where they cannot be read."""
    return _read(folder / BEST)


def begin_with(network: nn.Module, name: str, classes: tuple[str, ...], start: Path) -> None:
    """Loads the best weights of the training in the folder ``start``, or those of the network's
    file ``start``.

    ``name`` and ``classes`` are of ``network``. Raises ValueError as ``read_best`` and
    ``read_weights``, and for weights of another network or of other classes."""
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
    """Returns the CRC-32 of the best weights in a folder, or of a network's file."""
    return crc32((start if start.suffix == SUFFIX else start / BEST).read_bytes())


def _write(path: Path, value: dict[str, Any]) -> None:
    partial = path.with_name(f".{path.name}.partial")
    try:
        torch.save(value, partial)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def _read(path: Path) -> dict[str, Any]:
    try:
        value: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, ValueError, EOFError, pickle.UnpicklingError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"'{path}' cannot be read as a checkpoint: {reason}") from error
    return value
