"""People, riders and animals in images of the downward camera, found by a small network.

The network is fully convolutional and marks the middle of everybody with the size of his box, as
CenterNet does (Zhou, Wang and Krähenbühl, "Objects as points", arXiv 1904.07850, 2019).
"""

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from touchdown.sim.typing import Bytes, Float32

PIXEL_M = 0.04
"""metres on the ground of a pixel of the network's images: everybody has one size, from any height
but the lowest"""
LEAST_WIDTH = 128
"""pixels of the smallest of the network's images, which show less on a pixel"""
STRIDE = 4
"""pixels of an image to a cell of its answer"""
_COARSEST = 16
"""pixels of which an image has a whole number along both sides"""
_GREY, _GAINS = 0.4, (0.7, 5.0)
"""mean that an image is brought to, and by which factors"""
LEAST, SURE = 0.4, 0.55
"""score from which on somebody is there whom two images show, and one image alone"""
SHIPPED = Path(__file__).with_name("trained") / "people.onnx"
"""the network that is shipped with the project"""
_MAYBE = 0.7
"""part of the least score from which on a second look may find somebody"""
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

    def find(self, image: Bytes, metres_per_pixel: float) -> tuple[Person, ...]:
        """Who is in an image (H, W, 3) uint8 RGB, the surest first; pixels are the image's.
        ``metres_per_pixel``: of it, on the ground below. Where somebody may be, a second look at
        the image upside down counts as much as the first."""
        small = resampled(image, metres_per_pixel)
        inputs = levelled(small)
        heat, sizes = self._answer(inputs)
        if heat.max() >= _MAYBE * self._least:
            turned, _ = self._answer(inputs[::-1, ::-1])
            heat = np.ascontiguousarray(0.5 * (heat + turned[::-1, ::-1]))
        scale = image.shape[1] / small.shape[1], image.shape[0] / small.shape[0]
        return tuple(
            Person(x0 * scale[0], y0 * scale[1], x1 * scale[0], y1 * scale[1], score)
            for x0, y0, x1, y1, score in peaks(heat, sizes, self._least)
        )

    def _answer(self, image: Float32) -> tuple[Float32, Float32]:
        """(h, w) heat and (2, h, w) sizes of an image (H, W, 3)."""
        inputs = np.ascontiguousarray(image.transpose(2, 0, 1)[None])
        heat, sizes = self._session.run(None, {"image": inputs})
        return np.asarray(heat[0, 0], np.float32), np.asarray(sizes[0], np.float32)


def resampled(image: Bytes, metres_per_pixel: float) -> Bytes:
    """An image (H, W, 3) at the network's scale."""
    scale = max(metres_per_pixel / PIXEL_M, LEAST_WIDTH / image.shape[1])
    rows, cols = (
        max(round(min(scale, 1.0) * side / _COARSEST), 1) * _COARSEST for side in image.shape[:2]
    )
    return np.asarray(cv2.resize(image, (cols, rows), interpolation=cv2.INTER_AREA), np.uint8)


def levelled(image: Bytes) -> Float32:
    """(H, W, 3) an image about 0, of one brightness by day and by night."""
    gain = float(np.clip(_GREY * 255.0 / max(float(image.mean()), 1.0), *_GAINS))
    return image.astype(np.float32) * np.float32(gain / 255.0) - np.float32(_GREY)


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
