"""Edge energy of an image: how likely each pixel lies on a boundary, in [0, 1]."""

import gzip
import re
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.sim.files.opening import no_file
from touchdown.sim.typing import Bytes, Float32

SHIPPED_MODEL = Path(__file__).with_name("structured_edges.yml.gz")
"""a structured forest trained on images of this project's scenes"""

OPTIONS = ("stride", "patchSize", "patchInnerSize", "shrinkNumber", "numberOfTrees",
           "numberOfTreesToEvaluate", "selfsimilarityGridSize", "numberOfGradientOrientations",
           "gradientNormalizationRadius", "gradientSmoothingRadius", "regFeatureSmoothingRadius",
           "ssFeatureSmoothingRadius")  # fmt: skip
SECTIONS = ("childs", "featureIds", "thresholds", "edgeBoundaries", "edgeBins")
_MAX_BYTES = 256 << 20
"""size of a model unpacked; the shipped one has 10 MiB"""


def check_model(path: Path) -> None:
    """Raises FileNotFoundError or ValueError, one sentence, unless ``path`` holds a whole model:
    OpenCV itself takes a truncated file for a smaller forest, or crashes."""
    if reason := no_file(path):
        raise FileNotFoundError(
            f"structured edge model '{path}' {reason}: give the path of a trained model, or "
            "'gradient' for edges without one"
        )
    try:
        with gzip.open(path) as file:
            text = file.read(_MAX_BYTES + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise ValueError(
            f"structured edge model '{path}' is damaged ({error}): restore it"
        ) from None
    if len(text) > _MAX_BYTES:
        raise ValueError(
            f"structured edge model '{path}' has more than {_MAX_BYTES >> 20} MiB unpacked: give a "
            "smaller one"
        )
    fault = _fault(text.decode("ascii", errors="replace"))
    if fault:
        raise ValueError(f"structured edge model '{path}' is not one that OpenCV can use: {fault}")


def _fault(text: str) -> str:
    """Returns the defect of the model, or an empty string."""
    if not text.startswith("%YAML"):
        return "it is not OpenCV's YAML"
    head = text[:4000]
    options = {}
    for name in OPTIONS:
        found = re.search(rf"^\s+{name}:\s*(\d+)\s*$", head, re.MULTILINE)
        if not found:
            return f"it has no option {name}"
        options[name] = int(found.group(1))
    starts = [text.find(f"\n{section}:") for section in SECTIONS]
    missing = [name for name, start in zip(SECTIONS, starts, strict=True) if start < 0]
    if missing or starts != sorted(starts):
        return f"it has no section {missing[0]}" if missing else "its sections are out of order"
    lengths = {}
    for section, begin, end in zip(SECTIONS, starts, [*starts[1:], len(text)], strict=True):
        # a sequence of n numbers has n - 1 commas
        lengths[section] = text.count(",", begin, end) + text.count("[", begin, end)
    nodes = lengths["childs"]
    trees = options["numberOfTrees"]
    if trees < 1 or nodes % trees or lengths["featureIds"] != nodes:
        return "its trees are not of one size"
    if lengths["thresholds"] != nodes or lengths["edgeBoundaries"] != nodes + 1:
        return "its sections do not fit together"
    return ""


RIM = 8
"""pixels, even, that the structured detector sees beyond the image's border"""


EdgeDetector = Callable[[Bytes], Float32]
"""(H, W, 3) uint8 RGB -> (H, W) float32 energy in [0, 1]; deterministic"""


class GradientEdges:
    """Energy from colour gradients at two scales; no learned model.

    The largest Sobel magnitude over the channels, of the image and of its blurred form (which sees
    soft boundaries and forgets texture), combined by their geometric mean so that only what stands
    out at both counts. ``full_gradient``: grey levels per pixel that give energy 1. A fixed scale
    keeps the energy of an image of grass low, which a scale by the image's own maximum would
    not.
    """

    def __init__(self, full_gradient: float = 40.0, blur_sigma: float = 2.0) -> None:
        self._full_gradient = full_gradient
        self._blur_sigma = blur_sigma

    def __call__(self, rgb: Bytes) -> Float32:
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
    """The structured edge detector (Dollar and Zitnick 2015) by OpenCV's ``ximgproc``.

    ``model_path``: a model in OpenCV's gzipped YAML form.
    ``full_energy``: fraction of votes that counts as energy 1; trees that disagree by a pixel about
    where a certain boundary lies spread their votes, so that none gets them all. Raises
    FileNotFoundError if there is no such file and ValueError if it is damaged or no model.
    """

    def __init__(self, model_path: Path | str = SHIPPED_MODEL, full_energy: float = 0.4) -> None:
        self._full_energy = np.float32(full_energy)
        path = Path(model_path)
        self._detector = _shipped() if path == SHIPPED_MODEL else _read(path)

    def __call__(self, rgb: Bytes) -> Float32:
        # the outermost patches overlap less and would give weaker edges: mirror the rim
        height, width = rgb.shape[:2]
        below, right = RIM + height % 2, RIM + width % 2
        framed = cv2.copyMakeBorder(rgb, RIM, below, RIM, right, cv2.BORDER_REFLECT)
        energy = self._detector.detectEdges(framed.astype(np.float32) / np.float32(255.0))
        inner = np.asarray(energy, np.float32)[RIM : RIM + height, RIM : RIM + width]
        return np.clip(inner / self._full_energy, 0.0, 1.0)


def _read(path: Path) -> cv2.ximgproc.StructuredEdgeDetection:
    check_model(path)
    try:
        return cv2.ximgproc.createStructuredEdgeDetection(str(path))
    except cv2.error as error:
        raise ValueError(
            f"structured edge model '{path}' is not one that OpenCV can read: "
            f"{str(error).splitlines()[0]}"
        ) from None


@cache
def _shipped() -> cv2.ximgproc.StructuredEdgeDetection:
    """Keeps nothing of the images it sees, so that one serves all flights of a process."""
    return _read(SHIPPED_MODEL)


def edge_detector(model: str) -> EdgeDetector:
    """The detector by name: ``shipped`` for the model that comes with the project, ``gradient`` for
    edges without a model, otherwise the path of a model."""
    if model == "gradient":
        return GradientEdges()
    return StructuredEdges(SHIPPED_MODEL if model == "shipped" else model)
