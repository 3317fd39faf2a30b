"""The touchdown bench: single contacts by the mission's own descent, and what is read off many."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchdown.experiments.benchmarks.contact import tipping, trial
from touchdown.experiments.benchmarks.contact.terrain import Terrain, feet_xy, terrain_scene
from touchdown.experiments.benchmarks.contact.trial import Conditions, Touch, Trial, fly_trial
from touchdown.experiments.config.schema import Config
from touchdown.scenes.truth.static_surface import cast_points

from support.command import Says


@pytest.fixture(scope="module")
def config() -> Config:
    return tipping.contact_config().model_copy(update={"seed": 9001})


def flown(config: Config, terrain: Terrain, conditions: Conditions | None = None) -> Touch:
    return fly_trial(Trial(config, terrain, conditions or Conditions()))


@pytest.mark.parametrize("legs", [1, 2])
@pytest.mark.parametrize("kind", ["step", "rock"])
def test_so_many_feet_are_over_the_obstacle(kind: str, legs: int) -> None:
    """A foot over a rock is at most half of its height aside of its top."""
    for seed in range(4):
        scene = terrain_scene(Terrain(kind, legs, 0.2), None, np.random.default_rng(seed))
        heights, _ = cast_points(scene, feet_xy())
        least = 0.2 if kind == "step" else 0.2 * np.sqrt(0.75)
        assert np.sum(heights > least - 0.01) == legs
        assert np.sum(np.abs(heights) < 1e-3) == len(feet_xy()) - legs


def test_a_slope_has_its_angle() -> None:
    scene = terrain_scene(Terrain("slope", 0, 12.0), None, np.random.default_rng(3))
    heights, _ = cast_points(scene, np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
    assert heights[0] == pytest.approx(0.0, abs=1e-4)
    assert np.hypot(*(heights[1:] - heights[0])) == pytest.approx(
        np.tan(np.radians(12.0)), abs=1e-3
    )


def test_it_stands_on_level_ground_and_moves_as_it_should(config: Config) -> None:
    """The drift of the estimate moves the vehicle over the ground, and nothing else does."""
    found = flown(config, Terrain("slope", 0, 0.0), Conditions(speed_mps=0.0))
    assert found.fails == "" and found.safe_geometry
    assert found.slid_m < 0.05 and found.tilt_deg < 3.0 and found.contact_mps < 0.1
    moving = flown(config, Terrain("slope", 0, 0.0), Conditions(speed_mps=0.4))
    assert moving.contact_mps == pytest.approx(0.4, abs=0.1)
    assert moving.slid_m > 0.05 > found.slid_m and moving.fails == ""


@pytest.mark.parametrize(("outcome", "slid_m", "fails"), [
    ("LANDED", 0.1, ""), ("LANDED", 0.2, "slides"), ("TIMEOUT", 0.1, "slides"),
    ("LANDED", np.nan, "slides"), ("TIPPED", 0.0, "tips"), ("COLLIDED", 0.0, "strikes"),
])  # fmt: skip
def test_what_fails(outcome: str, slid_m: float, fails: str) -> None:
    assert trial.failure_of(outcome, slid_m, 0.15) == fails


def test_friction_holds_it_on_a_slope(config: Config) -> None:
    """tan 20 deg = 0.36; the vehicle's own feet have 0.9."""
    steep = Terrain("slope", 0, 20.0)
    assert flown(config, steep, Conditions(friction=0.3)).fails == "slides"
    assert flown(config, steep).fails == ""


def test_legs_without_contact_are_seen(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*given: Any) -> Any:
        scene = terrain_scene(*given)
        for geom in range(scene.model.ngeom):
            if scene.model.geom(geom).name.startswith(("vehicle/leg_0", "vehicle/leg_1")):
                scene.model.geom_conaffinity[geom] = 0
        return scene

    monkeypatch.setattr(trial, "terrain_scene", broken)
    with pytest.raises(ValueError, match="does not stand"):
        flown(config, Terrain("slope", 0, 0.0))


def test_the_vehicle_stands_where_the_true_rule_calls_the_ground_safe(config: Config) -> None:
    """A coarse map at the corners of friction and wind, at up to 0.2 m/s over the ground, and
    ground beyond the rule for contrast."""
    corners = (Conditions(0.3, 0.2, 40.0), Conditions(0.9, 0.2, 40.0))
    grounds = [Terrain("slope", 0, 4.5), Terrain("step", 2, 0.05), Terrain("rock", 1, 0.09)]
    found = [flown(config, ground, corner) for ground in grounds for corner in corners]
    safe = [touch for touch in found if touch.safe_geometry]
    assert len(safe) >= 4
    assert not [touch for touch in safe if touch.fails]
    beyond = flown(config, Terrain("step", 2, 0.4), corners[1])
    assert beyond.fails and not beyond.safe_geometry


def touch(size: float, fails: str, friction: float = 0.5, kind: str = "slope") -> Touch:
    legs = 0 if kind == "slope" else 1
    return Touch(Terrain(kind, legs, size), Conditions(friction, 0.0, 0.0), fails, 0.0, 0.0, 0.0,
                 size <= 5.0)  # fmt: skip


def test_the_limit_is_below_the_first_level_that_fails(config: Config) -> None:
    touches = [touch(size, "slides" if size == 10.0 and n < 20 else "")
               for size in (5.0, 7.5, 10.0, 12.5) for n in range(100)]  # fmt: skip
    touches += [touch(0.1, "tips", kind="step") for _ in range(100)]
    figures = tipping.figures_of(touches, tipping.Ranges(), 0.05, config)
    assert figures["limits"]["max_slope_deg"] == 7.5
    assert figures["limits"]["max_step_m"] is None
    assert figures["rule"]["safe"]["fails"] == 100 and figures["rule"]["unsafe"]["fails"] == 20
    assert "7.5°  (landing.max_slope_deg is 5°)" in tipping.table(figures)
    few = tipping.figures_of(touches[:50], tipping.Ranges(), 0.05, config)
    assert few["limits"]["max_slope_deg"] is None  # no failure of 50 may be 7 %


def test_a_map_counts_by_size_and_condition(config: Config) -> None:
    touches = [touch(5.0, "slides", 0.35), touch(5.0, "", 0.85), touch(5.0, "", 0.9)]
    figures = tipping.figures_of(touches, tipping.Ranges(), 0.05, config)
    friction = next(one for one in figures["maps"] if one["dial"] == "friction")
    (low, middle, high) = friction["cells"][0]
    assert (low["fails"], low["contacts"]) == (1, 1) and middle is None
    assert (high["fails"], high["contacts"]) == (0, 2)


def test_a_trial_does_not_depend_on_how_many_there_are(config: Config) -> None:
    ranges = tipping.Ranges(speed_mps=(0.1, 0.2))
    few = list(tipping.trials(config, ranges, 1, 9002))
    more = list(tipping.trials(config, ranges, 3, 9002))
    assert [more[3 * n].conditions for n in range(len(few))] == [one.conditions for one in few]
    assert all(0.1 <= one.conditions.speed_mps <= 0.2 for one in more)
    assert len({one.config.seed for one in more}) == len(more)


def test_the_command_writes_figures_and_maps(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, says: Says
) -> None:
    found = [touch(s, "slides" if s > 10 else "") for s in tipping.SLOPES_DEG]
    given = iter([*found, *(touch(h, "", kind="step") for h in tipping.HEIGHTS_M[1:])])
    monkeypatch.setattr(tipping, "GROUNDS", (("slope", 0), ("step", 1)))
    monkeypatch.setattr(
        tipping, "fly_trial", lambda one: replace(next(given), conditions=one.conditions)
    )
    words = ["bench", "touchdown", "--contacts", "1", "--out", tmp_path, "--quiet"]
    assert "step under 1 leg" in says(0, *words, "--friction", "0.5", "0.9").out
    assert {file.name for file in tmp_path.iterdir()} == {"touchdown.json", "touchdown.svg"}
    assert "give 0 <= LOW <= HIGH" in says(2, *words, "--friction", "0.9", "0.5").err
    itself = says(2, *words, "--set", "estimator=livo").err
    assert "the bench sets 'estimator' itself" in itself
