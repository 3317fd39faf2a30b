"""Memory and inference time of one network, measured in a process of its own.

As a program it prints one JSON object:

python -m touchdown.experiments.classification.footprint FILE
"""

import json
import statistics
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from touchdown.landing.classification.engine import OnnxClassifier

_WARM_UP, _REPEATS = 3, 30


def measured_footprint(network: Path) -> dict[str, float]:
    """Returns `footprint` of a fresh process."""
    command = [sys.executable, "-m", __name__, str(network)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def footprint(network: Path) -> dict[str, float]:
    """Returns the milliseconds for one image, median of 30 on one thread, and the peak memory of
    this process, MB of 1e6 bytes."""
    classifier = OnnxClassifier(network)
    size = classifier.facts.image_size
    image = np.random.default_rng(0).integers(0, 256, (1, size, size, 3), dtype=np.uint8)
    times = []
    for _ in range(_WARM_UP + _REPEATS):
        start = time.perf_counter()
        classifier.scores(image)
        times.append(time.perf_counter() - start)
    return {"image_ms": 1e3 * statistics.median(times[_WARM_UP:]), "peak_ram_mb": _peak_memory_mb()}


def _peak_memory_mb() -> float:
    """Returns the high-water mark of this process. ``getrusage`` would include the memory of the
    parent before it started this program."""
    for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
        if line.startswith("VmHWM:"):
            return float(line.split()[1]) * 1024 / 1e6
    return float("nan")


if __name__ == "__main__":
    print(json.dumps(footprint(Path(sys.argv[1]))))
