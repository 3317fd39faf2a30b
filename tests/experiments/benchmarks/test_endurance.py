"""Long flights: samples of each minute, and their configuration."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from touchdown.experiments.benchmarks.endurance import _Minutes
from touchdown.experiments.flight.stage_timer import StageClock
from touchdown.sim.frames import Pose


def step(time_s: float, error_m: float) -> Any:
    def at(x: float) -> Pose:
        return Pose(np.eye(3), np.array([x, 0.0, 0.0]))

    truth = SimpleNamespace(time_s=time_s, world_from_body=at(0.0))
    return SimpleNamespace(truth=truth, estimate=SimpleNamespace(world_from_body=at(error_m)))


def test_each_minute_has_its_own_time_and_error() -> None:
    clock, spent_s = StageClock(lambda: 0.0), [7.0]
    minutes = _Minutes(clock, lambda: spent_s[0])
    for second in range(1, 121):
        # 0.02 s of work each second in the first minute, 0.05 s in the second
        clock.add("estimator", 0.02 if second <= 60 else 0.05)
        spent_s[0] += 0.1 if second <= 60 else 0.2  # by all threads
        minutes.tick(step(float(second), 0.1 if second <= 60 else 0.3))
    first, second_ = minutes.rows
    assert (first["until_s"], second_["until_s"]) == (60.0, 120.0)
    assert first["estimator_ms"] == pytest.approx(2.0)  # of ten scans a second
    assert second_["estimator_ms"] == pytest.approx(5.0)
    assert first["process_ms"] == pytest.approx(10.0)
    assert second_["process_ms"] == pytest.approx(20.0)
    assert first["error_mean_m"] == pytest.approx(0.1)
    assert second_["error_mean_m"] == pytest.approx(0.3) and 10.0 < first["memory_mb"] < 1e5
