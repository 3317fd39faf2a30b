"""The path of a survey from its file, and back into one."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from touchdown.experiments.config.loading import load_config
from touchdown.experiments.errors import UsageError
from touchdown.experiments.export.flown_run import ExportOptions
from touchdown.experiments.export.run import export
from touchdown.experiments.flight.survey_path import with_path
from touchdown.experiments.io.flight_plan import FlightPlan, plan_of, read_path
from touchdown.scenes.api import Scene

from support.lidar_support import make_scene

WAYS = ((20.0, 0.0, 18.0), (20.0, 30.0, 22.0))


def _place() -> Scene:
    scene = make_scene('<geom type="plane" size="60 60 1"/>')
    return dataclasses.replace(scene, takeoff_xy_m=np.array([5.0, -5.0]))


def _plan(tmp_path: Path, **ends: object) -> Path:
    file = tmp_path / "a.plan"
    home = (47.4, 8.5, 488.0)
    file.write_text(plan_of(FlightPlan(home_wgs84=home, waypoints_m=WAYS, **ends)))  # type: ignore[arg-type]
    return file


def test_a_plan_becomes_waypoints_and_how_it_ends(tmp_path: Path) -> None:
    file = _plan(tmp_path, land_m=(10.0, 4.0))
    config = with_path(load_config(overrides=[f"survey.path={file}"]), _place())
    np.testing.assert_allclose(config.survey.waypoints_m, WAYS, atol=1e-3)
    assert config.survey.height_m == config.survey.min_height_m == 18.0
    assert config.landing.site_xy_m == pytest.approx((15.0, -1.0), abs=1e-3)
    assert with_path(config, _place()) is config
    back = with_path(
        load_config(overrides=[f"survey.path={_plan(tmp_path, returns=True)}"]), _place()
    )
    assert back.landing.return_home and back.landing.site_xy_m is None
    only = [f"survey.path={file}", "landing.survey_only=true"]
    assert with_path(load_config(overrides=only), _place()).landing.site_xy_m is None


def test_a_waypoint_outside_the_scene_is_one_line(tmp_path: Path) -> None:
    small = dataclasses.replace(_place(), bounds_xy_m=np.array([[-60.0, -60.0], [60.0, 20.0]]))
    with pytest.raises(UsageError, match=r"waypoint 2 is 20 m east and 30 m north .* outside"):
        with_path(load_config(overrides=[f"survey.path={_plan(tmp_path)}"]), small)


def test_a_run_is_exported_as_a_plan(tmp_path: Path) -> None:
    """A serpentine of one leg, headed north, from a take-off at (5, -5) m."""
    run = tmp_path / "run"
    run.mkdir()
    survey = {"legs": 1, "leg_length_m": 40.0, "height_m": 18.0}
    (run / "config.json").write_text(
        json.dumps({"survey": survey, "landing": {"site_xy_m": [5.0, 15.0]}})
    )
    (run / "result.json").write_text("{}")
    (run / "truth.tum").write_text("0 5 -5 0.3 0 0 0.70710678 0.70710678\n")
    done = export(run, "plan", None, ExportOptions())
    export(run, "plan", None, ExportOptions())  # replaces its own
    assert done.counts == {"waypoints": 2}
    plan = read_path(done.out, 30.0, 20.0, None)
    np.testing.assert_allclose(plan.waypoints_m, [[0, 0, 18], [0, 40, 18]], atol=1e-3)
    assert plan.land_m == pytest.approx((0.0, 20.0), abs=1e-3)
    assert plan.home_wgs84[0] == pytest.approx(40.0 - 5.0 / 111_030.0, abs=1e-6)
    (run / "config.json").write_text("{}")
    with pytest.raises(UsageError, match="describes no survey"):
        export(run, "plan", tmp_path / "b.plan", ExportOptions())
