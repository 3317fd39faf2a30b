"""Flights of the baselines: closed loop over a small scene."""

import pytest

from touchdown.experiments.errors import UsageError
from touchdown.experiments.flight.run import fly

from support.baselines_support import tiny
from support.worlds import load_ideal_config as load_config


@pytest.mark.parametrize(("estimator", "max_m", "max_deg", "max_off_m"), [
    ("gps", 3.2, 1.4, 0.23), ("hybrid_flow", 3.2, 1.4, 0.22), ("optical_flow", 0.051, 0.15, 0.04),
    ("stereo", 0.013, 0.13, 0.04),
])  # fmt: skip
def test_short_survey_in_the_loop(
    estimator: str, max_m: float, max_deg: float, max_off_m: float
) -> None:
    """Bounds of 1.5 times the errors of this flight."""
    result = fly(tiny(estimator), None).plain()
    assert result["outcome"] == "COMPLETED"
    assert result["position_error_m"]["mean"] < max_m
    assert result["position_error_m"]["yaw_deg"] < max_deg
    # the controller follows the estimate: path error and estimation error are equal
    assert abs(result["trajectory_error_m"] - result["position_error_m"]["mean"]) < max_off_m


def test_landing_without_a_map_is_refused() -> None:
    with pytest.raises(UsageError, match=r"mapper\.enabled"):
        load_config(None, ("mapper.enabled=false",), scene="flat")


@pytest.mark.parametrize("group", ["optical_flow", "hybrid_flow", "stereo_vo"])
def test_image_rates_divide_the_cameras_clock(group: str) -> None:
    with pytest.raises(UsageError, match=rf"{group}\.camera_hz = 7"):
        load_config(None, (f"{group}.camera_hz=7",), scene="flat")
