"""Targets of a training from trained networks: a small network learns what several know together
(Hinton, Vinyals and Dean, 2015; Beyer et al., CVPR 2022: teachers see the same augmented images).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from zlib import crc32

import numpy as np
import torch
from torch import Tensor

from touchdown.landing.classification.ensemble import costless, files_of, load_network, pooled


class Teachers:
    """Networks whose mean calibrated score is taught.

    Raises as `landing.classification.ensemble.load_network`, and ValueError for a network of other
    classes than ``classes``."""

    def __init__(self, files: Sequence[Path], classes: Sequence[str], threads: int) -> None:
        self._networks = [load_network(file, threads) for file in files]
        for file, network in zip(files, self._networks, strict=True):
            if tuple(network.facts.classes) != tuple(classes):
                raise ValueError(
                    f"'{file}' predicts {', '.join(network.facts.classes)}; name a teacher of the "
                    f"classes {', '.join(classes)}"
                )
        parts = [part for file in files for part in files_of(file)]
        self.fingerprint = [crc32(part.read_bytes()) for part in parts]
        """of each network's file"""

    def probabilities(self, images: Tensor) -> Tensor:
        """Returns class probabilities (B, C) of images (B, 3, S, S) in [0, 1], without the costs of
        misses."""
        seen = (255.0 * images).round().to(torch.uint8).permute(0, 2, 3, 1).cpu().numpy()
        found = [costless(network, seen) for network in self._networks]
        mean = pooled(found, np.full(len(found), 1.0 / len(found)).tolist())
        return torch.softmax(torch.from_numpy(mean), dim=1).to(images.device)


def taught(targets: Tensor, known: Tensor, given: Tensor, share: float) -> Tensor:
    """Returns targets (B, C) that are those ``given`` (B, C) to ``share``; ``known`` (B,) tells
    which images are of a class: the others keep theirs."""
    return torch.where(known[:, None], torch.lerp(targets, given, share), targets)
