"""What the machine is asked to do for a flight."""

import json
import os
import subprocess
import sys
from pathlib import Path

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
