"""Twelve landings have equal results on every engine and with any number of threads."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from touchdown.experiments.benchmarks.loop import SHORT_SURVEY

from support.campaign_flights import ROOT

RUNS = 12
PLAN = """
name = "same"
mode = "land"
record = "none"
[axes]
scene = ["crossroad", "lake", "houses", "forest"]
estimator = ["livo", "hybrid_flow", "gps"]
seeds = "0"
[base]
"""

pytestmark = pytest.mark.slow


def results(folder: Path, engine: str, jobs: int, threads: int) -> dict[str, dict[str, Any]]:
    """``result.json`` of every run, without times."""
    name = f"{engine}-{jobs}-{threads}"
    file, out = folder / f"{name}.toml", folder / name
    settings = (*SHORT_SURVEY, f"sim.threads={threads}", f"landing.classifier_threads={threads}")
    file.write_text(PLAN + "\n".join(settings), encoding="utf-8")
    command = [sys.executable, "-m", "touchdown", "campaign", str(file), "--out", str(out),
               "--jobs", str(jobs), "--engine", engine, "--quiet"]  # fmt: skip
    # 1 means unsuccessful flights, which are irrelevant here
    assert subprocess.run(command, cwd=ROOT, stdout=subprocess.DEVNULL).returncode in (0, 1)
    found = {}
    for path in out.glob("runs/*/result.json"):
        result = json.loads(path.read_text(encoding="utf-8"))
        del result["timing"]
        found[path.parent.name] = result
    return found


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    found = results(tmp_path_factory.mktemp("alone"), "local", jobs=1, threads=1)
    assert len(found) == RUNS
    return found


@pytest.mark.parametrize(
    ("engine", "jobs", "threads"), [("local", 2, 2), ("ray", 2, 1), ("ray", 1, 2)]
)
def test_same_results(
    engine: str, jobs: int, threads: int, alone: dict[str, dict[str, Any]], tmp_path: Path
) -> None:
    if engine == "ray" and importlib.util.find_spec("ray") is None:
        pytest.skip("Ray is not installed")
    assert results(tmp_path, engine, jobs, threads) == alone
