"""The check of structured forests: gzipped YAML that OpenCV's edge detector loads."""

from __future__ import annotations

import re
import zlib
from pathlib import Path

from touchdown.sim.files.inflating import gunzipped
from touchdown.sim.files.opening import no_file

SHIPPED_MODEL = Path(__file__).with_name("structured_edges.yml.gz")
"""trained by ``touchdown edges train`` on images of this project's scenes"""

OPTIONS = ("stride", "patchSize", "patchInnerSize", "shrinkNumber", "numberOfTrees",
           "numberOfTreesToEvaluate", "selfsimilarityGridSize", "numberOfGradientOrientations",
           "gradientNormalizationRadius", "gradientSmoothingRadius", "regFeatureSmoothingRadius",
           "ssFeatureSmoothingRadius")  # fmt: skip
SECTIONS = ("childs", "featureIds", "thresholds", "edgeBoundaries", "edgeBins")
_MAX_BYTES = 256 << 20
"""of a model unpacked; that of `touchdown edges train` has 10 MiB"""


def check_model(path: Path) -> None:
    """Raises FileNotFoundError or ValueError, one sentence, unless ``path`` holds a whole model:
    OpenCV itself takes a truncated file for a smaller forest, or crashes."""
    if reason := no_file(path):
        raise FileNotFoundError(
            f"structured edge model '{path}' {reason}: give the path of a trained model, or "
            "'gradient' for edges without one"
        )
    try:
        text = gunzipped(path, _MAX_BYTES)
    except (OSError, EOFError, zlib.error) as error:
        raise ValueError(
            f"structured edge model '{path}' is damaged ({error}): restore it, or train one by "
            "`touchdown edges train`"
        ) from None
    if len(text) > _MAX_BYTES:
        raise ValueError(
            f"structured edge model '{path}' has more than {_MAX_BYTES >> 20} MiB unpacked: train "
            "one by `touchdown edges train`"
        )
    fault = _fault(text.decode("ascii", errors="replace"))
    if fault:
        raise ValueError(
            f"structured edge model '{path}' is not one that OpenCV can use: {fault}; train one by "
            "`touchdown edges train`"
        )


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
