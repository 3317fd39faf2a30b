"""The standard survey over small places and over tall things."""

import warnings
from pathlib import Path

import pytest

from touchdown.experiments.config.loading import load_config
from touchdown.experiments.flight import survey_fit
from touchdown.experiments.flight.survey_fit import fitted
from touchdown.experiments.flight.wiring import build_scene
from touchdown.landing.api import SurveyParams
from touchdown.scenes.importers import top_view as takeoff

TAKEOFF = '<site name="takeoff" pos="0 0 0"/>'
PLANE = f'<geom name="lawn" type="plane" size="0 0 1"/>{TAKEOFF}'


def fit(tmp_path: Path, body: str, *overrides: str, **more: bool) -> tuple[SurveyParams, int, str]:
    path = tmp_path / "place.xml"
    path.write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    config = load_config(None, overrides, scene=str(path), profile_default="ideal", **more)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene = build_scene(config)
        caught.clear()
        config = fitted(config, scene)
    return config.survey, config.landing.search_legs, "".join(str(w.message) for w in caught)


def test_a_wide_place_has_the_standard_survey(tmp_path: Path) -> None:
    assert fit(tmp_path, PLANE) == (SurveyParams(), 1, "")


def test_a_small_place_has_a_small_survey(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a yard of 40 m the take-off in its middle has 20 m ahead and 20 m to the left: one leg,
    low, as two would turn over its edge, and no room for another; what differs is said as keys."""
    yard = f'<geom name="lawn" type="box" size="20 20 1" pos="0 0 -1"/>{TAKEOFF}'
    survey, search_legs, said = fit(tmp_path, yard)
    assert (survey.legs, survey.leg_length_m, survey.height_m) == (1, 20.0, 20.0)
    assert search_legs == 0 and survey.duration_s < 16.0
    assert "survey.legs=1, " in said and "survey.leg_length_m=20, " in said
    with monkeypatch.context() as patch:
        patch.setattr(survey_fit, "TURN_M", 0.0)
        wide = fit(tmp_path, yard)[0]
    assert (wide.legs, wide.leg_spacing_m, wide.leg_length_m) == (3, 10.0, 14.0)
    assert wide.height_m == 30.0 and wide.duration_s < 20.0
    kept = fit(tmp_path, yard, "survey.legs=2")[0]
    assert (kept.legs, kept.leg_length_m) == (2, 50.0)
    assert fit(tmp_path, yard, as_is=True)[0] == SurveyParams()


def test_turns_are_over_ground_too(tmp_path: Path) -> None:
    """Of a plane of 60 m: from a corner there is none for the turn at the near end, which a third
    leg needs; from 12 m further in there is. The radius is 10 m, and 3 m are left beyond."""
    plane = '<geom name="lawn" type="box" size="30 30 1" pos="0 0 -1"/>'
    for x, legs in ((-29.5, 2), (-17.5, 3)):
        survey = fit(tmp_path, plane + f'<site name="takeoff" pos="{x} -29.5 0"/>')[0]
        assert survey.legs == legs and survey.leg_spacing_m == 20.0
        assert 26.0 < x + survey.leg_length_m + 13.0 < 31.0


def test_a_tall_thing_raises_the_survey(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mast = '<geom name="building" type="box" size="1 1 16" pos="30 20 16"/>'
    survey, _, said = fit(tmp_path, PLANE + mast)
    assert survey.height_m == pytest.approx(39.0, abs=1.01) and "survey.height_m=" in said
    for name, value, height in (
        ("_RAISED_M", 10.0, survey.height_m + 4.0),
        ("_HIGHEST_M", 35.0, 35.0),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(survey_fit, name, value)
            assert fit(tmp_path, PLANE + mast)[0].height_m == height


def test_take_offs_are_chosen_for_the_surveys_that_are_fitted() -> None:
    survey = SurveyParams()
    width = (survey.legs - 1) * survey.leg_spacing_m
    assert (survey.leg_length_m + 2.0, width + 2.0) == (takeoff._AHEAD_M, takeoff._LEFT_M)
    assert tuple(survey.leg_spacing_m * n for n in range(survey.legs)) == takeoff._WIDTHS_M
    assert takeoff._LENGTHS_M[-1] == survey_fit.SHORTEST_M
    assert 0.5 * survey.leg_spacing_m + survey_fit.TURN_M == takeoff._TURN_M
    assert (
        survey_fit.SWATH_M == takeoff._SEEN_ASIDE_M and survey_fit.GROUND_FRACTION == takeoff._ROOM
    )
