"""Measured conditions of a flight: figures of made-up steps with known answers."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from touchdown.experiments.cli.console import condition_lines
from touchdown.experiments.config.profiles import effects
from touchdown.experiments.config.schema import Config
from touchdown.experiments.flight.conditions import (
    EFFECT_RULES,
    ConditionsObserver,
    as_json,
    judge_conditions,
    judge_fault,
)
from touchdown.experiments.io.result_parts import Measured
from touchdown.experiments.io.results import RunResult
from touchdown.sim.effects import Effect, WorldRecord
from touchdown.sim.faults.types import parse_fault
from touchdown.sim.frames import Pose, so3_exp

from support.livo_flight import make_rig
from support.worlds import load_ideal_config as load_config

NOTHING = WorldRecord([], {"air": {}}, {})


def step(k: int, height: float, **messages: Any) -> Any:
    """A control step, 5 ms after the one before: wind 10 m/s, every third 13; a shaken IMU; a turn
    of 0.5 rad/s."""
    wind = np.array([6.0, 8.0, 0.0]) if k % 3 else np.array([5.0, 12.0, 0.0])
    truth = SimpleNamespace(
        world_from_body=Pose(np.eye(3), np.array([0.0, 0.0, height])),
        wind_world=wind,
        angular_velocity_body=np.array([0.3, 0.0, 0.4]),
    )
    force = SimpleNamespace(specific_force=np.array([0.0, 0.0, 9.81 + (-1) ** k]))
    sent = {"scans": (), "images": (), **messages}
    return SimpleNamespace(truth=truth, obs=SimpleNamespace(time_s=0.005 * k, imu=[force], **sent))


def flown() -> ConditionsObserver:
    """60 steps on the ground and 60 at 12.2 m; two images, two scans 60 and 80 ms late."""
    observer = ConditionsObserver(0.1)
    for k in range(120):
        messages: dict[str, Any] = {}
        if k in (70, 90):
            grey = np.full((32, 48, 3), k, np.uint8)
            late_s = 0.06 if k == 70 else 0.08
            messages["images"] = (SimpleNamespace(rgb=grey),)
            messages["scans"] = (SimpleNamespace(end_time_s=0.005 * k - late_s),)
        observer.tick(step(k, 0.0 if k < 60 else 12.2, **messages))
    return observer


def test_wind_vibration_brightness_and_latency() -> None:
    rig = replace(make_rig(), camera_readout_s=0.02)
    found = flown().measured(NOTHING, rig, rig)
    assert found.wind_mps == pytest.approx(11.0) and found.gust_mps == pytest.approx(13.0)
    profile = math.log(12.2 / 0.1) / math.log(6.1 / 0.1)
    assert found.wind_at_6m_mps == pytest.approx(11.0 / profile)
    assert found.vibration_mps2 == pytest.approx(2.0 / math.sqrt(2.0))
    assert found.image_grey == pytest.approx(80.0) and found.scan_latency_ms == pytest.approx(70.0)
    assert found.scan_latency_sigma_ms == pytest.approx(10.0)
    assert found.readout_shear_px == pytest.approx(rig.camera.fx * 0.02 * 0.5)
    assert found.mount_error_deg == pytest.approx(0.0, abs=1e-5) and found.lens_error_px == 0.0


def test_errors_of_the_calibration_as_applied() -> None:
    true = make_rig()
    turned = Pose(
        so3_exp(np.deg2rad([0.0, 0.3, 0.0])) @ true.body_from_lidar.rotation,
        true.body_from_lidar.translation,
    )
    camera = replace(true.camera, cx=true.camera.cx + 3.0, cy=true.camera.cy - 4.0)
    found = flown().measured(NOTHING, true, replace(true, body_from_lidar=turned, camera=camera))
    assert found.mount_error_deg == pytest.approx(0.3) and found.lens_error_px == pytest.approx(5.0)


def test_effects_of_the_world() -> None:
    effects = {
        "scans": {
            "dust": Effect(4, 3, 1.0, 0.0), "vegetation": Effect(2, 2, 0.5, 0.4),
            "sway": Effect(2, 1, 0.1, 0.02), "ranging": Effect(2, 2, 2.0, 0.03),
        },
        "images": {
            "lamp": Effect(10, 3, 3.0, 0.0), "light_lux": Effect(7, 7, 7.0, 0.014),
            "gain": Effect(10, 10, 10.0, 160.0), "stamp_error_ms": Effect(10, 10, 10.0, 30.0),
        },
        "air": {"wakes": Effect(5, 5, 5.0, 2.5), "rotation": Effect()},
    }  # fmt: skip
    rig = make_rig()
    found = flown().measured(WorldRecord([], effects, {"center_of_mass_m": 0.02}), rig, rig)
    assert (found.dust_scans, found.dust_returns_fraction, found.dust_images) == (3.0, 0.25, 0.0)
    assert (found.plants_fraction, found.sway_m, found.range_error_m) == (0.25, 0.02, 0.015)
    assert (found.lamp_fraction, found.light_lux, found.gain) == (0.3, 0.002, 16.0)
    assert (found.stamp_error_ms, found.wakes_mps, found.air_rotation_degps) == (3.0, 0.5, 0.0)
    assert found.center_of_mass_m == 0.02 and found.exposure_ms is None


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
    dark = judged(night, light_lux=6e-4, lamp_fraction=0.3)
    assert dark["happened"] and "0.0006 lx without the lamp, the lamp on in 30%" in dark["text"]
    assert not judged(night, light_lux=2e4, lamp_fraction=0.3)["happened"]
    assert not judged(night, light_lux=6e-4, lamp_fraction=0.0)["happened"]
    assert not judged(night)["happened"]
    without_lamp = load_config(None, ["lamp.below_m=0"], light="night")
    assert judged(without_lamp, light_lux=6e-4, lamp_fraction=0.0)["happened"]


def test_the_wind_must_have_blown_as_asked() -> None:
    config = load_config(None, ["wind.mean_kmh=36"])
    assert judged(config, wind_at_6m_mps=10.0, wind_mps=13.0, gust_mps=20.0) == {
        "name": "wind", "happened": True, "value": 36.0,
        "minimum": pytest.approx(23.4), "maximum": pytest.approx(48.6),
        "text": "wind of 36 km/h: 36.0 km/h at 6 m, 46.8 at the vehicle, gusts to 72.0",
    }  # fmt: skip
    assert not judged(config, wind_at_6m_mps=3.3)["happened"] and not judged(config)["happened"]


@pytest.mark.parametrize("name", list(effects()))
def test_an_effect_of_nothing_did_not_happen(name: str) -> None:
    config = load_config(None, ["profile=field", f"harsh_effects=['{name}']"])
    rule = EFFECT_RULES[name]
    minimum = rule.minimum(config)
    assert minimum > 0.0 and not judged(config)["happened"]
    assert not judged(config, **{rule.column: 0.99 * minimum})["happened"]
    assert judged(config, **{rule.column: 1.01 * minimum})["happened"]


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
