"""What holds for every named scene: a survey can be flown over it and a safe site is found."""

import numpy as np
import pytest

from touchdown.scenes.registry import scene_names
from touchdown.scenes.truth.survey_facts import survey_facts

from support.places import cached_scene, check_seeds, check_surfaces, check_survey, check_takeoff

PLACES = {
    # name: seed, safe fraction of what the survey sees, metres free around the take-off and its
    # slope in degrees, height of the highest object and of trees
    "cottage": (0, (0.02, 0.8), (3.0, 0.2), (24.0, 24.0)),
    "crossroad": (0, (0.05, 0.9), (3.0, 2.0), (18.0, np.inf)),
    "deck": (0, (0.0, 0.05), (2.0, 0.5), (18.0, np.inf)),
    "dunes": (0, (0.10, 0.75), (0.9, 2.0), (18.0, np.inf)),
    "flat": (0, (1.0, 1.0), (2.0, 0.5), (18.0, np.inf)),
    "footbridge": (0, (0.02, 0.9), (2.5, 2.0), (18.0, np.inf)),
    "forest": (1, (0.005, 0.5), (0.9, 2.0), (18.0, 17.5)),
    "houses": (0, (0.02, 0.8), (3.0, 0.2), (24.0, 24.0)),
    "lake": (0, (0.10, 0.9), (2.0, 0.5), (18.0, np.inf)),
    "open_water": (0, (0.0, 0.05), (2.0, 0.5), (18.0, np.inf)),
    "pools": (0, (0.02, 0.8), (3.0, 0.2), (24.0, 24.0)),
    "rooftop_parking": (0, (0.02, 0.9), (2.5, 2.0), (18.0, np.inf)),
    "rugged": (0, (0.03, 0.25), (0.9, 2.0), (24.0, np.inf)),
    "snow": (0, (0.10, 0.75), (0.9, 2.0), (18.0, np.inf)),
    "turf": (0, (0.05, 0.95), (0.9, 2.0), (18.0, 18.0)),
}


@pytest.mark.parametrize("name", scene_names())
def test_a_place_can_be_surveyed_and_landed_on(name: str) -> None:
    seed, (low, high), (clear_m, slope_deg), (free_m, trees_m) = PLACES[name]
    scene = cached_scene(name, seed)
    check_takeoff(scene, clear_m, slope_deg)
    check_survey(scene, free_m, trees_m)
    check_surfaces(scene)
    facts = survey_facts(scene, 50.0, 40.0, 6.7, 26.0)
    assert low <= facts.safe_fraction <= high, facts.safe_fraction
    assert facts.takeoff_safe and facts.safe_sites >= 1


@pytest.mark.parametrize(("name", "seed", "other"), [
    ("crossroad", 0, None), ("forest", 1, None), ("lake", 0, 1),
    *(pytest.param(*case, marks=pytest.mark.slow) for case in (
        ("snow", 0, None), ("open_water", 0, 5), ("flat", 0, 1), ("pools", 0, None),
        ("dunes", 0, None), ("footbridge", 0, None), ("rooftop_parking", 0, None),
    )),
])  # fmt: skip
def test_same_seed_same_bytes(name: str, seed: int, other: int | None) -> None:
    check_seeds(name, seed, other)
