"""Removal of rain and fog by the guard; clear scans pass unchanged."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from touchdown.estimator.guard import InputGuard
from touchdown.sim.api import LidarParams, LidarScan

from support.fault_air_support import look_down
from support.guard_support import RIG, obs
from support.lidar_support import PLANE


def a_second(height: float, *events: str, **faults: Any) -> list[LidarScan]:
    """Ten scans, each a period after the other, with noise."""
    noisy = LidarParams(divergence=False)
    scan = look_down(PLANE, height, *events, params=noisy, **faults)
    rolled = [np.roll(scan.ranges, k) for k in range(10)]  # no content twice
    return [
        dataclasses.replace(
            scan, start_tick=60 * k, end_tick=60 * (k + 1), ranges=rolled[k],
            intensity=np.roll(scan.intensity, k),
        )
        for k in range(10)
    ]  # fmt: skip


def guarded(scans: list[LidarScan]) -> tuple[list[LidarScan], list[str]]:
    guard = InputGuard(RIG)
    kept: list[LidarScan] = []
    said: list[str] = []
    for scan in scans:
        kept += guard.screen(obs(scan.end_tick + 36, scans=(scan,))).scans
        said += guard.events
    return kept, said


@pytest.mark.parametrize("height", [1.0, 4.0, 30.0])
def test_clear_scans_pass_untouched(height: float) -> None:
    scans = a_second(height)
    kept, said = guarded(scans)
    assert all(a is b for a, b in zip(kept, scans, strict=True)) and not said


def test_rain_is_taken_out_from_the_third_scan_on() -> None:
    scans = a_second(30.0, "rain@0")
    kept, said = guarded(scans)
    false = (scans[0].ranges > 0.0) & (scans[0].ranges < 20.0)
    assert 0.005 < false.mean() < 0.03
    assert all(a is b for a, b in zip(kept[:2], scans[:2], strict=True))
    for k, scan in enumerate(kept[2:], start=2):
        mine = np.roll(false, k)
        assert np.isnan(scan.ranges[mine]).mean() > 0.95 and not np.isnan(scan.ranges[~mine]).any()
    assert len(said) == 1 and "echoes of rain or fog" in said[0]


def test_rain_is_still_known_near_the_ground() -> None:
    high, low = a_second(30.0, "rain@0"), a_second(3.0, "rain@0")
    later = [
        dataclasses.replace(s, start_tick=s.start_tick + 600, end_tick=s.end_tick + 600)
        for s in low
    ]
    kept, _ = guarded(high + later)
    ground = later[0].ranges > 2.9
    for k, scan in enumerate(kept[10:]):
        mine = np.roll(ground, k)
        assert not np.isnan(scan.ranges[mine]).any() and np.isnan(scan.ranges[~mine]).mean() > 0.4
    untold, said = guarded(low)
    assert all(a is b for a, b in zip(untold, low, strict=True)) and not said


def test_fog_too_thick_to_see_through_is_refused() -> None:
    _, said = guarded(a_second(30.0, "fog@0", fog_visibility_m=30.0))
    assert any("nothing but echoes of rain or fog" in text for text in said)
