"""Surveys with and without mapping have equal positions."""

import pytest

from touchdown.experiments.flight.run import fly

from support.baselines_support import tiny


@pytest.mark.slow
def test_positions_do_not_depend_on_mapping() -> None:
    """LIDAR and mapper change no random stream and no message."""
    results = [
        fly(tiny("optical_flow", f"mapper.enabled={enabled}"), None)
        for enabled in ("false", "true")
    ]
    bare, mapped = results
    assert bare.position_error_m == mapped.position_error_m
    assert bare.trajectory_error_m == mapped.trajectory_error_m
    assert bare.map is not None and bare.map.density_per_m2 == 0.0
    assert mapped.map is not None and (mapped.map.density_per_m2 or 0.0) > 0.0
