"""Targets of a training from trained networks: a small network learns what several know together
(Hinton, Vinyals and Dean, 2015; Beyer et al., CVPR 2022: teachers see the same augmented images).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from zlib import crc32

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from touchdown.landing.classification.engine import OnnxClassifier, miss_cost_logs
from touchdown.landing.classification.learning.ensemble import pooled


class Teachers:
    """Networks whose mean calibrated score is taught.

    Raises as `landing.classification.engine.OnnxClassifier`, and ValueError for a network of other
    classes than ``classes``."""

    def __init__(self, files: Sequence[Path], classes: Sequence[str], threads: int) -> None:
        self._networks = [OnnxClassifier(file, threads) for file in files]
        for file, network in zip(files, self._networks, strict=True):
            if tuple(network.facts.classes) != tuple(classes):
                raise ValueError(
                    f"'{file}' predicts {', '.join(network.facts.classes)}; name a teacher of the "
                    f"classes {', '.join(classes)}"
                )
        self.fingerprint = [crc32(file.read_bytes()) for file in files]
        """of each network's file"""

    def probabilities(self, images: Tensor) -> Tensor:
        """Returns class probabilities (B, C) of images (B, 3, S, S) in [0, 1], without the costs of
        misses."""
        seen = (255.0 * images).round().to(torch.uint8).permute(0, 2, 3, 1).cpu().numpy()
        found = [_costless(network, seen) for network in self._networks]
        mean = pooled(found, np.full(len(found), 1.0 / len(found)).tolist())
        return torch.softmax(torch.from_numpy(mean), dim=1).to(images.device)


def _costless(network: OnnxClassifier, images: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Returns the scores (N, C) of images (N, S, S, 3) of any size, without the costs of misses;
    images are averaged down to the size of the network."""
    size = (network.facts.image_size,) * 2
    scaled = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in images]
    return network.scores(np.stack(scaled).astype(np.uint8)) - miss_cost_logs(network.facts)


def taught(targets: Tensor, known: Tensor, given: Tensor, weight: float) -> Tensor:
    """Returns targets (B, C) that are those ``given`` (B, C) with ``weight``; ``known`` (B,) tells
    which images are of a class: the others keep theirs."""
    return torch.where(known[:, None], torch.lerp(targets, given, weight), targets)
