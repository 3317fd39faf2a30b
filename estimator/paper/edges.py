"""Edge energy of an image: how likely each pixel lies on a boundary, in [0, 1]."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

Rgb = NDArray[np.uint8]
Float32 = NDArray[np.float32]


class EdgeDetector(Protocol):
    """(H, W, 3) uint8 RGB -> (H, W) float32 energy in [0, 1]; deterministic."""

    def __call__(self, rgb: Rgb) -> Float32: ...


class GradientEdges:
    """Energy from colour gradients at two scales; no learned model.

    The largest Sobel magnitude over the channels, of the image and of its blurred form (which sees
    soft boundaries and forgets texture), combined by their geometric mean so that only what stands
    out at both counts. ``full_gradient``: grey levels per pixel that give energy 1. A fixed scale
    keeps the energy of a picture of grass low, which a scale by the picture's own maximum would
    not.
    """

    def __init__(self, full_gradient: float = 40.0, blur_sigma: float = 2.0) -> None:
        self._full_gradient = full_gradient
        self._blur_sigma = blur_sigma

    def __call__(self, rgb: Rgb) -> Float32:
        fine = _gradient(cv2.GaussianBlur(rgb, (3, 3), 0.8))
        coarse = _gradient(cv2.GaussianBlur(rgb, (0, 0), self._blur_sigma))
        # a step loses about blur_sigma of its slope at the coarse scale
        energy = np.sqrt(fine * coarse * self._blur_sigma) / self._full_gradient
        return np.minimum(energy, np.float32(1.0)).astype(np.float32)


def _gradient(rgb: NDArray[np.generic]) -> Float32:
    """Largest gradient over the channels (H, W), grey levels per pixel."""
    strongest = np.zeros(rgb.shape[:2], dtype=np.float32)
    for channel in cv2.split(np.asarray(rgb, dtype=np.uint8)):
        dx, dy = cv2.spatialGradient(channel)
        magnitude = cv2.magnitude(dx.astype(np.float32), dy.astype(np.float32))
        strongest = np.maximum(strongest, magnitude)
    # a Sobel kernel sums up eight times the slope
    return np.asarray(0.125 * strongest, dtype=np.float32)


class StructuredEdges:
    """The structured edge detector (Dollar and Zitnick 2013) by OpenCV's ``ximgproc``.

    ``model_path``: a model in OpenCV's gzipped YAML form; OpenCV ships none. Raises
    FileNotFoundError if there is no such file and ValueError if OpenCV cannot read it.
    """

    def __init__(self, model_path: Path | str) -> None:
        path = Path(model_path)
        if not path.is_file():
            raise FileNotFoundError(
                f"structured edge model '{path}' does not exist; give the path of a trained model "
                "or leave paper.edge_model empty for gradient edges"
            )
        try:
            self._detector = cv2.ximgproc.createStructuredEdgeDetection(str(path))
        except cv2.error as error:
            raise ValueError(
                f"structured edge model '{path}' is not one that OpenCV can read: "
                f"{str(error).splitlines()[0]}"
            ) from None

    def __call__(self, rgb: Rgb) -> Float32:
        scaled = rgb.astype(np.float32) / 255.0
        energy = np.asarray(self._detector.detectEdges(scaled), dtype=np.float32)
        return np.clip(energy, 0.0, 1.0)


def edge_detector(model_path: str) -> EdgeDetector:
    """``StructuredEdges`` of a model, or ``GradientEdges`` where the path is empty."""
    return StructuredEdges(model_path) if model_path else GradientEdges()
