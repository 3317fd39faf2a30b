import json
import re

import pytest

from touchdown.experiments.config import reference
from touchdown.experiments.config.keys import flatten
from touchdown.experiments.config.loading import known_keys, load_config
from touchdown.experiments.config.ranges import limits_of, out_of_range, types_of_keys
from touchdown.experiments.config.schema import Config
from touchdown.experiments.config.suggestions import suggestion

from support.command import Says


def test_the_page_has_every_key_once_with_a_meaning() -> None:
    keys = re.findall(r"^\| `([\w.]+)` \|", reference.reference_page(), re.MULTILINE)
    assert len(keys) == len(set(keys)) and set(keys) == {*known_keys(), "external"}
    assert [key for key in keys if not reference.meaning_of(key)] == []


def test_defaults_can_be_given_back() -> None:
    pairs = [(key, reference.default_of(key).strip("`")) for key in known_keys()]
    texts = [f"{key}={text}" for key, text in pairs if text != "none"]
    assert load_config(None, texts) == Config(profile="field")


@pytest.mark.parametrize(("asked", "meant"), [
    ("camera.pitch_deg", "'camera.mount_deg'"),
    ("camera.hight", "'camera.height'"),  # a slip
    ("wind_speed", "'wind.mean_kmh'"),  # not 'scene_seed'
    ("survey.altitude", "'survey.height_m'"),  # not 'start.attitude_known'
    ("landing.timeout", "'referee.timeout_s'"),
    ("battery.capacity", "'sim.battery_capacity_j'"),
    ("lidar.range", "'lidar.min_range_m'"),  # not 'rangefinder', the group counts twice
    ("frobnicate_m", ""),
])  # fmt: skip
def test_an_unknown_key_is_matched_by_what_it_means(asked: str, meant: str) -> None:
    hint = suggestion(asked, known_keys())
    assert meant in hint if meant else hint == ""


def test_the_command_lists_keys_as_they_are_flown(says: Says) -> None:
    rows = json.loads(says(0, "config", "--json").out)["keys"]
    assert [row["key"] for row in rows] == list(known_keys())
    assert all(row["meaning"] for row in rows)
    tilt = next(row for row in rows if row["key"] == "landing.wind_tilt_deg")
    assert (tilt["default"], tilt["ideal"], tilt["unit"]) == (35.0, 31.0, "°")
    listed = says(0, "config", "survey.leg").out
    assert "survey.legs = 3" in listed and "survey.height_m" not in listed
    assert "did you mean 'survey.height_m'" in says(2, "config", "survey.altitude").err


NUMBER = re.compile(r"\b(float|int)\b")


def test_every_number_has_a_lower_and_an_upper_bound() -> None:
    """A number that physics or memory does not bound is a way to end the program."""
    numbers = [key for key, kind in types_of_keys().items() if NUMBER.search(str(kind))]
    assert len(numbers) > 300
    for key in numbers:
        limits = limits_of(key)
        low, high = limits.get("ge", limits.get("gt")), limits.get("le", limits.get("lt"))
        assert low is not None and high is not None, key
        assert -1e7 <= low < high <= (2**63 if "seed" in key else 1e9), key
        assert out_of_range(key, 2.0 * high) and out_of_range(key, [high * 2]), key
        assert out_of_range(key, low - 1.0), key
    assert set(known_keys()) >= {*numbers}


@pytest.mark.parametrize("profile", ["ideal", "field", "harsh"])
def test_values_of_profiles_are_within_their_bounds(profile: str) -> None:
    config = load_config(None, [f"profile={profile}"])
    values = dict(flatten(json.loads(config.model_dump_json())))
    assert [key for key, value in values.items() if out_of_range(key, value)] == []
