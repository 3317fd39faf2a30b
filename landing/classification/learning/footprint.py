"""Memory and inference time of one network, measured in a process of its own.

As a program it prints one JSON object:

python -m landing.classification.learning.footprint FILE ENGINE REPEATS
"""

from __future__ import annotations

import json
import statistics
import sys
import time
from pathlib import Path

import numpy as np

from touchdown.landing.classification.engine import Classifier
from touchdown.landing.classification.ensemble import SUFFIX, load_network

ENGINES = ("onnx", "torch")
_WARM_UP = 3


def load_classifier(path: Path, engine: str, threads: int = 1) -> Classifier:
    """Loads a network's file in the engine ``onnx`` (ONNX Runtime) or ``torch``, an ensemble's in
    the former.

    Raises ValueError and FileNotFoundError as `landing.classification.weights.read_network`,
    and ImportError without the engine."""
    if engine == "onnx":
        return load_network(path, threads)
    if path.suffix == SUFFIX:
        raise ValueError(f"'{path}' is an ensemble, which runs in the engine onnx alone")
    if engine != "torch":
        raise ValueError(f"unknown engine '{engine}': give one of {', '.join(ENGINES)}")
    import torch

    from touchdown.landing.classification.learning.export import TorchClassifier

    torch.set_num_threads(threads)
    return TorchClassifier(path)


def measured(path: Path, engine: str, repeats: int) -> dict[str, float]:
    """Returns the milliseconds for one image, median of ``repeats`` on one thread, the seconds to
    load, and the peak memory of this process, MB of 1e6 bytes."""
    begin = time.perf_counter()
    classifier = load_classifier(path, engine)
    loaded = time.perf_counter()
    size = classifier.facts.image_size
    image = np.random.default_rng(0).integers(0, 256, (1, size, size, 3), dtype=np.uint8)
    times = []
    for _ in range(_WARM_UP + repeats):
        start = time.perf_counter()
        classifier.scores(image)
        times.append(time.perf_counter() - start)
    return {
        "load_s": loaded - begin,
        "image_ms": 1e3 * statistics.median(times[_WARM_UP:]),
        "peak_ram_mb": _peak_memory_mb(),
    }


def _peak_memory_mb() -> float:
    """Returns the high-water mark of this process. ``getrusage`` would include the memory of the
    parent before it started this program."""
    for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
        if line.startswith("VmHWM:"):
            return float(line.split()[1]) * 1024 / 1e6
    return float("nan")


if __name__ == "__main__":
    print(json.dumps(measured(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]))))
