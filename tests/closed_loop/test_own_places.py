"""Whole landings on eight scenes of other people's kind, with no other argument than the file."""

import warnings
from pathlib import Path

import pytest

from touchdown.experiments.config.loading import load_config
from touchdown.experiments.flight.run import fly

from support.own_places import PLACES


@pytest.mark.slow
@pytest.mark.parametrize("seed", [9201, 9202])
@pytest.mark.parametrize("name", PLACES)
def test_a_place_as_it_comes_is_landed_on(name: str, seed: int, tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        result = fly(load_config(scene=str(PLACES[name](tmp_path)), seed=seed, record=False), None)
    missed = "" if result.choice is None else result.choice.missed
    assert result.is_success, (result.outcome, result.reason, missed)
