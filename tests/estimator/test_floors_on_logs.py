"""`livo` on short logs of both sensors, one for each of the paper's scenes: errors and NEES within
bounds, and worse without each part that eight seconds can show."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np
import pytest

from touchdown.estimator.api import LivoParams
from touchdown.estimator.livo.estimator import Livo

from support.posed_log import PosedLog, cached_log

pytestmark = pytest.mark.slow

SCENES = ("footbridge", "rooftop_parking", "cottage", "crossroad")
SEED = 3
SETTLED = 400
"""observations, two seconds"""


@dataclass(frozen=True)
class Result:
    mean_m: float
    height_m: float
    """mean error of the height"""
    end_m: float
    """error where the path ends, at its start"""
    nees: float


@pytest.fixture(scope="module", params=SCENES)
def log(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> PosedLog:
    """Made once for all workers of a run."""
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    return cached_log(folder / "posed-logs", request.param, SEED)


def result(log: PosedLog, **parts: bool) -> Result:
    errors, estimates = log.errors(lambda rig: Livo(rig, LivoParams(**parts)))
    scores = [
        error @ np.linalg.solve(estimate.position_covariance, error)
        for error, estimate in zip(errors[SETTLED:], estimates[SETTLED:], strict=True)
    ]
    size = np.linalg.norm(errors, axis=1)
    return Result(
        mean_m=float(size[SETTLED:].mean()),
        height_m=float(np.abs(errors[SETTLED:, 2]).mean()),
        end_m=float(size[-1]),
        nees=float(np.mean(scores)),
    )


def test_each_part_lowers_the_error(log: PosedLog) -> None:
    """Without images a centimetre becomes decimetres; without closures the vehicle does not come
    back to where it was; without images the scans still bound how far the IMU drifts."""
    full = result(log)
    assert full.mean_m < 0.03
    assert 0.1 < full.nees < 5.0  # three coordinates: 3; errors over two scans are correlated
    assert result(log, use_closures=False).end_m > 1.5 * full.end_m
    assert result(log, loose=True).nees > 1.5 * full.nees  # it takes its map for the truth
    blind = result(log, use_vision=False)
    assert blind.mean_m > 5.0 * full.mean_m
    assert result(log, use_vision=False, use_lidar=False).end_m > 1.5 * blind.end_m
