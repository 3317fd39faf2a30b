"""Measured conditions of a flight: figures of made-up steps with known answers."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from touchdown.experiments.flight.conditions import ConditionsObserver
from touchdown.sim.effects import Effect, WorldRecord
from touchdown.sim.frames import Pose, so3_exp

from support.livo_flight import make_rig

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
    assert (found.dust_scans, found.dust_returns_share, found.dust_images) == (3.0, 0.25, 0.0)
    assert (found.plants_share, found.sway_m, found.range_error_m) == (0.25, 0.02, 0.015)
    assert (found.lamp_share, found.light_lux, found.gain) == (0.3, 0.002, 16.0)
    assert (found.stamp_error_ms, found.wakes_mps, found.air_rotation_degps) == (3.0, 0.5, 0.0)
    assert found.center_of_mass_m == 0.02 and found.exposure_ms is None
