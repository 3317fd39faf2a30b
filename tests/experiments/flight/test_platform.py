"""What the machine is asked to do for a flight."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

KERNELS = """
from numba import njit

@njit(cache=True)
def twice(x):
    return 2.0 * x
"""
PROBE = """
import json
from numba import njit
from touchdown.experiments.flight.platform import keep_bitcode
keep_bitcode()
from kernels import twice
twice(2.0)
library = twice.overloads[twice.signatures[0]].library
parsed = library._shared_module is not None

@njit
def thrice(x):
    return twice(x) + x

print(json.dumps([sum(twice.stats.cache_hits.values()), parsed, twice(2.0), thrice(2.0)]))
"""


def test_a_kernel_from_the_cache_is_parsed_for_those_that_are_compiled_from_it(
    tmp_path: Path,
) -> None:
    (tmp_path / "kernels.py").write_text(KERNELS, encoding="utf-8")
    paths = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": paths, "NUMBA_CACHE_DIR": str(tmp_path)}
    said = []
    for _ in range(2):
        done = subprocess.run(
            [sys.executable, "-c", PROBE], env=environment, stdout=subprocess.PIPE, check=True
        )
        said.append(json.loads(done.stdout))
    assert said == [[0, True, 4.0, 6.0], [1, False, 4.0, 6.0]]


ROOT = Path(__file__).parents[3]
NAMES = (
    "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS",
    "LP_NUM_THREADS",
)  # fmt: skip
THREADS_PROBE = """
import json
from threadpoolctl import threadpool_info
from touchdown.experiments.flight.platform import limit_threads
limit_threads()
import cv2, numba, scipy.linalg
blas = [library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"]
last = numba.config.THREADING_LAYER_PRIORITY[-1]
print(json.dumps([blas, cv2.getNumThreads(), numba.get_num_threads(), last]))
"""


@pytest.mark.parametrize("first", ["", "import numpy, scipy.linalg, cv2", "import touchdown"])
def test_libraries_stay_on_one_thread_whatever_the_environment_says(first: str) -> None:
    command = [sys.executable, "-c", first + THREADS_PROBE]
    four = {**os.environ, "MUJOCO_GL": "egl"} | dict.fromkeys(NAMES, "4")
    done = subprocess.run(command, cwd=ROOT, env=four, stdout=subprocess.PIPE, check=True)
    blas, opencv, numba, last = json.loads(done.stdout)
    assert len(blas) >= 2 and set(blas) == {1} and (opencv, numba, last) == (1, 1, "tbb")
