"""Whole flights, seeded: the loop is closed, repeatable and accurate."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchdown.experiments.flight.run import fly

from support.places import cached_scene
from support.worlds import load_ideal_config as load_config

SHORT = (
    "scene_seed=0", "survey.height_m=12.0", "survey.legs=1", "survey.leg_length_m=8.0",
    "survey.duration_s=5.0",
)  # fmt: skip
"""About half a minute in the air."""


def run(
    out: Path | None, *overrides: str, scene: str = "crossroad", **options: Any
) -> dict[str, Any]:
    config = load_config(None, [*SHORT, *overrides], scene=scene, record=False, **options)
    return fly(config, out).plain()


@pytest.fixture(scope="module")
def livo_flight(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    out = tmp_path_factory.mktemp("flight") / "run"
    return out, run(out, "sim.threads=2", estimator="livo", seed=11, survey_only=True)


def test_livo_knows_where_it_is(livo_flight: tuple[Path, dict[str, Any]]) -> None:
    """Bounds of 1.5 times the means of surveys over this scene in profile `ideal`."""
    _, result = livo_flight
    assert result["outcome"] == "COMPLETED" and result["choice"] is None
    assert result["position_error_m"]["mean"] < 0.040 and result["position_error_m"]["max"] < 0.185
    assert result["position_error_m"]["yaw_deg"] < 0.072 and result["trajectory_error_m"] < 0.058


def test_same_seed_same_beginning_to_the_byte_on_any_number_of_threads(
    livo_flight: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    """The first seconds in the air; the whole flight is compared below. A fault after the end
    changes nothing, and the result says so, beside what was measured."""
    first, _ = livo_flight
    short = ("sim.threads=1", "referee.timeout_s=6.0", "faults.events=['camera_black@9']")
    result = run(tmp_path / "run", *short, estimator="livo", seed=11, survey_only=True)
    (condition,) = result["conditions"]
    assert (condition["name"], condition["happened"]) == ("camera_black@9", False)
    assert condition["text"].endswith("the flight ended at 6.0 s, before it began")
    assert result["measured"]["scan_latency_ms"] == pytest.approx(60.0)
    assert 10.0 < result["measured"]["image_grey"] < 245.0
    assert result["renderer"]
    for name in ("truth.tum", "estimate.tum", "reference.tum"):
        begun = (tmp_path / "run" / name).read_bytes()
        assert begun.count(b"\n") > 100
        assert (first / name).read_bytes().startswith(begun), name


def test_the_flight_follows_the_estimate_not_the_truth() -> None:
    """A bias of half a metre in the estimate moves the true touchdown by its negative. All of the
    ground is level; the site is the take-off spot."""
    x, y = cached_scene("flat").takeoff_xy_m.tolist()
    site = (x, y)
    result = run(
        None, "preset=short", "survey.height_m=9.0", "survey.min_height_m=9.0",
        "survey.leg_length_m=4.0", "survey.duration_s=3.0", "landing.site_recheck=false",
        "landing.touchdown_speed_mps=0.3", "bias.xy_m=[0.3, -0.4]", estimator="oracle",
        scene="flat", seed=0, site=site,
    )  # fmt: skip
    assert result["outcome"] == "LANDED", result["reason"]
    moved = np.array(result["landing"]["touchdown_xy_m"]) - site
    np.testing.assert_allclose(moved, [-0.3, 0.4], atol=0.1)
    (site_taken,) = result["choice"]["candidates"]
    assert site_taken["accepted"] and site_taken["rule"] == "commanded"
    assert site_taken["position_m"][:2] == pytest.approx(site, abs=0.05)
    assert sum(t["value"] for t in site_taken["terms"]) == pytest.approx(site_taken["value"])
