"""Time by stage."""

import pytest

from touchdown.experiments.flight.observers import StageClock


def test_time_of_a_stage_is_given_for_each_scan() -> None:
    clock = StageClock()
    clock.seconds.update(world=3.0, estimator=1.5)
    stages = clock.timing(30.0).stage_ms  # of 300 scans
    assert stages is not None
    assert stages.model_dump(exclude_unset=True) == pytest.approx({"estimator": 5.0, "world": 10.0})
