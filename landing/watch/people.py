"""People, riders and animals in images of the downward camera, found by a small network.

The network is fully convolutional and marks the middle of everybody with the size of his box, as
CenterNet does (Zhou, Wang and Krähenbühl, "Objects as points", arXiv 1904.07850, 2019).
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from touchdown.sim.typing import Bytes, Float32

SIZE = (424, 240)
"""width and height of the network's images"""
STRIDE = 4
"""pixels of an image to a cell of its answer"""
LEAST = 0.35
"""score from which on somebody is there"""
_MOST = 32
_SAME = 0.3
"""overlap from which on two boxes are of one"""


class Person(NamedTuple):
    """Somebody in an image: least and greatest pixel, and the score, 0 to 1."""

    x0: float
    y0: float
    x1: float
    y1: float
    score: float


class PeopleDetector:
    """Finds people in images. Raises FileNotFoundError without the network, and ImportError without
    onnxruntime."""

    def __init__(self, network: Path, least_score: float = LEAST) -> None:
        import onnxruntime

        if not network.is_file():
            raise FileNotFoundError(
                f"'{network}' does not exist: `touchdown people train` makes a network of people"
            )
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        self._session = onnxruntime.InferenceSession(
            str(network), options, providers=["CPUExecutionProvider"]
        )
        self._least = least_score

    def find(self, image: Bytes) -> tuple[Person, ...]:
        """Who is in an image (H, W, 3) uint8 RGB, the surest first; pixels are the image's."""
        rows, cols = image.shape[:2]
        small = cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA)
        inputs = small.transpose(2, 0, 1)[None].astype(np.float32) / np.float32(255.0)
        heat, sizes = (
            np.asarray(found[0], np.float32) for found in self._session.run(None, {"image": inputs})
        )
        scale = cols / SIZE[0], rows / SIZE[1]
        return tuple(
            Person(x0 * scale[0], y0 * scale[1], x1 * scale[0], y1 * scale[1], score)
            for x0, y0, x1, y1, score in peaks(heat[0], sizes, self._least)
        )


def peaks(heat: Float32, sizes: Float32, least: float) -> list[tuple[float, ...]]:
    """Boxes (x0, y0, x1, y1, score) in pixels of the network's image at the peaks of ``heat``
    (h, w) above ``least``, the highest first; ``sizes`` (2, h, w): width and height in pixels."""
    around = cv2.dilate(heat, np.ones((3, 3), np.uint8))
    rows, cols = np.nonzero((heat >= around) & (heat >= least))
    order = np.argsort(-heat[rows, cols], kind="stable")[:_MOST]
    found: list[tuple[float, ...]] = []
    for row, col in zip(rows[order], cols[order], strict=True):
        x, y = (col + 0.5) * STRIDE, (row + 0.5) * STRIDE
        w, h = (max(float(size), 2.0) for size in sizes[:, row, col])
        box = (x - 0.5 * w, y - 0.5 * h, x + 0.5 * w, y + 0.5 * h, float(heat[row, col]))
        if all(overlap(box, other) < _SAME for other in found):
            found.append(box)
    return found


def overlap(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    """Intersection over union of two boxes (x0, y0, x1, y1, ...)."""
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    both = max(width, 0.0) * max(height, 0.0)
    union = (a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - both
    return both / union if union > 0.0 else 0.0
