"""The paper's whole system in the closed loop: positioning, selection and network."""

from typing import Any

import pytest

from touchdown.experiments.config.loading import load_config
from touchdown.experiments.flight.run import fly

SEED = 8301


def flown(*overrides: str) -> dict[str, Any]:
    """Positioned within 1.5 times the errors over crossroad in `docs/results/zou2024.md`."""
    asked = ("preset=short", "sim.threads=1", "landing.selector=zou2024", *overrides)
    options = {"scene": "crossroad", "estimator": "zou2024", "seed": SEED, "record": False}
    result = fly(load_config(None, asked, **options), None).plain()
    assert result["position_error_m"]["mean"] < 0.12
    assert result["nees"]["median"] < 5.0
    return result


def test_the_whole_system_finds_its_site_in_field() -> None:
    """Of the landing below, what comes before the approach."""
    result = flown("referee.timeout_s=14.0")
    assert result["phases"][-1]["phase"] == "APPROACH"
    assert result["choice"]["selector"] == "zou2024"
    first = result["choice"]["candidates"][0]
    assert first["accepted"] and first["class_predicted"] == "lawn"


@pytest.mark.slow
def test_the_whole_system_lands_in_field() -> None:
    result = flown()
    assert result["outcome"] == "LANDED" and result["landing"]["safe"]
    assert result["landing"]["judged_on"] == "geometry and class"
