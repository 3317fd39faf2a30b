"""Figures that the configuration sets: known by column and method, and by keys that exist."""

import pytest

from touchdown.experiments.campaign.results_table import SCHEMA
from touchdown.experiments.config.loading import known_keys
from touchdown.experiments.reporting.measures import SETTINGS, setting_of


@pytest.mark.parametrize(("column", "method", "key"), [
    ("map.duration_s", "livo", "survey.duration_s"),
    ("landing.vertical_speed_mps", "paper", "landing.touchdown_speed_mps"),
    ("trajectory_error_m", "gps", "gps.preset"),
    ("position_error_m.mean", "gps", "gps.preset"), ("trajectory_error_m", "hybrid_flow", None),
    ("trajectory_error_m", None, None), ("landing.target_offset_m", "gps", None),
    ("trajectory_error_max_m", "gps", None),
])  # fmt: skip
def test_figures_that_are_set(column: str, method: str | None, key: str | None) -> None:
    found = setting_of(column, method)
    assert (None if found is None else found.key) == key


def test_settings_name_keys_and_columns_that_exist() -> None:
    made = ("path_deviation.", "error_by_distance.")  # of a report, not of a result
    for setting in SETTINGS:
        assert setting.key in known_keys()
        for name in setting.columns:
            assert name in made or any(column.startswith(name) for column in SCHEMA), name
