"""Flights under every number of threads that the environment may name."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
NAMES = (
    "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS",
    "LP_NUM_THREADS",
)  # fmt: skip
PROBE = """
import json
from threadpoolctl import threadpool_info
from touchdown.experiments.flight.platform import limit_threads
limit_threads()
import cv2, numba, scipy.linalg
blas = [library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"]
print(json.dumps([blas, cv2.getNumThreads(), numba.get_num_threads()]))
"""


@pytest.mark.parametrize("first", ["", "import numpy, scipy.linalg, cv2", "import touchdown"])
def test_libraries_stay_on_one_thread_whatever_the_environment_says(first: str) -> None:
    command = [sys.executable, "-c", first + PROBE]
    four = {**os.environ, "MUJOCO_GL": "egl"} | dict.fromkeys(NAMES, "4")
    done = subprocess.run(command, cwd=ROOT, env=four, stdout=subprocess.PIPE, check=True)
    blas, opencv, numba = json.loads(done.stdout)
    assert len(blas) >= 2 and set(blas) == {1} and (opencv, numba) == (1, 1)
