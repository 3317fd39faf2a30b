"""A ground classifier: the nearest colour of ground, without a network.

touchdown land flat --classifier examples.colours:build
"""

import numpy as np

from touchdown.landing.api import ClassifierRig, GroundPrediction

COLOURS = {
    "lawn": (106, 126, 70), "field": (168, 132, 98), "path": (196, 180, 156), "road": (96, 97, 102),
    "building": (156, 84, 72), "water": (58, 84, 108), "trees": (44, 66, 34),
}  # fmt: skip
"""mean RGB of daylight"""


class NearestColour:
    """Compares the mean chromaticity and brightness of an image with those of ``COLOURS``."""

    image_size = 32
    min_probability = 0.6

    def __init__(self, params: dict, rig: ClassifierRig) -> None:
        self.spread = params.get("spread", 0.05)
        known = np.array([COLOURS[name] for name in rig.classes], float)
        self.known = self.features(known)

    def features(self, rgb: np.ndarray) -> np.ndarray:
        """(N, 3): fractions of red and green, and brightness with less weight than these."""
        total = rgb.sum(axis=1, keepdims=True) + 1.0
        return np.hstack([rgb[:, :2] / total, 0.1 * total / 765.0])

    def classify(self, images: np.ndarray) -> GroundPrediction:
        means = images.reshape(len(images), -1, 3).astype(float).mean(axis=1)
        offsets = self.features(means)[:, None] - self.known
        squared = (offsets**2).sum(axis=2) / (2.0 * self.spread**2)
        likelihood = np.exp(squared.min(axis=1, keepdims=True) - squared)
        return GroundPrediction(
            probabilities=likelihood / likelihood.sum(axis=1, keepdims=True),
            in_distribution=squared.min(axis=1) < 8.0,
        )


def build(params: dict, rig: ClassifierRig) -> NearestColour:
    return NearestColour(params, rig)
