"""The whole estimator on a short made-up flight over a plane, and against broken input."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from touchdown.estimator.api import LivoParams
from touchdown.estimator.livo.estimator import Livo
from touchdown.estimator.livo.visual import VisualFrontEnd
from touchdown.sim.api import GRAVITY_MPS2, RangefinderSample

from support.livo_flight import (
    FLIGHT,
    HZ,
    IMU_TICKS,
    RIG,
    fly,
    inertial,
    observations,
    position_at,
    swaying,
)


@pytest.mark.parametrize("sigma_s", [0.005, 0.0])
def test_the_offset_of_the_cameras_clock_is_estimated(sigma_s: float) -> None:
    """20 ms at up to 4 m/s are 8 cm without online calibration of the clock."""
    livo = Livo(RIG, LivoParams(camera_clock_sigma_s=sigma_s))
    estimates = [livo.update(obs) for obs in observations(RIG, 3000, swaying, 12)]
    late = [e for e in estimates if e.time_s > 2.5]
    worst = max(np.linalg.norm(e.world_from_body.translation - swaying(e.time_s)) for e in late)
    clock_ms = late[-1].diagnostics["calibration_clock_ms"]
    if sigma_s:
        assert clock_ms == pytest.approx(20.0, abs=1.0) and worst < 0.02
    else:
        assert clock_ms == 0.0 and worst > 0.05


def test_biases_and_level_are_estimated_on_the_ground() -> None:
    """Two seconds at rest with a biased IMU: the turn-on biases of 3 mrad/s and 30 mm/s^2 shrink to
    the limits set by noise and by the attitude prior, and gravity stays vertical."""
    gyro, specific = np.array([2e-3, -3e-3, 1e-3]), np.array([0.02, -0.01, 0.03])
    livo = Livo(RIG, LivoParams())
    for tick in range(0, 1201, IMU_TICKS):
        estimate = livo.update(inertial(tick, gyro, specific + [0.0, 0.0, GRAVITY_MPS2]))
    np.testing.assert_allclose(estimate.angular_velocity_body, 0.0, atol=2e-4)
    np.testing.assert_allclose(estimate.acceleration_odom, 0.0, atol=2e-3)
    # three times the standard deviation of the attitude on the pad
    np.testing.assert_allclose(estimate.odom_from_body.rotation, np.eye(3), atol=6e-4)


def test_returns_of_long_ago_are_not_extended(monkeypatch: pytest.MonkeyPatch) -> None:
    """The LIDAR drops out from the scan at 0.6 s on; that of 0.5 s is fresh for three periods."""
    asked: list[tuple[int, float | None]] = []

    def note(
        self: VisualFrontEnd, *args: Any, delay_s: float = 0.0, ground_m: float | None = None
    ) -> None:
        assert delay_s == 0.0  # the images lie on the ticks of the IMU
        asked.append((args[3], ground_m))

    monkeypatch.setattr(VisualFrontEnd, "new_keyframe", note)
    reading = RangefinderSample(tick=480, time_s=0.8, range_m=2.5)
    silent = [dataclasses.replace(o, scans=()) if o.tick > 350 else o for o in FLIGHT]
    fly([dataclasses.replace(o, rangefinder=(reading,) * (o.tick == 480)) for o in silent])
    assert [ground for tick, ground in asked if tick <= 480] == [None] * 8
    below = [ground for tick, ground in asked if tick > 480]
    level = position_at(0.8)[2] - 2.5 + RIG.nav.rangefinder.position_body_m[2]
    assert len(below) == 4 and below == pytest.approx([level] * 4, abs=0.02)


def test_an_image_is_given_the_ground_that_the_beam_met_then(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Ranges grow by a metre a second, 50 of them a second; images come 60 ms late."""
    spots: dict[int, np.ndarray | None] = {}
    update = VisualFrontEnd.update

    def note(self: VisualFrontEnd, eskf: Any, *args: Any, spot: np.ndarray | None) -> Any:
        spots[eskf.state.tick] = spot
        return update(self, eskf, *args, spot=spot)

    monkeypatch.setattr(VisualFrontEnd, "update", note)

    def reading(tick: int) -> RangefinderSample:
        return RangefinderSample(tick=tick, time_s=tick / HZ, range_m=2.0 + tick / HZ)

    fly(
        [
            dataclasses.replace(o, rangefinder=(reading(o.tick),) * (o.tick % 12 == 0))
            for o in FLIGHT
        ]
    )
    assert len(spots) > 3
    beam = np.array(RIG.nav.rangefinder.position_body_m)
    for tick, spot in spots.items():
        met = RIG.body_from_imu.inverse().apply(beam - [0.0, 0.0, 2.0 + tick / HZ])
        np.testing.assert_allclose(spot, met, atol=0.011)


@pytest.mark.parametrize(
    "change",
    [{"use_lidar": False}, {"use_vision": False}, {"loose": True}, {"use_closures": False},
     {"use_calibration": False}],
)  # fmt: skip
def test_parts_can_be_left_out(change: dict[str, bool]) -> None:
    livo = Livo(RIG, LivoParams(**change))
    assert livo.needs.camera_hz == (0 if change == {"use_vision": False} else 5)
    last = [livo.update(obs) for obs in FLIGHT][-1]
    error = last.world_from_body.translation - position_at(last.time_s)
    # over a plane the LIDAR holds height only
    assert np.abs(error[2] if change == {"use_vision": False} else error).max() < 0.05
