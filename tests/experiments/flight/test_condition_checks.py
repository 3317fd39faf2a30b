"""Verdicts on conditions: on records and figures with known answers."""

from typing import Any

import pytest

from touchdown.experiments.cli.console import condition_lines
from touchdown.experiments.config.profiles import effects
from touchdown.experiments.config.schema import Config
from touchdown.experiments.flight.condition_checks import (
    EFFECT_RULES,
    as_json,
    judge_conditions,
    judge_fault,
)
from touchdown.experiments.io.result_parts import Measured
from touchdown.experiments.io.results import RunResult
from touchdown.sim.faults.types import parse_fault

from support.worlds import load_ideal_config as load_config


def hit(fault: str, changed: int, came: int, stream: str = "images") -> dict[str, Any]:
    return {"fault": fault, "messages": {stream: changed}, "came": {stream: came}}


@pytest.mark.parametrize(("text", "record", "happened", "said"), [
    ("camera_black@20", hit("", 771, 771), True,
     "camera_black from 20.0 s: 771 of 771 images"),
    ("camera_black@20", hit("", 1, 771), False, "camera_black from 20.0 s: 1 of 771 images"),
    ("camera_black@20*1", hit("", 1, 771), True,
     "camera_black from 20.0 s, 1 message: 1 of 771 images"),
    ("camera_black@20*3", hit("", 2, 2), False, "3 messages: 2 of 2 images"),
    ("camera_black@70", hit("", 0, 0), False, "the flight ended at 60.0 s, before it began"),
    ("gps_jump@20", hit("", 0, 0, "gps"), False, "no message came that it could change"),
    ("gps_jump@20", {}, False, "no message came that it could change"),
    ("timestamp_swap@27*2",
     {"messages": {"scans": 2, "images": 1}, "came": {"scans": 9, "images": 9}}, False,
     "2 of 9 scans, 1 of 9 images"),
    ("fog@20+5", {"messages": {"scans": 0, "images": 50}, "came": {"scans": 50, "images": 50},
                  "returns_changed": 0.0, "grey_change": 12.3}, True,
     "fog from 20.0 to 25.0 s: 0 of 50 scans, 50 of 50 images (0% of returns, 12.3 grey"),
    ("fog@20+5", {"messages": {"scans": 0, "images": 0}, "came": {"scans": 50, "images": 50},
                  "returns_changed": 0.0, "grey_change": 0.0}, False, "0 of 50 images"),
    ("gust@20+30", {"acted_s": 29.9, "gust_mps": 5.0}, True,
     "gust from 20.0 to 50.0 s: 29.9 s, up to 5.0 m/s"),
    ("gust@20+30", {"acted_s": 3.0, "gust_mps": 5.0}, False, "3.0 s"),
    ("gust@20*1", {"acted_s": 2.99, "gust_mps": 5.0}, True, "1 gust: 3.0 s"),
    ("gust@59", {"acted_s": 1.0, "gust_mps": 5.0}, True, "1.0 s"),
    ("motor_loss@0", {"acted_s": 60.0}, True, "motor_loss from 0.0 s: 60.0 s"),
    ("motor_loss@0", {"acted_s": 5.0}, False, "5.0 s"),
    ("low_sun@0", {"sun_deg": 10.4}, True, "the sun is 10.4 degrees high"),
    ("low_sun@0", {"sun_deg": 45.0}, False, "the sun is 45.0 degrees high"),
])  # fmt: skip
def test_a_fault(text: str, record: dict[str, Any], happened: bool, said: str) -> None:
    """A lasting fault must act on nine tenths of what came; one of N on N messages."""
    verdict = judge_fault(parse_fault(text), record, 60.0, Config())
    assert (verdict.name, verdict.happened) == (text, happened), verdict
    assert said in verdict.text


def judged(config: Config, **figures: float) -> dict[str, Any]:
    """The verdict on the only condition of ``config``, as in ``result.json``."""
    (verdict,) = as_json(judge_conditions(config, Measured(**figures), [], 60.0))
    return verdict


def test_a_night_must_have_been_dark_and_the_lamp_on() -> None:
    night = load_config(None, ["lamp.below_m=12"], light="night")
    dark = judged(night, light_lux=6e-4, lamp_share=0.3)
    assert dark["happened"] and "0.0006 lx without the lamp, the lamp on in 30%" in dark["text"]
    assert not judged(night, light_lux=2e4, lamp_share=0.3)["happened"]
    assert not judged(night, light_lux=6e-4, lamp_share=0.0)["happened"]
    assert not judged(night)["happened"]
    without_lamp = load_config(None, ["lamp.below_m=0"], light="night")
    assert judged(without_lamp, light_lux=6e-4, lamp_share=0.0)["happened"]


def test_the_wind_must_have_blown_as_asked() -> None:
    config = load_config(None, ["wind.mean_kmh=36"])
    assert judged(config, wind_at_6m_mps=10.0, wind_mps=13.0, gust_mps=20.0) == {
        "name": "wind", "happened": True, "value": 36.0,
        "least": pytest.approx(23.4), "most": pytest.approx(48.6),
        "text": "wind of 36 km/h: 36.0 km/h at 6 m, 46.8 at the vehicle, gusts to 72.0",
    }  # fmt: skip
    assert not judged(config, wind_at_6m_mps=3.3)["happened"] and not judged(config)["happened"]


@pytest.mark.parametrize("name", list(effects()))
def test_an_effect_of_nothing_did_not_happen(name: str) -> None:
    config = load_config(None, ["profile=field", f"harsh_effects=['{name}']"])
    rule = EFFECT_RULES[name]
    least = rule.least(config)
    assert least > 0.0 and not judged(config)["happened"]
    assert not judged(config, **{rule.column: 0.99 * least})["happened"]
    assert judged(config, **{rule.column: 1.01 * least})["happened"]


def test_what_did_not_happen_is_a_warning() -> None:
    config = load_config(fault=("camera_black@20", "gps_jump@70"))
    found = judge_conditions(config, Measured(), [hit("camera_black@20", 771, 771)], 60.0)
    result = RunResult(
        outcome="LANDED", scene="lake", seed=0, estimator="livo", conditions=as_json(found)
    )
    assert condition_lines(result) == [
        "camera_black from 20.0 s: 771 of 771 images",
        "warning: did not happen: gps_jump from 70.0 s: the flight ended at 60.0 s, before it "
        "began",
    ]
